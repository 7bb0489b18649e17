"""PatternLock (Imitation): the video traces a path over a grid of discs with the stick; trace it
again.
"""

import itertools
import math
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from mme_vla.envs.robomme.robot.demonstrator import Demonstrator
from mme_vla.envs.robomme.scene.objects import Disc, build_disc
from mme_vla.envs.robomme.scene.placement import Draws, SceneError
from mme_vla.envs.robomme.scene.things import distance_xy
from mme_vla.envs.robomme.tasks import register_task
from mme_vla.envs.robomme.tasks.families.stick import StickTask
from mme_vla.envs.subtasks import Choice, SubTask

GRID = {"easy": 3, "medium": 4, "hard": 5}
PATH_LENGTH = {"easy": (2, 4), "medium": (3, 5), "hard": (4, 8)}
CENTRE, SPACING = (-0.1, 0.0), 0.1
NEIGHBOURS = ((-1, 0), (1, 0), (0, -1), (0, 1), (-1, -1), (-1, 1), (1, -1), (1, 1))  # (row, column)
TRIES = 1000
DIRECTIONS = {
    "forward": (1, 0),
    "backward": (-1, 0),
    "left": (0, 1),
    "right": (0, -1),
    "forward-left": (1, 1),
    "forward-right": (1, -1),
    "backward-left": (-1, 1),
    "backward-right": (-1, -1),
}
"""Signs of the way in x and y, as the robot sees them."""
LETTERS = dict(zip(DIRECTIONS, "abcdefgh", strict=True))
REACH = 0.2  # how far away the disc a direction means may lie


@register_task
class PatternLock(StickTask):
    """Rows of the grid run along x, columns along y."""

    def build(self, draws: Draws) -> None:
        n = GRID[self.difficulty]
        middle = (n - 1) / 2
        self.discs: list[Disc] = []
        for row, column in np.ndindex(n, n):
            x = CENTRE[0] + (row - middle) * SPACING
            y = CENTRE[1] + (column - middle) * SPACING
            name = f"disc_{len(self.discs)}"
            self.discs.append(self.add(build_disc(self, name, 0.02, 0.01, "gray", (x, y))))
        nodes = self.values.indices("actions.path_nodes", lambda: self._draw_path(draws, n), n * n)
        steps = [np.subtract(divmod(a, n), divmod(b, n)) for a, b in itertools.pairwise(nodes)]
        self.values.require(
            steps and all(np.abs(step).max() <= 1 for step in steps),
            "actions.path_nodes",
            f"is {nodes}; expected a path over neighbours, {n} a row",
        )
        self.path = [self.discs[i] for i in nodes]
        self.add_marks()

    def _draw_path(self, draws: Draws, n: int) -> list[int]:
        low, high = PATH_LENGTH[self.difficulty]
        low += self.turned("path")
        high += self.turned("path")
        for _ in range(TRIES):
            start, goal = draws.permutation(n * n)[:2]
            path = search(draws, n, start, goal, {start})
            if path is not None and low <= len(path) <= high:
                return path
        raise SceneError(f"{self.where}: no path of {low} to {high} discs in {TRIES} tries.")

    def flip_fact(self) -> dict[str, Any] | None:
        """Another path of the same length from the same disc, with another first move; None where
        none is found.
        """
        n = GRID[self.difficulty]
        nodes = [self.discs.index(disc) for disc in self.path]
        draws = Draws(self.seed)
        for _ in range(TRIES):
            goal = draws.integer(0, n * n)
            other = search(draws, n, nodes[0], goal, {nodes[0]}) or []
            if len(other) == len(nodes) and other[1] != nodes[1]:
                return self.values.changed({"actions.path_nodes": other})
        return None

    def beside(self, here: Disc) -> list[Disc]:
        nearest = SPACING * math.sqrt(2) + 1e-6
        neighbours = []
        for disc in self.discs:
            if disc is not here and distance_xy(disc.position, here.position) < nearest:
                neighbours.append(disc)
        return neighbours

    def start_episode(self, draws: Draws) -> None:
        super().start_episode(draws)
        self.visited: list[Disc] = []

    def failure(self) -> bool:
        """Remembers which discs were visited; the rules belong to the moves."""
        current = self.progress.current
        if current is None or not current.video:
            for disc in self.discs:
                if self.visited_now(disc) and self.visited[-1:] != [disc]:
                    self.visited.append(disc)
        return False

    def success(self) -> bool:
        return self.progress.succeeded and self.visited[-len(self.path) :] == self.path

    def moves(self, video: bool) -> list[SubTask]:
        return [self._move(*leg, video) for leg in itertools.pairwise(self.path)]

    def _move(self, previous: Disc, goal: Disc, video: bool) -> SubTask:
        others = [disc for disc in self.discs if disc is not previous and disc is not goal]
        word = direction(goal.position - previous.position)
        return SubTask(
            f"move {word}",
            done=lambda: self.visited_now(goal),
            run=lambda demo: demo.stick_to(goal),
            failed=lambda: any(self.visited_now(disc) for disc in others),
            choice=LETTERS[word],
            video=video,
            operation="order",
        )

    def choices(self) -> list[Choice]:
        return [
            Choice(letter, f"move {word}", partial(self._go, word))
            for word, letter in LETTERS.items()
        ]

    def _go(self, word: str, demo: Demonstrator, _: None) -> None:
        tcp = self.tcp_pose.p
        here = min(self.discs, key=lambda disc: distance_xy(disc.position, tcp))
        goal = self.disc_towards(here, word)
        if goal is not None:
            demo.stick_to(goal)

    def disc_towards(self, here: Disc, word: str) -> Disc | None:
        """The disc within reach that lies in a direction: the best aligned, then the
        nearest one.
        """
        signs = np.array(DIRECTIONS[word])
        way = signs / np.linalg.norm(signs)
        best: Disc | None = None
        least = (math.inf, math.inf)
        for disc in self.discs:
            step = disc.position[:2] - here.position[:2]
            length = float(np.linalg.norm(step))
            on_side = all(s == 0 or s * d > 1e-6 for s, d in zip(signs, step, strict=True))
            if disc is here or not on_side or length > REACH + 1e-6:
                continue
            preference = (round(-float(step @ way) / length, 6), length)
            if preference < least:
                best, least = disc, preference
        return best

    def goals(self) -> list[str]:
        goal = (
            "watch the video carefully, then use the stick attached to the robot to retrace the"
            " same pattern"
        )
        if self.in_view:
            legs = itertools.pairwise(self.path)
            moves = [f"move {direction(b.position - a.position)}" for a, b in legs]
            goal = f"{goal}: {', then '.join(moves)}"
        return [goal, f"{goal} shown in the video"]


def search(draws: Draws, n: int, node: int, goal: int, visited: set[int]) -> list[int] | None:
    """A path over the 8-neighbourhood of an n × n grid by depth-first search in random order."""
    if node == goal:
        return [node]
    row, column = divmod(node, n)
    neighbours = [
        (row + r) * n + column + c
        for r, c in NEIGHBOURS
        if 0 <= row + r < n and 0 <= column + c < n
    ]
    for i in draws.permutation(len(neighbours)):
        following = neighbours[i]
        if following not in visited:
            visited.add(following)
            path = search(draws, n, following, goal, visited)
            if path is not None:
                return [node, *path]
    return None


def direction(way: Sequence[float] | np.ndarray) -> str:
    """The compass word of a way [2 or more]: +x is forward, +y is left."""
    signs = tuple(0 if abs(d) < 1e-6 else int(np.sign(d)) for d in way[:2])
    return next(word for word, s in DIRECTIONS.items() if s == signs)
