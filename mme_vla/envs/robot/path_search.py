"""A path for the arm found by sampling: RRT* in joint space, with a coarse idea of what is in the way.

In the way are the table and the robot's own column. The tool may go as low as its start or its goal does.
"""

import numpy as np

from mme_vla.envs.robot.kinematics import Arm

RESOLUTION = 0.05
"""Joint distance between two configurations that are checked on an edge, radians."""
REACH = 0.5
"""Longest edge that the tree grows, radians."""
GOAL_BIAS = 0.2
ROUNDS = 1500
"""Samples drawn in one attempt; a number, not a time, so that the same seed gives the same path."""
WRIST_CLEARANCE = 0.03
COLUMN_RADIUS, COLUMN_HEIGHT = 0.15, 0.45
"""The robot's base and shoulder as a cylinder that the hand keeps out of, metres."""


class Obstacles:
    """Tells whether the arm is clear of the table and of itself.

    Args:
        arm: the kinematic model.
        ends: configurations [7] that are allowed whatever they touch: start and goal.
    """

    def __init__(self, arm: Arm, ends: list[np.ndarray]) -> None:
        self._arm = arm
        self._floor = min([0.0, *(arm.forward_in_base(end).p[2] + arm.base.p[2] for end in ends)]) - 1e-3

    def clear(self, joints: np.ndarray) -> bool:
        """Whether one configuration [7] is free."""
        tool, wrist = self._arm.forward_in_base(joints), self._arm.wrist_in_base()
        height = self._arm.base.p[2]
        in_column = any(np.linalg.norm(p[:2]) < COLUMN_RADIUS and p[2] < COLUMN_HEIGHT for p in (tool.p, wrist.p))
        return bool(tool.p[2] + height >= self._floor and wrist.p[2] + height >= WRIST_CLEARANCE) and not in_column

    def clear_between(self, a: np.ndarray, b: np.ndarray) -> bool:
        """Whether the straight joint path between two configurations is free, the first one not examined."""
        steps = max(1, int(np.ceil(np.linalg.norm(b - a) / RESOLUTION)))
        return all(self.clear(a + (b - a) * i / steps) for i in range(1, steps + 1))


def sample_path(arm: Arm, start: np.ndarray, goal: np.ndarray, seed: int) -> np.ndarray | None:
    """Joint waypoints [k, 7] from start to goal: the straight line if it is free, else what RRT* finds.

    Karaman and Frazzoli 2011: a random tree whose nodes hang on the cheapest free neighbour and are hung up again
    where a newer node offers a shorter way.

    Args:
        arm: the kinematic model.
        start: joint angles [7]. goal: likewise.
        seed: of the samples.

    Returns:
        The path, or None when the rounds are used up.
    """
    obstacles = Obstacles(arm, [start, goal])
    if obstacles.clear_between(start, goal):
        return np.array([start, goal])
    random = np.random.default_rng(seed)
    tree = _Tree(start, obstacles)
    for _ in range(ROUNDS):
        sample = goal if random.random() < GOAL_BIAS else random.uniform(arm.lower, arm.upper)
        tree.grow(sample)
    path = tree.path_to(goal)
    return None if path is None else np.array(_shortened(path, obstacles))


def _shortened(path: list[np.ndarray], obstacles: Obstacles) -> list[np.ndarray]:
    """Leave out what a straight line can skip, then space the rest evenly, so that a spline stays near it."""
    points, i = [path[0]], 0
    while i < len(path) - 1:
        free = (j for j in range(len(path) - 1, i + 1, -1) if obstacles.clear_between(path[i], path[j]))
        j = next(free, i + 1)
        steps = int(np.ceil(np.linalg.norm(path[j] - path[i]) / REACH))
        points += [path[i] + (path[j] - path[i]) * k / steps for k in range(1, steps)] + [path[j]]
        i = j
    return points


class _Tree:
    def __init__(self, root: np.ndarray, obstacles: Obstacles) -> None:
        self.nodes, self.parents, self.costs = [root], [-1], [0.0]
        self._obstacles = obstacles

    def grow(self, sample: np.ndarray) -> None:
        """Add a node on the way from the nearest one to the sample, if that way is free."""
        distances = self._distances(sample)
        nearest = int(np.argmin(distances))
        if distances[nearest] == 0:
            return
        way = sample - self.nodes[nearest]
        node = self.nodes[nearest] + way * min(1.0, REACH / distances[nearest])
        if not self._obstacles.clear_between(self.nodes[nearest], node):
            return
        near = [i for i in np.flatnonzero(self._distances(node) <= REACH) if i != nearest]
        parent, cost = nearest, self._cost_via(nearest, node)
        for i in near:
            if self._cost_via(i, node) < cost and self._obstacles.clear_between(self.nodes[i], node):
                parent, cost = int(i), self._cost_via(i, node)
        self.nodes.append(node)
        self.parents.append(parent)
        self.costs.append(cost)
        self._rewire(near)

    def path_to(self, goal: np.ndarray) -> list[np.ndarray] | None:
        """The way from the root to a node that is the goal."""
        distances = self._distances(goal)
        node = int(np.argmin(distances))
        if distances[node] > 1e-9:
            return None
        path = []
        while node >= 0:
            path.append(self.nodes[node])
            node = self.parents[node]
        return path[::-1]

    def _rewire(self, near: list[int]) -> None:
        new = len(self.nodes) - 1
        for i in near:
            cost = self._cost_via(new, self.nodes[i])
            if cost < self.costs[i] and self._obstacles.clear_between(self.nodes[new], self.nodes[i]):
                self._lower(i, self.costs[i] - cost)
                self.parents[i] = new

    def _lower(self, node: int, gain: float) -> None:
        self.costs[node] -= gain
        for child in [i for i, parent in enumerate(self.parents) if parent == node]:
            self._lower(child, gain)

    def _cost_via(self, parent: int, node: np.ndarray) -> float:
        return self.costs[parent] + float(np.linalg.norm(node - self.nodes[parent]))

    def _distances(self, sample: np.ndarray) -> np.ndarray:
        return np.linalg.norm(np.array(self.nodes) - sample, axis=1)
