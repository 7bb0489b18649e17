"""What demonstrations cover: which goals of another split, in words, occur among them and which
never do.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mme_vla.data.hdf5 import list_episodes, open_episode
from mme_vla.data.lerobot_files import SIDE_FILE
from mme_vla.envs.make import make_task
from mme_vla.envs.metadata import EpisodeSpec
from mme_vla.errors import listed
from mme_vla.utils import read_json


def goal_of(spec: EpisodeSpec) -> str:
    """The goal of an episode as policies are told it; its scene is built for that,
    without images.
    """
    env = make_task(spec.task, render=False, **spec.options)
    try:
        goal: str = env.goals()[0].lower()
        return goal
    finally:
        env.close()


def goals_recorded(dataset: Path | None, official: Sequence[Path]) -> dict[str, set[str]]:
    """The goals of a recording, by task: out of its dataset, or of its official files where there
    is none.
    """
    goals: dict[str, set[str]] = {}
    if dataset is not None:
        side = read_json(dataset / SIDE_FILE, "the facts of a recorded dataset")
        for episode in side["episodes"]:
            goals.setdefault(episode["task"], set()).add(episode["goals"][0])
        return goals
    for ref in list_episodes(official):
        with open_episode(ref) as opened:
            goals.setdefault(ref.task, set()).add(opened.goals[0])
    return goals


@dataclass
class TaskCoverage:
    """Of one task: how many goals and episodes there are, and the numbers of the episodes whose
    goal is missing.
    """

    goals: int = 0
    episodes: int = 0
    missing: dict[str, list[int]] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """Plain values, fit for JSON."""
        return {
            "goals": self.goals,
            "goals_covered": self.goals - len(self.missing),
            "episodes": self.episodes,
            "episodes_covered": self.episodes - sum(map(len, self.missing.values())),
            "missing": self.missing,
        }


def compare(
    recorded: Mapping[str, set[str]], requested: Iterable[tuple[EpisodeSpec, str]]
) -> dict[str, TaskCoverage]:
    """Which of the goals of episodes were recorded, by task.

    Args:
        recorded: goals by task.
        requested: episodes with their goals.
    """
    coverage: dict[str, TaskCoverage] = {}
    known_goals: dict[str, set[str]] = {}
    for spec, goal in requested:
        task = coverage.setdefault(spec.task, TaskCoverage())
        task.episodes += 1
        if goal not in recorded.get(spec.task, set()):
            task.missing.setdefault(goal, []).append(spec.episode)
        if goal not in known_goals.setdefault(spec.task, set()):
            known_goals[spec.task].add(goal)
            task.goals += 1
    return coverage


def in_words(coverage: Mapping[str, TaskCoverage]) -> str:
    """A line a task, and the missing goals of the split `test` under it."""
    lines = []
    for name, task in coverage.items():
        counts = task.to_dict()
        lines.append(
            f"{name}: {counts['goals_covered']} of {task.goals} goals of 'test',"
            f" {counts['episodes_covered']} of {task.episodes} episodes"
        )
        for goal, numbers in task.missing.items():
            lines.append(f"  never shown: {goal} (episode {listed(numbers, 5)})")
    return "\n".join(lines)
