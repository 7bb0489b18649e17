"""The grammar of `tasks=`, `episodes=` and `split=`, the same for all commands."""

import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from mme_vla.envs.base import environment
from mme_vla.envs.metadata import EpisodeSpec
from mme_vla.errors import UserError, require

ALL = "all"
GRAMMAR = (
    "3 for the first three, [3] for number three, 0-9 for a range, [0-3,7] for several, or all"
)


def choose_tasks(tasks: str | Sequence[str], env: str = "mme_vla") -> list[str]:
    """Names of tasks in the order they are named, each once.

    Args:
        tasks: `all` of the environment, a name, several in one text (`StopCube,BinFill`), or a list
            of names. A suite or another group that the environment declares names those of its
            tasks that can be built here. Tasks of the user's own need the plugin that registers
            them.
        env: the environment.
    """
    if isinstance(tasks, str):
        tasks = tasks.split(",")
    source = environment(env)
    known = list(source.tasks)
    groups: dict[str, Sequence[str]] = {ALL: known, **source.suites}
    for grouping in source.groupings.values():
        groups |= grouping
    names: list[str] = []
    for word in tasks:
        name = str(word).strip()
        members = groups.get(name, [name])
        # Where none can be built, the check of the first one says what it lacks.
        names += [task for task in members if task in known] or members
    for name in names:
        source.check_task(name)
    once = names and len(set(names)) == len(names)
    require(once, f"tasks={tasks} must name each task once, and at least one.")
    return names


def check_episodes(episodes: Any, key: str = "episodes") -> None:
    """Refuse what `choose_numbers` does not understand, before it is known how many there are.

    key: for the message.
    """
    if _are_all(episodes) or type(episodes) is int:
        return
    spans(episodes, key, GRAMMAR)


def _are_all(episodes: Any) -> bool:
    return episodes is None or (isinstance(episodes, str) and episodes == ALL)


def choose_numbers(
    episodes: Any, count: int, what: str = "the split", key: str = "episodes"
) -> list[int]:
    """Numbers of episodes.

    Args:
        episodes: None or `all` for all there are, a number for the first so many, a list of
            numbers, or text of numbers and ranges (`0-9`, `0-3,7`). `[3]` is episode number three
            alone, `3` the first three.
        count: of episodes in `what`, which messages name.
        key: of the value, for messages.
    """
    if _are_all(episodes):
        return list(range(count))
    if isinstance(episodes, int) and not isinstance(episodes, bool):
        problem = f"{key}={episodes} means the first {episodes}; {what} has {count}."
        if 0 <= episodes < count:
            problem += f" For number {episodes} alone write {key}=[{episodes}]."
        require(1 <= episodes <= count, problem)
        return list(range(episodes))
    ranges = spans(episodes, key, GRAMMAR)
    last = max((span.stop for span in ranges), default=0) - 1
    require(
        last < count, f"There is no episode {last} in {what}, which has {count}: 0 to {count - 1}."
    )
    numbers = [number for span in ranges for number in span]
    once = numbers and len(set(numbers)) == len(numbers)
    require(once, f"{key}={episodes} must name each episode once, and at least one.")
    return numbers


def read_episodes(text: str) -> Any:
    """The value of `--episodes`, as `episodes=` of a configuration has it: a number is the first so
    many, brackets are a list, anything else stays text.
    """
    text = text.strip()
    if text.isdecimal():
        return int(text)
    if text.startswith("[") and text.endswith("]"):
        return [part.strip() for part in text[1:-1].split(",")]
    return text


def choose_episodes(
    tasks: str | Sequence[str] = ALL,
    episodes: Any = None,
    split: str = "test",
    env: str = "mme_vla",
) -> list[EpisodeSpec]:
    """The episodes of a run, task by task."""
    specs = []
    for task in choose_tasks(tasks, env):
        known = environment(env).episodes(task, split)
        numbers = choose_numbers(episodes, len(known), f"{task} in {split!r}")
        specs += [known[number] for number in numbers]
    return specs


def named_tasks(config: Mapping[str, Any]) -> str | list[str]:
    """The value of `tasks=`, or of `task=`, which means the same."""
    names: Any = config.get("tasks")
    task = config.get("task")
    if task is not None:
        is_one = names in (None, ALL, task)
        require(is_one, f"tasks={names} and task={task} mean the same: give one of them.")
        names = task
    require(
        names is not None, "Name the tasks: tasks=StopCube, tasks=[StopCube,BinFill] or tasks=all."
    )
    if isinstance(names, str):
        return names
    return [str(name) for name in names]


def spans(value: Any, key: str, grammar: str) -> list[range]:
    """Read numbers and ranges: text such as `0-9` or `0-3,7`, or a list of such.

    Args:
        key, grammar: for messages.
    """
    parts: Sequence[Any] = [None]
    if isinstance(value, str):
        parts = value.split(",")
    elif isinstance(value, Iterable):
        parts = list(value)
    ranges = []
    for part in parts:
        match = re.fullmatch(r"\s*(\d{1,9})\s*(?:-\s*(\d{1,9})\s*)?", str(part))
        if match is None or isinstance(part, bool | float):
            raise UserError(f"{key}={value!r} is not understood; write {grammar}.")
        first = int(match[1])
        last = int(match[2] or match[1])
        require(first <= last, f"{key}={value}: the range {part} ends before it begins.")
        ranges.append(range(first, last + 1))
    return ranges
