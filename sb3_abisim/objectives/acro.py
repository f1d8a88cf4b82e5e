"""ACRO, k-step inverse dynamics (Lamb et al. 2022, and the paper's appendix on k-step base cases).

The loss is that of :mod:`~sb3_abisim.objectives.ssi`, for two observations that lie k steps apart: which action was the
first of the k steps from s_t to s_{t+k}? The inverse model does not get the number of steps, as in the paper.
"""

from sb3_abisim.objectives.ssi import InverseDynamics
from sb3_abisim.registry import register_method


class ACRO(InverseDynamics):
    """Embed what is needed to predict the first action on the way from s_t to s_{t+k}.

    The parameters are those of :class:`~sb3_abisim.objectives.ssi.InverseDynamics`.
    """

    name = "acro"

    @classmethod
    def check_k(cls, k: int | list[int]) -> None:
        """Refuse single steps, which are SSI.

        :param k: steps between the two observations, or the fewest and the most of them
        :raises ValueError: for k = 1
        """
        if k in (1, [1, 1]):
            raise ValueError("acro needs k > 1, got k = 1, which is ssi")


register_method("acro", ACRO, label="multi-step inverse dynamics (ACRO)", extractor="ACROExtractor", color="#CC79A7")
