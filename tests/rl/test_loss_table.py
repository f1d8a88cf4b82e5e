"""The table of docs/while_rl_runs.md: which loss moves the encoder, measured by weights in each algorithm.

After a change, ``PYTHONPATH=.:tests python tests/rl/test_loss_table.py`` writes it anew.
"""

import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch as th
from extractor_inputs import ALGORITHMS, SHARING, build, write

from sb3_abisim.rl.checks import find_extractors
from sb3_abisim.rl.fine_tuning import FineTuning

PAGE = Path(__file__).resolve().parents[2] / "docs" / "while_rl_runs.md"
HEAD = (
    "| algorithm | extractors | losses that move the encoder | with `encoder_trained_by: critic` |\n|---|---|---|---|\n"
)
# What each algorithm computes, under the names that readers know.
LOSSES = {
    **dict.fromkeys(("PPO", "A2C", "TRPO", "RecurrentPPO"), ("policy", "value")),
    **dict.fromkeys(("DQN", "QRDQN"), ("Q",)),
    **dict.fromkeys(("SAC", "TD3", "TQC"), ("actor", "critic")),
}
# Of an encoder that is not shared, by the name of its extractor within the policy.
COPIES = {"features_extractor": "policy", "vf_features_extractor": "value", "actor": "actor", "critic": "critic"}


def collected(name: str, path: Path, other_sharing: bool) -> Any:
    """A model that has met some transitions and has not been trained."""
    model = build(name, path, False, other_sharing, {"optimizer_class": th.optim.Adam, "optimizer_kwargs": {}})
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(model, "train", lambda *args, **kwargs: None)
        model.learn(8)
    if name in ("SAC", "TQC"):
        # Another loss, of one number.
        model.ent_coef_optimizer, model.ent_coef_tensor = None, th.tensor(0.1)
    return model


@contextmanager
def scaled_backward(silenced: tuple[str, ...], order: tuple[str, ...]) -> Iterator[list[float]]:
    """Losses are computed in an order, and some of them have the gradient zero.

    :return: the values of the losses
    """
    backward, values = th.Tensor.backward, []  # type: ignore[var-annotated]

    def scaled(loss: th.Tensor) -> None:
        is_silenced = order[len(values) % len(order)] in silenced
        values.append(loss.item())
        backward(loss * 0 if is_silenced else loss)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(th.Tensor, "backward", scaled)
        yield values


def train_by(name: str, model: Any, loss: str | None) -> None:
    """One update in which this loss alone has a gradient; None for none at all."""
    silenced = tuple(other for other in LOSSES[name] if other != loss)
    with ExitStack() as stack:
        if name in ("PPO", "A2C", "RecurrentPPO"):
            # One sum; the term of entropy has the weight 0.
            model.vf_coef = 0.0 if "value" in silenced else 0.5
            model.normalize_advantage = False
            assert model.ent_coef == 0.0 and np.abs(model.rollout_buffer.advantages).min() > 0
            if "policy" in silenced:
                model.rollout_buffer.advantages[:] = 0.0
        if name == "TRPO":
            # The policy's is no loss that is stepped along: without a line search, nothing comes of it.
            model.line_search_max_iter *= "policy" not in silenced
            stack.enter_context(scaled_backward(silenced, ("value",)))
        if name in ("PPO", "A2C", "TRPO", "RecurrentPPO"):
            model.train()
            return
        order = ("Q",) if name in ("DQN", "QRDQN") else ("critic", "actor")
        values = stack.enter_context(scaled_backward(silenced, order))
        model.train(gradient_steps=1, batch_size=4)
        # That the order is this one.
        logged = ["train/loss"] if order == ("Q",) else [f"train/{part}_loss" for part in order]
        assert values == pytest.approx([model.logger.name_to_value[key] for key in logged])


def copies(model: Any) -> dict[str, Any]:
    """The encoders of a policy by the network that has them; one that is shared, or the only one, by the name ""."""
    found = find_extractors(model.policy)
    if len(found) == 1:
        return {"": found[0][1]}
    return {COPIES[name.split(".")[0]]: extractor for name, extractor in found}


def moving_losses(name: str, path: Path, other_sharing: bool, trained_by: str | None = None) -> str:
    """Which losses move which encoder, as the table says it; "refused" where that is."""
    moved: dict[str, list[str]] = {}
    for loss in (None, *LOSSES[name]):
        model = collected(name, path, other_sharing)
        tuning = FineTuning(encoder_trained_by=trained_by)
        try:
            tuning.install(model)
        except ValueError:
            return "refused"
        train_by(name, model, loss)
        for network, extractor in copies(model).items():
            moved.setdefault(network, [])
            if extractor.relative_weight_change() > 0:
                assert loss is not None, f"{name}: the encoder moves without a loss"
                moved[network].append(loss)
    parts = [
        f"the {network}'s: {', '.join(losses)}" if network else ", ".join(losses) for network, losses in moved.items()
    ]
    return "; ".join(parts)


def row(name: str, path: Path, other_sharing: bool) -> str:
    """A line of the table."""
    extractors = "one"
    if name in SHARING:
        extractors = "shared" if SHARING[name] is other_sharing else "separate"
        extractors += "" if other_sharing else " (default)"
    cells = [moving_losses(name, path, other_sharing, trained_by) for trained_by in (None, "critic")]
    shown = {"QRDQN": "QR-DQN"}.get(name, name)
    return f"| {shown} | {extractors} | {cells[0]} | {cells[1]} |\n"


def rows(name: str, path: Path) -> str:
    """The lines of an algorithm."""
    return "".join(row(name, path, other_sharing) for other_sharing in (False, True)[: 1 + (name in SHARING)])


@pytest.mark.parametrize("name", ALGORITHMS)
def test_the_table_says_what_is_measured(path: Path, name: str) -> None:
    assert rows(name, path) in PAGE.read_text()


def test_the_table_has_no_other_lines() -> None:
    table = PAGE.read_text().partition(HEAD)[2].partition("\n\n")[0]
    assert table.count("\n") + 1 == len(ALGORITHMS) + len(SHARING)


if __name__ == "__main__":
    before, head, after = PAGE.read_text().partition(HEAD)
    assert head
    made = "".join(rows(name, write(Path(tempfile.mkdtemp()) / "e.safetensors")) for name in ALGORITHMS)
    PAGE.write_text(before + head + made + "\n" + after.partition("\n\n")[2])
