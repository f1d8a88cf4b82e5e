"""Encoders: the networks, and the file that holds one with its weights. Importing it registers the networks."""

from sb3_abisim.networks import impala, nature, paper, resnet18, small, timm_backbones  # noqa: F401
