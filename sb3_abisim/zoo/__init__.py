"""rl-zoo3's side; importing this package teaches rl-zoo3 our hyperparameters, methods and evaluation splits.

``custom_envs.py`` imports it when a command of rl-zoo3 starts in a checkout. Elsewhere ``sb3-abisim train`` does, or
``--gym-packages sb3_abisim.zoo`` of rl-zoo3's own commands.
"""

from sb3_abisim.zoo.manager import install

install()
