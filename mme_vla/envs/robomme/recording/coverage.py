"""What demonstrations cover: which goals of another split, in words, occur among them and which
never do.
"""

from collections.abc import Iterable, Mapping, Sequence
from contextlib import closing
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
    with closing(make_task(spec.task, render=False, **spec.options)) as env:
        goal: str = env.goals()[0].lower()
        return goal


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


def compare(
    recorded: Mapping[str, set[str]], requested: Iterable[tuple[EpisodeSpec, str]]
) -> dict[str, dict[str, Any]]:
    """Which of the goals of episodes were recorded, by task: plain values, fit for JSON.

    Args:
        recorded: goals by task.
        requested: episodes with their goals.

    Returns:
        Of each task the numbers of goals and of episodes, how many of them are covered, and the
        missing goals, each with the numbers of its episodes.
    """
    numbers: dict[str, dict[str, list[int]]] = {}
    for spec, goal in requested:
        numbers.setdefault(spec.task, {}).setdefault(goal, []).append(spec.episode)
    coverage = {}
    for task, goals in numbers.items():
        missing = {goal: i for goal, i in goals.items() if goal not in recorded.get(task, ())}
        episodes = sum(map(len, goals.values()))
        coverage[task] = {
            "goals": len(goals),
            "goals_covered": len(goals) - len(missing),
            "episodes": episodes,
            "episodes_covered": episodes - sum(map(len, missing.values())),
            "missing": missing,
        }
    return coverage


def in_words(coverage: Mapping[str, Mapping[str, Any]]) -> str:
    """A line a task, and the missing goals of the split `test` under it."""
    lines = []
    for name, counts in coverage.items():
        lines.append(
            f"{name}: {counts['goals_covered']} of {counts['goals']} goals of 'test',"
            f" {counts['episodes_covered']} of {counts['episodes']} episodes"
        )
        for goal, numbers in counts["missing"].items():
            lines.append(f"  never shown: {goal} (episode {listed(numbers, 5)})")
    return "\n".join(lines)
