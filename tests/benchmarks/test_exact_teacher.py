"""The encoder that is fitted to exact distances."""

import numpy as np
import pytest
import torch as th

from benchmarks import exact_teacher
from sb3_abisim.analysis import nav2d_exact as nav
from sb3_abisim.networks.encoder_file import load_encoder

C = 0.9


@pytest.fixture(scope="module")
def base():
    return load_encoder("Nav2D-v0/ssi").encoder.eval()


@pytest.fixture(scope="module")
def layouts():
    return nav.eval_layouts("Nav2D-v0", 8, exact_teacher.FIRST_LAYOUT)


def cells(observations):
    """Obstacles and agents of observations."""
    flat = observations.reshape(len(observations), 3, -1)
    return flat[0, nav.CHANNELS.index("obstacles")] > 0, flat[:, nav.CHANNELS.index("agent")].argmax(axis=1)


def test_every_second_pair_is_one_toggled_cell_beside_the_same_agents(base, layouts):
    pairs = exact_teacher.solve(base, layouts, C, np.random.default_rng(0))
    for here, there, distances in pairs[1::2]:
        (obstacles, agents), (others, same) = cells(here), cells(there)
        assert (obstacles != others).sum() == 1 and np.array_equal(agents, same)
        (cell,) = np.flatnonzero(obstacles != others)
        reached = np.intersect1d(nav.reachable(obstacles), nav.reachable(others))
        nearest = np.sort(nav.DISTANCE[reached, cell])[: exact_teacher.N_AGENTS // 2]
        assert np.array_equal(np.sort(nav.DISTANCE[agents[: len(nearest)], cell]), nearest)
        assert distances.shape == (exact_teacher.N_AGENTS, exact_teacher.N_AGENTS)
    # Without them, whole layouts: itself and, three times as often, another.
    natural = exact_teacher.solve(base, layouts, C, np.random.default_rng(0), toggle=False)
    n_differing = [int((cells(here)[0] != cells(there)[0]).sum()) for here, there, _ in natural]
    assert [n > 1 for n in n_differing] == [False, True, True, True] * 2


def test_distances_are_the_exact_ones(base, layouts):
    here, there, distances = exact_teacher.solve(base, layouts, C, np.random.default_rng(0))[0]
    (obstacles, agents), (_, others) = cells(here), cells(there)
    reached = nav.reachable(obstacles)
    exact = nav.exact_distances(base, obstacles, C)
    expected = exact[np.ix_(np.searchsorted(reached, agents), np.searchsorted(reached, others))]
    assert np.allclose(distances, expected, rtol=1e-4)


def test_fitting_brings_distances_closer(tmp_path, monkeypatch, base, layouts):
    monkeypatch.setattr(
        "sys.argv", ["", "-o", str(tmp_path / "x.safetensors"), "--n-layouts", "8", "--n-updates", "60"]
    )
    exact_teacher.main()
    fitted = load_encoder(str(tmp_path / "x.safetensors")).encoder
    here, there, exact = exact_teacher.solve(base, layouts, C, np.random.default_rng(1))[2]

    def correlation(encoder):
        learned = th.cdist(nav.embed(encoder, here), nav.embed(encoder, there), p=1.0)
        return nav.spearman(learned.numpy().ravel(), exact.ravel())

    assert correlation(fitted) > correlation(base) + 0.05
