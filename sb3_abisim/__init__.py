"""Action-bisimulation and baseline encoders for Stable-Baselines3, pretrained without rewards."""

from sb3_abisim import envs as _envs  # registers the environments
from sb3_abisim._version import __version__

__all__ = ["__version__"]
