"""Helpers of the tests of the two stick tasks: a tip that is where it is told to be, and the stream of draws."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest
import sapien
import torch

from helpers.env_scenes import recorded, setup
from mme_vla.envs.robot.demonstrator import arc
from mme_vla.envs.scene.placement import Draws
from mme_vla.envs.scene.things import Thing
from mme_vla.envs.task import Task

Flags = tuple[bool, bool]
"""Success and failure at an evaluation."""
Z = 0.07


class Tip:
    """Stands in for the tool centre point; an evaluation means a step."""

    def __init__(self, env: Task, monkeypatch: pytest.MonkeyPatch) -> None:
        self._env, self._place = env, [0.4, 0.4, Z]
        monkeypatch.setattr(type(env), "tcp_pose", property(lambda _: sapien.Pose(self._place)))

    def put(self, place: Thing | Sequence[float], z: float = Z, aside: Sequence[float] = (0, 0)) -> Flags:
        """Be at a place, or beside it by some metres in x and y, and evaluate."""
        xy = np.asarray(place.position if isinstance(place, Thing) else place)[:2] + aside
        self._place = [*xy, z]
        info = self._env.evaluate()
        return bool(info["success"]), bool(info["fail"])

    def back_to_start(self, first: Thing) -> None:
        """What the demonstrator does after the video, with an arm that never left home."""
        self._env.after_video, self._env.stored_qpos = True, self._env.qpos
        self.put((0.4, 0.4))
        self.put(first)


class Ear:
    """A demonstrator that only notes where it was asked to go."""

    def __init__(self) -> None:
        self.calls: list[tuple] = []

    def stick_to(self, target: Thing) -> None:
        self.calls.append((target,))

    def stick_arc(self, target: Thing, direction: str) -> None:
        self.calls.append((target, direction))


def circle(tip: Tip, start: Thing, goal: Thing, direction: str) -> Flags:
    """Follow the demonstrator's arc; the flags at its end."""
    return [tip.put(point) for point in arc(start.position, goal.position, direction)][-1]


def say(side: str, direction: str) -> str:
    """The text of a move."""
    return f"move to the nearest {side} target by circling around the stick {direction}"


def recorded_moves(folder: Path, task: str, episode: int) -> tuple[int, str, list[str]]:
    """Seed, difficulty and the texts of the moves of an official episode, those of the video first."""
    seed, difficulty = setup(folder, task, episode, "seed"), setup(folder, task, episode, "difficulty")
    texts = recorded(folder, task, episode, "info/simple_subgoal")
    starts = recorded(folder, task, episode, "info/is_subgoal_boundary")
    moves = [text.decode() for text, start in zip(texts, starts, strict=True) if start]
    return int(seed), difficulty.decode(), [text for text in moves if text.startswith("move ")]


def read_path(seed: int, n: int, lengths: set[int]) -> list[int]:
    """The path by a search with a stack of what is still to be tried, from a fresh generator."""
    generator = torch.Generator().manual_seed(seed)

    def around(node: int) -> Iterator[int]:
        row, column = divmod(node, n)
        steps = [(-1, 0), (1, 0), (0, -1), (0, 1), (-1, -1), (-1, 1), (1, -1), (1, 1)]
        inside = [(row + r) * n + column + c for r, c in steps if 0 <= row + r < n and 0 <= column + c < n]
        return iter([inside[i] for i in torch.randperm(len(inside), generator=generator)])

    while True:
        start, goal = torch.randperm(n * n, generator=generator)[:2].tolist()
        path, visited, untried = [start], {start}, [around(start)]
        while path[-1] != goal:
            following = next((node for node in untried[-1] if node not in visited), None)
            if following is None:
                path.pop(), untried.pop()
                continue
            path.append(following), visited.add(following)
            if following != goal:
                untried.append(around(following))
        if len(path) in lengths:
            return path


def read_route(stream: Draws, moves: tuple[int, int], may_return: bool) -> tuple[list[int], list[str]]:
    """Read the indices of a route and the sense of each turn from a stream."""
    count = stream.integer(moves[0], moves[1] + 1)
    route = [stream.integer(0, 5)]
    for _ in range(count):
        came_from = route[-2] if len(route) > 1 and 0 < route[-1] < 4 and not may_return else None
        ways = [i for i in (route[-1] - 1, route[-1] + 1) if 0 <= i < 5 and i != came_from]
        route.append(ways[stream.integer(0, len(ways))])
    return route, ["clockwise" if stream.uniform() < 0.5 else "counterclockwise" for _ in range(count)]
