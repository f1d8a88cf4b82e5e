"""Encoders: the networks, and the file that holds one with its weights. Importing it registers the networks."""

from sb3_abisim.networks import paper  # noqa: F401
