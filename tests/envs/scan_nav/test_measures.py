"""Reward, success and SPL of ScanNav beside habitat-lab's measures, written here once more from their definitions.

habitat-lab (habitat/tasks/nav/nav.py and the RL environment's rewards): ``DistanceToGoal`` is the geodesic distance;
``Success`` is 1 if stop was called at a distance below 0.2 m; ``SPL`` adds up the Euclidean length of every step and is
``success * start_end_distance / max(start_end_distance, agent_distance)``; ``DistanceToGoalReward`` is minus the change
of the distance; the reward is slack + that + 2.5 * success. Distances come from a walk over the grid with a heap.
"""

import heapq
import math

import numpy as np
import pytest
from scan_inputs import empty_room

from sb3_abisim.envs.scan_nav.env import ScanNavEnv

NODE = 0.05


class Walk:
    """Geodesic distances to a goal inside its view, from the map alone; 16 directions on nodes 5 cm apart."""

    def __init__(self, scan, goal, reach):
        self.goal, half = goal, int(reach / NODE)

        def free(i, j):
            if max(abs(i), abs(j)) > half:
                return False
            # Node (i, j) lies i to the east and j to the north of the goal.
            row = math.floor((scan.origin[1] - goal[1] - j * NODE) / scan.meters_per_pixel + 1e-9)
            column = math.floor((goal[0] + i * NODE - scan.origin[0]) / scan.meters_per_pixel + 1e-9)
            height, width = scan.walkable.shape
            return 0 <= row < height and 0 <= column < width and bool(scan.walkable[row, column])

        self.distance = {}
        heap = [(0.0, 0, 0)]
        while heap:
            d, i, j = heapq.heappop(heap)
            if (i, j) in self.distance:
                continue
            self.distance[i, j] = d
            for di in range(-2, 3):
                for dj in range(-2, 3):
                    # King's and knight's moves; both nodes that the way passes by must be free as well.
                    if math.gcd(di, dj) != 1:
                        continue
                    far, near = max(abs(di), abs(dj)), min(abs(di), abs(dj))
                    passed = []
                    if far == 1 and near == 1:
                        passed = [(di, 0), (0, dj)]
                    elif far == 2:
                        one = (int(math.copysign(abs(di) == 2, di)), int(math.copysign(abs(dj) == 2, dj)))
                        passed = [one, (int(np.sign(di)), int(np.sign(dj)))]
                    if free(i + di, j + dj) and all(free(i + a, j + b) for a, b in passed):
                        heapq.heappush(heap, (d + NODE * math.hypot(di, dj), i + di, j + dj))

    def __call__(self, position):
        """Between four nodes bilinear, beside obstacles the best way over one of them."""
        x, y = ((position[k] - self.goal[k]) / NODE for k in (0, 1))
        i, j = math.floor(x), math.floor(y)
        corners = [(i + a, j + b) for a in (0, 1) for b in (0, 1)]
        known = [node for node in corners if node in self.distance]
        if len(known) == 4:
            return sum(self.distance[n] * (1 - abs(x - n[0])) * (1 - abs(y - n[1])) for n in corners)
        return min(self.distance[n] + NODE * math.hypot(x - n[0], y - n[1]) for n in known)


class Measures:
    """One episode of habitat-lab's measures."""

    def __init__(self, walk, position):
        self.walk, self.previous_position = walk, position
        self.start_end_distance = self.previous_distance = walk(position)
        self.agent_distance = 0.0

    def update(self, position, stop_called):
        distance = self.walk(position)
        self.agent_distance += math.dist(position, self.previous_position)
        success = 1.0 if stop_called and distance < 0.2 else 0.0
        spl = success * (self.start_end_distance / max(self.start_end_distance, self.agent_distance))
        reward = -0.01 + (self.previous_distance - distance) + 2.5 * success
        self.previous_position, self.previous_distance = position, distance
        return distance, reward, success, spl


@pytest.mark.parametrize("player", ["random", "oracle", "clumsy"])
def test_rewards_success_and_spl_are_those_of_habitats_measures(player):
    """A room with walls and a door, where ways are no straight lines and agents bump and slide."""
    scan = empty_room(walls=[np.s_[50:54, :70], np.s_[50:54, 82:], np.s_[54:80, 78:82]])
    env, rng = ScanNavEnv(scenes=scan, goals_per_scene=3, min_ratio=1.1), np.random.default_rng(1)
    env.reset(seed=5)
    walks, n_successes, n_detours, n_collisions = {}, 0, 0, 0
    for _ in range(12):
        env.reset()
        factors = env.factors()
        goal = tuple(factors["goal"])
        if goal not in walks:
            walks[goal] = Walk(scan, goal, 3 - 0.25 - 2 * 6 / 128)
        measures = Measures(walks[goal], tuple(factors["agent"]))
        n_detours += measures.start_end_distance > 1.1 * math.dist(factors["agent"], factors["goal"])
        for step in range(120):
            action = env.oracle_action()
            if player == "random" or (player == "clumsy" and rng.random() < 0.4):
                action = int(rng.integers(1, 4)) if step < 60 else 0
            _, reward, terminated, _, info = env.step(action)
            expected = measures.update(tuple(env.factors()["agent"]), action == 0)
            seen = info["distance_to_goal"], reward, info["success"], info["spl"]
            assert seen == pytest.approx(expected, abs=1e-5), "distances are kept as float32"
            n_collisions += info["collided"]
            if terminated:
                break
        assert terminated and action == 0
        n_successes += info["success"]
    assert n_detours >= 3
    assert n_successes >= (0 if player == "random" else 6) and (player == "oracle" or n_collisions >= 5)
