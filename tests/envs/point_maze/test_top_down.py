"""The rasterizer against brute force, and against MuJoCo's renderer where GL is present.

The GL comparison needs EGL or OSMesa: ``apt-get install libegl1 libgl1`` or ``apt-get install libosmesa6 libgl1``.
Without either it is skipped.
"""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from sb3_abisim.envs.point_maze import env as point_maze
from sb3_abisim.envs.point_maze import layout as point_maze_layout
from sb3_abisim.envs.point_maze import top_down
from sb3_abisim.envs.point_maze.top_down import DiscPainter

SIZE = 16
RADIUS = 1.2

# Against MuJoCo: flat areas may differ by rounding; along the disc's edge MSAA has 4 or 8 samples, so steps of up to
# 1/4 of the contrast, and a pixel may be off by one step.
FLAT_TOLERANCE = 2
EDGE_TOLERANCE = 0.25


def floors(n: int) -> np.ndarray:
    return np.stack([top_down.floor(SIZE)] * n)


@pytest.mark.parametrize("radius", [0.4, 1.2, 3.6])
@pytest.mark.parametrize("center", [(5.0, 7.0), (6.25, 4.9), (3.99, 8.51), (0.2, 9.7)])
def test_coverage_is_the_area_of_the_disc_in_each_pixel(radius: float, center: tuple[float, float]) -> None:
    fine = 200
    samples = (np.arange(SIZE * fine) + 0.5) / fine
    inside = (samples[None, :] - center[0]) ** 2 + (samples[:, None] - center[1]) ** 2 < radius**2
    expected = inside.reshape(SIZE, fine, SIZE, fine).mean(axis=(1, 3))
    np.testing.assert_allclose(top_down.disc_coverage(np.array(center), radius, SIZE), expected, atol=2e-3)


def test_the_rendered_disc_lies_where_it_should() -> None:
    generator = np.random.default_rng(0)
    centers = generator.uniform(3, SIZE - 3, (300, 2))
    observations = floors(300)
    DiscPainter(RADIUS, SIZE, top_down.AGENT).render(observations, centers)
    # Green falls from floor to agent in proportion to the coverage.
    share = (top_down.FLOOR[1] - observations[:, 1].astype(float)) / (top_down.FLOOR[1] - top_down.AGENT[1])
    np.testing.assert_allclose(share.sum(axis=(1, 2)), np.pi * RADIUS**2, atol=0.04)
    middle = np.arange(SIZE) + 0.5
    columns = (share.sum(axis=1) * middle).sum(axis=1) / share.sum(axis=(1, 2))
    rows = (share.sum(axis=2) * middle).sum(axis=1) / share.sum(axis=(1, 2))
    np.testing.assert_allclose(np.stack([columns, rows], axis=1), centers, atol=0.025)


def test_neighboring_positions_differ_by_few_gray_levels() -> None:
    painter = DiscPainter(RADIUS, SIZE)
    x = 5 + np.arange(2 * top_down.SUBPIXELS) / top_down.SUBPIXELS
    observations = floors(len(x))
    painter.render(observations, np.stack([x, np.full_like(x, 7.3)], axis=1))
    steps = np.abs(np.diff(observations.astype(int), axis=0)).reshape(len(x) - 1, -1).max(axis=1)
    assert steps.max() <= 2
    assert steps.min() >= 1


def test_a_batch_equals_its_observations_rendered_alone() -> None:
    generator = np.random.default_rng(1)
    centers = generator.uniform(2, SIZE - 2, (5, 2))
    backgrounds = generator.integers(256, size=(5, 3, SIZE, SIZE), dtype=np.uint8)
    painter = DiscPainter(RADIUS, SIZE)
    together = backgrounds.copy()
    painter.render(together, centers)
    for i in range(5):
        alone = backgrounds[i : i + 1].copy()
        painter.render(alone, centers[i : i + 1])
        np.testing.assert_array_equal(together[i], alone[0])
        far = np.hypot(*np.meshgrid(np.arange(SIZE) - centers[i, 0], np.arange(SIZE) - centers[i, 1])) > RADIUS + 2
        np.testing.assert_array_equal(together[i][:, far], backgrounds[i][:, far])


def test_rendering_over_another_observation_mixes_with_that_one() -> None:
    generator = np.random.default_rng(4)
    observations, over = generator.integers(256, size=(2, 6, 3, SIZE, SIZE), dtype=np.uint8)
    centers = generator.uniform(2, SIZE - 2, (6, 2))
    painter = DiscPainter(RADIUS, SIZE)
    alone, touched = over.copy(), np.zeros((6, SIZE, SIZE), dtype=bool)
    painter.render(alone, centers)
    painter.mark(touched, centers)
    expected = np.where(touched[:, None], alone, observations)
    painter.render(observations, centers, over=over)
    np.testing.assert_array_equal(observations, expected)


def test_mark_is_the_set_of_pixels_that_render_mixes() -> None:
    centers = np.random.default_rng(2).uniform(2, SIZE - 2, (50, 2))
    painter = DiscPainter(RADIUS, SIZE, (255, 255, 255))
    observations, masks = np.zeros((50, 3, SIZE, SIZE), dtype=np.uint8), np.zeros((50, SIZE, SIZE), dtype=bool)
    painter.render(observations, centers)
    masks[:, 0, 0] = True
    painter.mark(masks, centers)
    expected = observations[:, 0] > 0
    expected[:, 0, 0] = True
    np.testing.assert_array_equal(masks, expected)


@pytest.mark.parametrize("center", [(1.0, 8.0), (8.0, 1.1), (15.1, 8.0), (8.0, 15.0), (-40.0, 8.0)])
def test_a_disc_that_leaves_the_observation_is_refused(center: tuple[float, float]) -> None:
    with pytest.raises(ValueError, match=r"leaves the 16 x 16 observation"):
        DiscPainter(RADIUS, SIZE).render(floors(1), np.array([center]))


def test_a_disc_may_come_close_to_the_edges() -> None:
    observations = floors(2)
    close = SIZE - RADIUS - 1.01
    DiscPainter(RADIUS, SIZE).render(observations, np.array([(RADIUS, 8.5), (close, close)]))
    assert (observations[0, :, 8, 1] == top_down.AGENT).all()
    assert (observations[1, :, -3, -3] == top_down.AGENT).all()


def test_enlarged_observation_shrinks_back_to_the_rendered_one() -> None:
    backdrop = np.random.default_rng(3).integers(256, size=(3, SIZE, SIZE), dtype=np.uint8)
    center = np.array([6.3, 9.9])
    large = top_down.enlarge(backdrop, center, RADIUS, scale=8)
    assert large.shape == (SIZE * 8, SIZE * 8, 3) and large.dtype == np.uint8
    rendered = backdrop[None].copy()
    DiscPainter(RADIUS, SIZE).render(rendered, center[None])
    shrunk = large.reshape(SIZE, 8, SIZE, 8, 3).mean(axis=(1, 3)).transpose(2, 0, 1)
    assert np.abs(shrunk - rendered[0]).max() <= 3


def _scene(obstacles: np.ndarray, agent: np.ndarray) -> str:
    """The room as MuJoCo geoms, y up as in MuJoCo, in colors that do not depend on light."""

    def geom(kind: str, color: tuple[int, int, int], x: float, y: float, size: str, top: float) -> str:
        rgba = " ".join(str(channel / 255) for channel in color)
        name = "m{}_{}_{}".format(*color)
        materials.add(f'<material name="{name}" rgba="{rgba} 1" emission="1" specular="0" shininess="0"/>')
        return f'<geom type="{kind}" material="{name}" pos="{x} {y} {top - 0.05}" size="{size}"/>'

    materials: set[str] = set()
    geoms = [geom("box", top_down.FLOOR, 0, 0, "9 9 0.05", 0.0), geom("box", top_down.GOAL, 0, 0, ".5 .5 .05", 0.1)]
    for sign in (-1, 1):
        geoms.append(geom("box", top_down.WALL, sign * 7.75, 0, ".25 8 .05", 0.2))
        geoms.append(geom("box", top_down.WALL, 0, sign * 7.75, "8 .25 .05", 0.2))
    geoms += [geom("box", top_down.OBSTACLE, x, -y, "1 1 .05", 0.3) for x, y in obstacles]
    geoms.append(geom("cylinder", top_down.AGENT, agent[0], -agent[1], "0.3 0.05", 0.4))
    return f"""<mujoco>
      <visual><headlight ambient="0 0 0" diffuse="0 0 0" specular="0 0 0"/><quality offsamples="8"/></visual>
      <asset>{"".join(sorted(materials))}</asset>
      <worldbody><camera name="top" pos="0 0 5" projection="orthographic" fovy="16"/>{"".join(geoms)}</worldbody>
    </mujoco>"""


_RENDER = """
import sys, numpy as np, mujoco
model = mujoco.MjModel.from_xml_path(sys.argv[1])
data = mujoco.MjData(model)
mujoco.mj_forward(model, data)
with mujoco.Renderer(model, 64, 64) as renderer:
    renderer.update_scene(data, camera="top")
    np.save(sys.argv[2], renderer.render())
"""


def _render_by_mujoco(xml: str, folder: Path) -> np.ndarray:
    (folder / "scene.xml").write_text(xml)
    reasons = []
    for backend in ("egl", "osmesa"):
        # MuJoCo chooses its backend when it is imported, hence another process.
        done = subprocess.run(
            [sys.executable, "-c", _RENDER, "scene.xml", "seen.npy"],
            cwd=folder,
            env={**os.environ, "MUJOCO_GL": backend},
            capture_output=True,
            text=True,
        )
        if (folder / "seen.npy").exists():
            return np.load(folder / "seen.npy")
        reasons.append(f"{backend}: {(done.stderr.strip().splitlines() or ['no message'])[-1]}")
    pytest.skip(f"no GL (apt-get install libegl1 libosmesa6 libgl1): {'; '.join(reasons)}")


@pytest.mark.parametrize("seed", [0, 5])
def test_observations_equal_mujocos_orthographic_render(seed: int, tmp_path: Path) -> None:
    env = point_maze.PointMazeEnv()
    observation, _ = env.reset(seed=seed)
    factors = env.factors()
    theirs = _render_by_mujoco(_scene(factors["obstacles"], factors["agent"]), tmp_path).astype(int)
    ours = observation.transpose(1, 2, 0).astype(int)
    error = np.abs(ours - theirs).max(axis=-1)
    column, row = point_maze_layout.to_pixels(factors["agent"])
    middles = np.arange(64) + 0.5
    near_agent = np.hypot(middles[None, :] - column, middles[:, None] - row) < 1.2 + 1
    assert error[~near_agent].max() <= FLAT_TOLERANCE
    contrast = max(abs(a - b) for a, b in zip(top_down.FLOOR, top_down.AGENT, strict=True))
    assert error[near_agent].max() <= EDGE_TOLERANCE * contrast
    # The comparison would see an agent that is missing or a pixel away.
    assert np.abs(theirs[near_agent] - top_down.FLOOR).max() > 100
