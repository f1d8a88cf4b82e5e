"""The pretraining objectives, a file each, which registers itself; a new file in this folder is found by itself."""

import importlib
import pkgutil

from sb3_abisim.registry import register_method

for _module in pkgutil.iter_modules(__path__):
    importlib.import_module(f"{__name__}.{_module.name}")

# The baseline that pretrains nothing.
register_method("vanilla", label="trained from scratch", extractor="VanillaExtractor", color="#D55E00")
# Yarats et al. (2021), for every algorithm of Stable-Baselines3: vanilla on randomly shifted observations.
register_method("drq", label="DrQ", extractor="DrQExtractor", color="#882255", augment="random_shift")
# Encoders of sb3_abisim.from_module.
register_method("foreign", label="trained elsewhere", color="#999999", trained_elsewhere=True)
