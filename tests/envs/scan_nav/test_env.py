"""ScanNav against a ray-cast camera, habitat-lab's definitions, and an agent that knows the map."""

import warnings

import gymnasium as gym
import numpy as np
import pytest
import trimesh
from scan_inputs import empty_room
from scipy import ndimage
from stable_baselines3 import PPO
from stable_baselines3.common.env_checker import check_env

from sb3_abisim.envs.scan_nav.apartment import SEEDS, apartment_mesh
from sb3_abisim.envs.scan_nav.env import ScanNavEnv, ScanNavVectorEnv, load_scene
from sb3_abisim.envs.scan_nav.view import MARKER_RADIUS, MARKERS, area_means
from sb3_abisim.envs.scan_nav.world import NODE, DistanceGrid, StartRule


@pytest.fixture(scope="module")
def room():
    return empty_room()


def at(env, start, goal, heading=0.0):
    return env.reset(seed=0, options={"goal": goal, "start": start, "heading": heading})


# Pictures.


def ray_cast(mesh, rays):
    """Color and height that a camera from above sees along each ray, by embree; black and nan for nothing.

    A ray upwards from the cut tells by the side of what it hits whether it began inside a solid.
    """
    whole = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    facing = whole.face_normals[:, 2]
    up = np.flatnonzero(facing > 1e-9)
    floors = trimesh.Trimesh(mesh.vertices, mesh.faces[up], process=False)
    starts, vertical = np.column_stack([rays, np.full(len(rays), 2.0)]), np.tile([0.0, 0.0, 1.0], (len(rays), 1))
    above = whole.ray.intersects_first(starts, vertical)
    below = floors.ray.intersects_first(starts, -vertical)
    below = np.where(below >= 0, up[below], -1)
    face = np.where((above >= 0) & (facing[above] > 0), above, below)
    seen, corners = face >= 0, whole.triangles[face]
    height = np.where(seen, corners[:, :, 2].mean(axis=1), np.nan)
    assert np.ptp(corners[seen, :, 2], axis=1).max() < 1e-6, "what is seen of a flat is level"
    colors = np.zeros((len(rays), 3))
    first = 0
    for surface in mesh.surfaces:
        mine = np.flatnonzero(seen & (face >= first) & (face < first + surface.n_faces))
        hit = face[mine]
        spots = np.column_stack([rays[mine], height[mine]])
        weights = trimesh.triangles.points_to_barycentric(whole.triangles[hit], spots)
        u, v = np.einsum("nk,nkd->dn", weights, surface.coordinates[hit - first])
        rows, columns = (1 - v) * surface.texture.shape[0] - 0.5, u * surface.texture.shape[1] - 0.5
        for c in range(3):
            texture = surface.texture[..., c].astype(float)
            colors[mine, c] = ndimage.map_coordinates(texture, [rows, columns], order=1, mode="grid-wrap")
        first += surface.n_faces
    return np.rint(colors), height


@pytest.mark.parametrize("seed", SEEDS)
def test_every_pixel_of_a_flats_map_equals_a_cast_ray(seed):
    scan = load_scene(seed)
    rows, columns = np.indices(scan.walkable.shape)
    x = scan.origin[0] + (columns + 0.5) * scan.meters_per_pixel
    y = scan.origin[1] - (rows + 0.5) * scan.meters_per_pixel
    colors, height = ray_cast(apartment_mesh(seed), np.stack([x, y], axis=-1).reshape(-1, 2))
    assert np.abs(colors - scan.orthophoto.reshape(-1, 3)).max() <= 1
    assert np.allclose(height, scan.height.ravel(), atol=1e-5, equal_nan=True)


def in_polygon(points, polygon, heading):
    """Whether points (..., 2), east and north of the agent, lie in a part of its marker, by the winding of corners."""
    angle = np.deg2rad(heading)
    ahead, left = np.array([-np.sin(angle), np.cos(angle)]), np.array([-np.cos(angle), -np.sin(angle)])
    corners = [a * ahead + b * left for a, b in polygon]
    inside = np.ones(points.shape[:-1], dtype=bool)
    for a, b in zip(corners, corners[1:] + corners[:1], strict=True):
        inside &= (b[0] - a[0]) * (points[..., 1] - a[1]) - (b[1] - a[1]) * (points[..., 0] - a[0]) >= 0
    return inside


@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize(("marker", "episode"), [("arrow", 1), ("box", 3)])
def test_frames_equal_a_ray_cast_orthographic_camera(seed, marker, episode):
    """At most 1 of 1,000 pixels differs by more than one gray level."""
    mesh = apartment_mesh(seed)
    env = ScanNavEnv(scenes=seed, marker=marker, goals_per_scene=4)
    frame, _ = env.reset(seed=episode)
    factors = env.factors()
    pitch, fine = 6.0 / 128, 0.02
    # The camera's rays: those of the 2 cm lattice that lie in the view, and one more on each side.
    west, north = factors["goal"] + (-3, 3)
    scan = env.batch.scans[0]
    first = np.floor((np.array([west, -north]) + np.array([-scan.origin[0], scan.origin[1]])) / fine).astype(int)
    n = int(6 / fine) + 2
    xs = scan.origin[0] + (first[0] + np.arange(n) + 0.5) * fine
    ys = scan.origin[1] - (first[1] + np.arange(n) + 0.5) * fine
    rays = np.stack(np.meshgrid(xs, ys), axis=-1).reshape(-1, 2)
    colors, height = ray_cast(mesh, rays)
    depth = np.where(np.isnan(height), 0, 255 * np.clip((3 - height) / 3, 0, 1))
    picture = np.column_stack([colors, depth]).reshape(n, n, 4)

    def shares(low_edges, begin):
        """Overlap of each pixel with each ray's own square."""
        low, high = begin + np.arange(128)[:, None] * pitch, begin + (np.arange(128)[:, None] + 1) * pitch
        return np.clip(np.minimum(high, low_edges + fine) - np.maximum(low, low_edges), 0, None) / pitch

    columns, rows = shares(xs - fine / 2, west), shares(-ys - fine / 2, -north)
    expected = np.rint(np.einsum("ri,ijc,kj->crk", rows, picture, columns, optimize=True))
    spots = (np.arange(128 * 4) + 0.5) * pitch / 4
    points = np.stack(np.meshgrid(west + spots, north - spots), axis=-1) - factors["agent"]
    for color, polygon in MARKERS[marker]:
        share = in_polygon(points, polygon, factors["heading"]).reshape(128, 4, 128, 4).mean(axis=(1, 3))
        expected[:3] = expected[:3] * (1 - share) + np.array(color)[:, None, None] * share
        assert share.sum() * pitch**2 > 0.015, "the agent is in the picture"
    wrong = (np.abs(frame - expected) > 1).any(axis=0)
    assert wrong.mean() <= 0.001


def test_area_means():
    """Against a plain loop over overlaps."""
    picture, ratio = np.random.default_rng(0).random((7, 10)), 2.3
    means = area_means(picture, ratio)
    assert means.shape == (4, 5)
    for (i, j), value in np.ndenumerate(means):
        total = 0.0
        for (r, c), color in np.ndenumerate(picture):
            rows = min((i + 1) * ratio, r + 1) - max(i * ratio, r)
            columns = min((j + 1) * ratio, c + 1) - max(j * ratio, c)
            total += color * max(rows, 0) * max(columns, 0)
        assert value == pytest.approx(total / ratio**2)


@pytest.mark.parametrize(("marker", "repeats"), [("arrow", False), ("box", True)])
def test_the_arrow_tells_the_heading(room, marker, repeats):
    env = ScanNavEnv(scenes=room, marker=marker)
    frames = [at(env, (3.0, 3.0), (4.0, 3.0), heading)[0] for heading in (0, 90, 180, 10)]
    assert np.array_equal(frames[0], frames[1]) == repeats
    assert np.array_equal(frames[0], frames[2]) == repeats
    changed = (frames[0] != frames[3]).any(axis=0).sum()
    assert 2 <= changed <= 60
    assert np.array_equal(frames[0][3], frames[1][3]), "depth has no marker"


def test_north_is_up_and_the_goal_in_the_middle(room):
    env = ScanNavEnv(scenes=room)
    start, goal = (4.0, 4.0), (4.0, 3.0)
    frame, other = (at(env, start, goal, heading)[0] for heading in (0, 180))
    rows, columns = np.nonzero((frame != other).any(axis=0))
    placed = env.factors()["goal"]
    assert np.abs(placed - goal).max() <= 6 / 128
    expected = 64 + (np.array(start) - placed) * (128 / 6, -128 / 6)
    assert (columns.mean(), rows.mean()) == pytest.approx(tuple(expected), abs=1.5)


@pytest.mark.parametrize("obs_mode", ["rgb", "rgbd", "dict"])
def test_observation_modes_agree(obs_mode):
    reference, env = (ScanNavEnv(scenes=1, obs_mode=m, goals_per_scene=2, image_size=64) for m in ("rgbd", obs_mode))
    with warnings.catch_warnings():
        # Habitat's depth is float32, which Stable-Baselines3 takes as a plain vector.
        warnings.filterwarnings("ignore", message="It seems that your observation (space )?depth is an image")
        check_env(env)
    expected, seen = reference.reset(seed=1)[0], env.reset(seed=1)[0]
    assert env.observation_space.contains(seen)
    if obs_mode != "dict":
        assert np.array_equal(seen, expected[: len(seen)])
        return
    assert np.array_equal(np.moveaxis(seen["rgb"], -1, 0), expected[:3])
    # Habitat's depth is meters / 10; ours is 255 * meters / 3 (surfaces are all below the camera here).
    assert np.abs(seen["depth"][..., 0] * 10 / 3 * 255 - expected[3]).max() <= 0.5 + 1e-3


# The task.


def test_reward_success_and_spl_are_habitats(room):
    """Straight north: 1.5 m, 6 steps of 0.25 m, with one detour of a step to the east and back."""
    env = ScanNavEnv(scenes=room)
    _, _ = at(env, (4.0, 1.5), (4.0, 3.0))
    goal = env.factors()["goal"]
    d0 = float(env.batch._distance[0])
    assert d0 == pytest.approx(np.hypot(*(goal - (4.0, 1.5))), abs=0.03)
    # To the right nine times, forward, turn round, forward, turn left... back to north.
    script = [3] * 9 + [1] + [2] * 18 + [1] + [3] * 9 + [1] * 6
    rewards, previous, path, position = [], d0, 0.0, env.factors()["agent"]
    for action in script:
        _, reward, terminated, _, info = env.step(action)
        assert reward == pytest.approx(-0.01 + previous - info["distance_to_goal"], abs=1e-12)
        assert not terminated and info["spl"] == 0 and not info["collided"]
        path += float(np.hypot(*(env.factors()["agent"] - position)))
        position, previous = env.factors()["agent"], info["distance_to_goal"]
        rewards.append(reward)
    assert previous < 0.2 and path == pytest.approx(8 * 0.25)
    _, reward, terminated, _, info = env.step(0)
    assert terminated and info["success"] == 1 and info["is_success"] is True
    assert reward == pytest.approx(2.5 - 0.01)
    assert info["spl"] == pytest.approx(d0 / path)
    assert sum(rewards) == pytest.approx(d0 - previous - 0.01 * len(script))


def test_stop_in_the_wrong_place_ends_without_success(room):
    env = ScanNavEnv(scenes=room)
    at(env, (4.0, 1.5), (4.0, 3.0))
    _, reward, terminated, truncated, info = env.step(0)
    assert terminated and not truncated and reward == pytest.approx(-0.01)
    assert not info["is_success"] and info["success"] == info["spl"] == 0


def test_automatic_stop(room):
    env = ScanNavEnv(scenes=room, stop="auto")
    assert env.action_space.n == 3
    at(env, (4.0, 2.5), (4.0, 3.0))
    _, reward, terminated, _, info = env.step(0)
    while not terminated:
        _, reward, terminated, _, info = env.step(0)
    assert info["is_success"] and info["distance_to_goal"] < 0.2 and reward > 2.5


def test_turns_are_ten_degrees(room):
    env = ScanNavEnv(scenes=room)
    at(env, (4.0, 1.5), (4.0, 3.0), heading=5)
    env.step(2)
    assert env.factors()["heading"] == pytest.approx(15)
    for _ in range(2):
        env.step(3)
    assert env.factors()["heading"] == pytest.approx(355)
    before = env.factors()["agent"]
    env.step(1)
    moved = env.factors()["agent"] - before
    assert moved == pytest.approx(0.25 * np.array([np.sin(np.deg2rad(5)), np.cos(np.deg2rad(5))]))


@pytest.mark.parametrize("allow_sliding", [True, False])
def test_walls_and_the_border_of_the_view_stop(allow_sliding):
    # A wall along x at y = 4 m to the north of the start; the view's border 3 m east of the goal.
    env = ScanNavEnv(scenes=empty_room(walls=[np.s_[30:40, :]]), allow_sliding=allow_sliding)
    at(env, (4.0, 3.9), (4.0, 2.5), heading=-45)
    *_, info = env.step(1)
    x, y = env.factors()["agent"]
    assert info["collided"] and 3.95 <= y <= 4.03
    assert (x > 4.15) == allow_sliding
    at(env, (6.0, 2.5), (4.0, 2.5), heading=-90)
    for _ in range(12):
        *_, info = env.step(1)
    assert info["collided"] and 6.5 < env.factors()["agent"][0] < 7.0


def test_distances_against_straight_lines_and_a_corner():
    half = 40
    grid, rng = DistanceGrid(half), np.random.default_rng(0)
    field = grid.distances(np.ones((81, 81), dtype=bool))
    rows, columns = rng.integers(0, 81, (2, 200))
    straight = NODE * np.hypot(rows - half, columns - half)
    assert (field[rows, columns] >= straight - 1e-4).all()
    assert (field[rows, columns] <= straight * 1.0275 + 1e-4).all()
    # A wall to the east of the middle, from the north down to two rows south of it.
    free = np.ones((81, 81), dtype=bool)
    free[: half + 3, half + 10] = False
    expected = NODE * (np.hypot(3, 10) + np.hypot(3, 20))
    assert grid.distances(free)[half, half + 30] == pytest.approx(expected, rel=0.03)
    free[:, half + 10] = False
    assert np.isinf(grid.distances(free)[half, half + 30])


def test_who_starts_at_the_goal_took_the_shortest_path(room):
    env = ScanNavVectorEnv(scenes=room, stop="action", autoreset=False)
    env.reset(seed=0, options={"goal": (4.0, 3.0), "start": (4.0, 3.0)})
    goal = env.factors()["goal"][0].tolist()
    env.reset(seed=0, options={"goal": goal, "start": goal})
    *_, infos = env.step(np.zeros(1, dtype=np.int64))
    assert env._first_distance[0] == 0 and infos["is_success"][0] and infos["spl"][0] == 1


def test_interpolated_distances_are_straight_ones_in_the_open(room):
    env = ScanNavVectorEnv(scenes=room)
    env.reset(seed=0, options={"goal": (4.0, 3.0), "start": (4.0, 2.0)})
    rng = np.random.default_rng(0)
    positions = rng.uniform(-2.2, 2.2, (500, 2))
    distances = env._world.distances(np.repeat(env._field, 500), positions)
    straight = np.hypot(*positions.T)
    assert (distances <= 1.0275 * straight + 0.02).all() and (distances >= straight - 1e-6).all()


@pytest.mark.parametrize("seed", SEEDS)
def test_an_agent_that_knows_the_map_succeeds(seed):
    env = ScanNavVectorEnv(16, 500, scenes=seed, goals_per_scene=25)
    env.reset(seed=0)
    successes, spls = [], []
    while len(successes) < 100:
        _, _, terminated, truncated, infos = env.step(env.oracle_actions())
        ended = terminated | truncated
        successes += infos["success"][ended].tolist()
        spls += infos["spl"][ended].tolist()
    assert np.mean(successes) >= 0.99 and np.mean(spls) >= 0.95


def test_starts_follow_the_rule():
    for min_ratio in (None, 1.1):
        env = ScanNavVectorEnv(200, scenes=2, goals_per_scene=8, min_geodesic=1.5, max_geodesic=4, min_ratio=min_ratio)
        env.reset(seed=0)
        assert (env._distance >= 1.5).all() and (env._distance <= 4).all()
        straight = np.hypot(*(env.factors()["agent"] - env.factors()["goal"]).T)
        detours = (env._distance / straight >= 1.1).mean()
        if min_ratio is None:
            plain = detours
    assert detours > plain + 0.15
    rule = StartRule(1, 30, 1.1)
    weights = rule.weights(np.array([0.5, 2.0, 2.1, 2.4, 31, np.inf]), np.array([0.5, 2.0, 2.0, 2.0, 20, 2.0]))
    assert weights == pytest.approx([0, 20 * 0.02**2, 20 * 0.07**2, 1, 0, 0])


def test_goals_do_not_depend_on_the_order_of_use(room):
    one, other = (ScanNavVectorEnv(scenes=room, goals_per_scene=6) for _ in range(2))
    for k in range(6):
        one._world.prepare_goal(0, k)
    for k in reversed(range(6)):
        other._world.prepare_goal(0, k)
    assert np.array_equal(one._world.corners, other._world.corners)
    assert len(np.unique(one._world.corners[:6], axis=0)) > 3


def test_final_info_has_the_metrics(room):
    env = ScanNavVectorEnv(3, scenes=room)
    at(env, (4.0, 2.9), (4.0, 3.0))
    *_, infos = env.step(np.array([0, 1, 0]))
    assert infos["_final_obs"].tolist() == [True, False, True]
    assert infos["final_info"]["spl"].tolist() == [1.0, 0.0, 1.0] and infos["final_info"]["success"][0] == 1
    assert np.abs(infos["final_info"]["factors"]["agent"][0] - (4.0, 2.9)).max() < 1e-9


def test_scenes_of_every_kind(room, tmp_path):
    room.save(tmp_path / "room.npz")
    assert load_scene(room) is room
    assert load_scene(str(tmp_path / "room.npz")).content_hash == room.content_hash
    env = ScanNavVectorEnv(8, scenes=[tmp_path / "room.npz", 1], goals_per_scene=1)
    env.reset(seed=0)
    assert set(env.factors()["scene"]) == {0, 1}
    assert env.content_hash != ScanNavVectorEnv(scenes=room).content_hash


def test_no_marker_is_larger_than_the_border_allows():
    corners = [corner for parts in MARKERS.values() for _, polygon in parts for corner in polygon]
    assert max(np.hypot(*corner) for corner in corners) <= MARKER_RADIUS


def test_the_marker_is_part_of_the_fingerprint(room, monkeypatch):
    """Datasets of states draw their frames later: another marker would show other pictures."""
    kwargs = {"scenes": room, "goals_per_scene": 1}
    arrow, box = (ScanNavVectorEnv(marker=marker, **kwargs).content_hash for marker in ("arrow", "box"))
    assert arrow != box == ScanNavVectorEnv(marker="box", **kwargs).content_hash
    monkeypatch.setitem(MARKERS, "arrow", MARKERS["box"])
    assert ScanNavVectorEnv(**kwargs).content_hash == box


def test_the_papers_preset():
    env = gym.make("ScanNavPaper-v0", scenes=0, goals_per_scene=1, render_mode="rgb_array")
    frame, _ = env.reset(seed=0)
    assert frame.shape == (4, 256, 256) and env.spec.max_episode_steps == 500
    assert env.unwrapped.batch._world.rule.min_ratio == 1.1 and env.unwrapped.batch._pitch == 10 / 256
    assert env.render().shape == (512, 512, 3)


@pytest.mark.parametrize(("obs_mode", "policy"), [("dict", "MultiInputPolicy"), ("rgbd", "CnnPolicy")])
def test_ppo_learns_from_both_forms(room, obs_mode, policy):
    env = ScanNavEnv(scenes=room, image_size=64, obs_mode=obs_mode)
    model = PPO(policy, env, n_steps=32, batch_size=16, n_epochs=1, device="cpu")
    model.learn(32)
    assert model.predict(env.reset(seed=0)[0])[0] in range(4)
