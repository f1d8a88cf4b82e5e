"""The pretraining objectives, by the name that commands, files and extractors use."""

from sb3_abisim.objectives.action_bisim import ActionBisimulation
from sb3_abisim.objectives.base import Objective, TensorBatch
from sb3_abisim.objectives.inverse import InverseDynamics

OBJECTIVES: dict[str, type[Objective]] = {cls.name: cls for cls in (InverseDynamics, ActionBisimulation)}

__all__ = ["OBJECTIVES", "ActionBisimulation", "InverseDynamics", "Objective", "TensorBatch"]
