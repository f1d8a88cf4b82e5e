"""The pretraining objectives, by the name that commands, files and extractors use."""

from sb3_abisim.objectives.action_bisim import ActionBisimulation
from sb3_abisim.objectives.base import Objective, TensorBatch
from sb3_abisim.objectives.beta_vae import BetaVAE
from sb3_abisim.objectives.curl import CURL
from sb3_abisim.objectives.info_nce import InfoNCE
from sb3_abisim.objectives.inverse import ACRO, InverseDynamics

OBJECTIVES: dict[str, type[Objective]] = {
    cls.name: cls for cls in (InverseDynamics, ACRO, BetaVAE, CURL, InfoNCE, ActionBisimulation)
}

__all__ = [
    "ACRO",
    "CURL",
    "OBJECTIVES",
    "ActionBisimulation",
    "BetaVAE",
    "InfoNCE",
    "InverseDynamics",
    "Objective",
    "TensorBatch",
]
