"""The ladder: targets against a layout solved by hand, and what a perfect embedding scores."""

import json

import numpy as np
import pytest
import torch as th
from torch import nn

from sb3_abisim.analysis import command as analyze
from sb3_abisim.analysis import readouts
from sb3_abisim.analysis.nav2d_exact import GOAL_CELL, SIZE
from sb3_abisim.envs.nav2d import GOAL, MOVES
from sb3_abisim.networks.encoder_file import load_encoder


@pytest.fixture()
def one_layout(monkeypatch):
    """Nothing but a wall of three cells left of the goal, and states two cells to the left and five to the right."""
    obstacles = np.zeros((SIZE, SIZE), dtype=bool)
    x, y = GOAL
    obstacles[y - 1 : y + 2, x - 1] = True
    monkeypatch.setattr(readouts, "eval_layouts", lambda *_: obstacles.ravel()[None])
    monkeypatch.setattr(readouts, "reachable", lambda _: np.array([GOAL_CELL, GOAL_CELL - 2, GOAL_CELL + 5]))


def test_targets_of_a_layout_solved_by_hand(one_layout):
    shown, targets = readouts.sample_states("Nav2D-v0", 1)
    assert len(shown) == 2, "without the goal"
    left = int(np.argmax([shown[i, 0].ravel().argmax() == GOAL_CELL - 2 for i in range(2)]))
    optimal, excess = targets["optimal_action"].values, targets["geodesic_excess"].values[:, 0]
    up, down, to_left, to_right = ((0, -1), (0, 1), (-1, 0), (1, 0))
    best = {move: bool(optimal[left, MOVES.index(move)]) for move in MOVES}
    assert best == {up: True, down: True, to_left: False, to_right: False}, "around the wall, up or down"
    best = {move: bool(optimal[1 - left, MOVES.index(move)]) for move in MOVES}
    assert best == {up: False, down: False, to_left: True, to_right: False}
    assert excess[left] == 4 and excess[1 - left] == 0
    # Of the four cells one move away, the right one is blocked; two moves away, those above and below it.
    assert targets["blocked_1"].values[left].sum() == 1 and targets["blocked_2"].values[left].sum() == 2
    # Five cells to the right of the goal, the grid ends three cells on.
    assert targets["blocked_2"].values[1 - left].sum() == 0 and targets["blocked_3"].values[1 - left].sum() == 1
    assert targets["blocked_4"].values[1 - left].sum() == 3


class Pixels(nn.Module):
    """All pixels as the embedding, around the agent: knows what is blocked."""

    def forward(self, x):
        n = len(x)
        agent = x[:, 0].reshape(n, -1).argmax(dim=1)
        padded = nn.functional.pad(x[:, 1], (4, 4, 4, 4), value=1.0)
        rows, columns = agent // SIZE, agent % SIZE
        return th.stack(
            [padded[i, r : r + 9, c : c + 9].flatten() for i, (r, c) in enumerate(zip(rows, columns, strict=True))]
        )


def test_what_an_embedding_holds_is_read_and_nothing_else():
    scores = readouts.readouts(Pixels(), "Nav2D-v0", n_layouts=40)
    assert all(scores[f"blocked_{n}"] > 0.999 for n in readouts.DISTANCES)
    assert scores["optimal_action"] < 0.9, "where the goal is, it does not know"


def test_the_command_writes_table_and_numbers(tmp_path, capsys):
    output = tmp_path / "new" / "readouts.json"
    analyze.main(["readouts", "Nav2D-v0/ssi", "--n-layouts", "3", "-o", str(output)])
    assert "| Nav2D-v0/ssi |" in capsys.readouterr().out
    (result,) = json.loads(output.read_text())["encoders"].values()
    assert result["hash"] == load_encoder("Nav2D-v0/ssi").hash and result["objective"] == "ssi"
    with pytest.raises(SystemExit):
        analyze.main(["readouts", "Nav2D-v0/ssi", "--env", "PointMaze-v0"])
    assert "Nav2D alone" in capsys.readouterr().err
