"""Encoders: the networks, and the file that holds one with weights. Importing it registers both, and augmentations."""

from sb3_abisim.networks import augmentations, glimpse, impala, nature, paper, resnet18, small, timm_backbones  # noqa: F401
