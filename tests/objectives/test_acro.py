"""ACRO is the loss of SSI, for several steps."""

import re

import pytest
import torch as th
from objective_inputs import DISCRETE, LineEncoder, make_batch

from sb3_abisim.objectives.acro import ACRO
from sb3_abisim.objectives.ssi import InverseDynamics


def test_acro_is_the_same_loss_for_several_steps():
    th.manual_seed(0)
    acro = ACRO(LineEncoder(), DISCRETE, l1_penalty=0.3)
    ssi = InverseDynamics(LineEncoder(), DISCRETE, l1_penalty=0.3)
    ssi.load_state_dict(acro.state_dict())
    batch = make_batch(DISCRETE)
    assert float(acro.loss(batch)[0].detach()) == float(ssi.loss(batch)[0].detach())
    for k in (2, [1, 5], [2, 2]):
        ACRO.check_k(k)
        with pytest.raises(ValueError, match=re.escape(f"ssi takes single steps, got k = {k}")):
            InverseDynamics.check_k(k)
    InverseDynamics.check_k(1)
    for k in (1, [1, 1]):
        with pytest.raises(ValueError, match=r"^acro needs k > 1, got k = 1, which is ssi$"):
            ACRO.check_k(k)
