"""Shortest paths in the rooms of PointMaze, and what is blocked in them."""

import numpy as np
from numpy.typing import NDArray

from sb3_abisim.envs.point_maze.layout import OBSTACLE_PIXELS, PIXELS_PER_METER, ROOM_SIZE
from sb3_abisim.envs.shortest_paths import DistanceFields, ShortestPaths, open_distances

# m between neighboring nodes, half a pixel: edges of obstacles and goals lie on nodes.
NODE = 0.125
# Of each discrete action in turn: up, down, left, right.
_HEADINGS = np.array((0.0, 180.0, 90.0, 270.0))  # degrees, 0 is up and 90 left
_HALF_OBSTACLE = OBSTACLE_PIXELS / PIXELS_PER_METER / 2  # m
# Rooms have y down, grids have it to the north.
_FLIP = np.array((1.0, -1.0))


def solid_within(points: NDArray[np.float64], obstacles: NDArray[np.float64], margin: float = 0.0) -> NDArray[np.bool_]:
    """Whether points lie in an obstacle or outside the room, both grown by a margin.

    :param points: (x, y) in m, y down, (n, n_points, 2)
    :param obstacles: (x, y) of their centers, (n, n_obstacles, 2)
    :param margin: in m
    :return: (n, n_points)
    """
    x, y = np.moveaxis(points, -1, 0)
    room, reach = ROOM_SIZE / 2 - margin, _HALF_OBSTACLE + margin
    solid: NDArray[np.bool_] = (np.abs(x) > room) | (np.abs(y) > room)
    for center_x, center_y in obstacles.transpose(1, 2, 0)[..., None]:
        solid |= (np.abs(x - center_x) < reach) & (np.abs(y - center_y) < reach)
    return solid


def find_paths(
    agents: NDArray[np.float64],
    obstacles: NDArray[np.float64],
    goals: NDArray[np.float64],
    radius: float,
    push: float,
) -> ShortestPaths:
    """How far the goals are for the agents' centers, and which pushes bring them closer.

    A push leads straight ahead, up to what is in the way. It is optimal if it shortens the way by more than
    :data:`NODE`. Distances are those of a :class:`~sb3_abisim.envs.shortest_paths.DistanceGrid`.

    :param agents: (x, y) in m, y down, (n, 2)
    :param obstacles: (x, y) of their centers, (n, n_obstacles, 2)
    :param goals: (n, 2)
    :param radius: of the agent, by which obstacles and walls are grown
    :param push: how far one leads in the open, in m
    """
    half = int(ROOM_SIZE / 2 / NODE)
    axis = np.arange(-half, half + 1) * NODE
    nodes = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(1, -1, 2)
    fields = DistanceFields(half, NODE, 1)
    optimal, geodesic = np.zeros((len(agents), len(_HEADINGS)), dtype=bool), np.zeros(len(agents))
    layouts = np.concatenate([obstacles, goals[:, None]], axis=1).reshape(len(agents), -1)
    _, which = np.unique(layouts, axis=0, return_inverse=True)
    for layout in range(which.max() + 1):
        (here,) = np.nonzero(which == layout)
        free = ~solid_within(nodes, obstacles[here[:1]], radius).reshape(len(axis), len(axis))
        fields.set_field(0, free, goals[here[0]] * _FLIP)
        places = agents[here] * _FLIP
        geodesic[here] = fields.distances(np.zeros(len(here), dtype=np.int64), places)
        only = np.zeros(len(here) * len(_HEADINGS), dtype=np.int64)
        starts, headings = places.repeat(len(_HEADINGS), axis=0), np.tile(_HEADINGS, len(here))
        ends, _ = fields.moves(only, starts, headings, push, sliding=False)
        left = fields.distances(only, ends).reshape(len(here), len(_HEADINGS))
        optimal[here] = left < geodesic[here, None] - NODE
    return ShortestPaths(optimal, geodesic, open_distances(agents - goals))
