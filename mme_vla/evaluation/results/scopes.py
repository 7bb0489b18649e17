"""What a whole run consists of, and the sets of tasks that figures are made over."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, Self

from mme_vla.errors import counted, require
from mme_vla.evaluation.records import EpisodeKey, EpisodeRecord

SUITES = ("Counting", "Permanence", "Reference", "Imitation")
GROUPS = (
    "Motion-Centric",
    "Time-Sensitive",
    "Short-Horizon Video Reasoning",
    "Long-Horizon Video Reasoning",
    "Dynamic Online Scene-Change",
    "Event-Salient",
)
USER_SUITE = "Own tasks"  # Suite and group of the tasks that are not RoboMME's: a user's own
TEST_EPISODES = 50  # Episodes a task has in the test split; the paper runs all of them
MAX_STEPS = 1300  # Steps an episode may take in the paper's experiments
PAPER_SEEDS = (7, 42, 0)  # Model seeds, in the order of the leaderboard's columns


class Task(NamedTuple):
    """The paper's facts of a task.

    memory: what has to be remembered: T(ime), S(pace), O(bject), P(rocedure).
    steps: mean length of a demonstration.
    """

    name: str
    suite: str
    memory: tuple[str, ...]
    group: str
    steps: int


def _task(name: str, suite: int, memory: str, group: int, steps: int) -> Task:
    return Task(name, SUITES[suite], tuple(memory.split("+")), GROUPS[group], steps)


# In the benchmark's own order, which also numbers the environments' seeds.
_TASKS = (
    _task("PickXtimes", 0, "T", 5, 538),
    _task("StopCube", 0, "T", 1, 317),
    _task("SwingXtimes", 0, "T", 0, 435),
    _task("BinFill", 0, "T", 5, 604),
    _task("VideoUnmaskSwap", 1, "S", 2, 348),
    _task("VideoUnmask", 1, "S", 2, 217),
    _task("ButtonUnmaskSwap", 1, "S", 4, 400),
    _task("ButtonUnmask", 1, "S", 4, 267),
    _task("VideoRepick", 2, "O+T", 2, 687),
    _task("VideoPlaceButton", 2, "O+T", 3, 974),
    _task("VideoPlaceOrder", 2, "O+T", 3, 1134),
    _task("PickHighlight", 2, "O", 4, 346),
    _task("InsertPeg", 3, "P+O", 0, 479),
    _task("MoveCube", 3, "P", 5, 394),
    _task("PatternLock", 3, "P", 0, 208),
    _task("RouteStick", 3, "P", 0, 370),
)
TASK_FACTS: dict[str, Task] = {task.name: task for task in _TASKS}
PAPER_ORDER = (
    "BinFill", "PickXtimes", "SwingXtimes", "StopCube",
    "VideoUnmask", "ButtonUnmask", "VideoUnmaskSwap", "ButtonUnmaskSwap",
    "PickHighlight", "VideoRepick", "VideoPlaceButton", "VideoPlaceOrder",
    "MoveCube", "InsertPeg", "PatternLock", "RouteStick",
)  # fmt: skip
"""The tasks in the order of the paper's tables, suite by suite."""


@dataclass(frozen=True)
class Protocol:
    """What a whole run consists of, and how its figures are made.

    tasks, episodes: a run is complete with episodes 0 … episodes − 1 of every task; where some are
        the benchmark's, of these: tasks of one's own have figures of their own, beside the average.
    numbers: task → the numbers of its episodes that count, where these are not all `episodes`.
    task_suites: task → suite, of environments that are not RoboMME (`suites_of`).
    groupings: title → task → group, of environments that group their tasks in further ways
        (`groupings_of`).
    errors: whether an episode that ended in an error is a `failure`, as in the official evaluation,
        or `missing`.
    confidence: of the intervals.
    """

    tasks: tuple[str, ...] = PAPER_ORDER
    episodes: int = TEST_EPISODES
    errors: str = "failure"
    confidence: float = 0.95
    task_suites: Mapping[str, str] = field(default_factory=dict)
    numbers: Mapping[str, tuple[int, ...]] = field(default_factory=dict)
    groupings: Mapping[str, Mapping[str, str]] = field(default_factory=dict)

    @classmethod
    def of_records(cls, records: Iterable[EpisodeRecord], episodes: int | None = None) -> Self:
        """The protocol of what has records: their tasks, and of each the episodes of any run.

        episodes: how many a task has in all; by default up to the last that is recorded.
        """
        recorded: dict[str, set[int]] = {}
        for record in records:
            recorded.setdefault(record.task, set()).add(record.episode)
        if episodes is None:
            episodes = 1 + max(max(numbers) for numbers in recorded.values())
        ordered = [task for task in PAPER_ORDER if task in recorded]
        ordered += sorted(recorded.keys() - TASK_FACTS.keys())
        numbers = {}
        for task in ordered:
            if recorded[task] != set(range(episodes)):
                numbers[task] = tuple(sorted(recorded[task]))
        return cls(tuple(ordered), episodes, numbers=numbers)

    def __post_init__(self) -> None:
        for holds, message in (
            (
                self.tasks and len(set(self.tasks)) == len(self.tasks),
                f"tasks={list(self.tasks)} must name at least one task, each once.",
            ),
            (
                self.episodes >= 1,
                f"episodes={self.episodes} must be at least 1: how many a task has.",
            ),
            (
                self.errors in ("failure", "missing"),
                f"errors={self.errors!r} must be failure or missing.",
            ),
            (
                0 < self.confidence < 1,
                f"confidence={self.confidence} must lie between 0 and 1, for instance 0.95.",
            ),
        ):
            require(holds, message)

    def expects(self, key: EpisodeKey) -> bool:
        return key.task in self.tasks and key.episode in self.numbers_of(key.task)

    def numbers_of(self, task: str) -> Sequence[int]:
        """The numbers of a task's episodes that count."""
        return self.numbers.get(task, range(self.episodes))

    def count(self, tasks: Iterable[str]) -> int:
        """How many episodes of these tasks count."""
        return sum(len(self.numbers_of(task)) for task in tasks)

    def has_all(self, tasks: Iterable[str]) -> bool:
        """Whether all episodes of these tasks count."""
        return all(len(self.numbers_of(task)) >= self.episodes for task in tasks)

    @property
    def is_benchmark(self) -> bool:
        """Whether it has all the benchmark's tasks, with all their episodes."""
        return set(self.tasks) >= set(PAPER_ORDER) and self.has_all(PAPER_ORDER)

    @property
    def extent(self) -> str:
        """What the average is over, such as `16 tasks × 50 episodes`."""
        tasks = self.averaged
        what = counted(len(tasks), "task")
        if len(tasks) == 1:
            what = tasks[0]
        if self.has_all(tasks):
            return f"{what} × {counted(self.episodes, 'episode')}"
        return f"{what}, {self.count(tasks):,} of {counted(len(tasks) * self.episodes, 'episode')}"

    @property
    def averaged(self) -> tuple[str, ...]:
        """The tasks that the average is over: the benchmark's, or all where none is the
        benchmark's.
        """
        return tuple(task for task in self.tasks if task in TASK_FACTS) or self.tasks

    @property
    def suites(self) -> list[str]:
        """The suites that take part: RoboMME's, those of other environments, `USER_SUITE` last."""
        others = dict.fromkeys(self.task_suites.values())
        names = (*SUITES, *others, USER_SUITE)
        return [suite for suite in names if self.choose("suite", suite)]

    def facts(self, task: str) -> Task:
        """What is known of a task; of an environment's own it is the suite."""
        if task in TASK_FACTS:
            return TASK_FACTS[task]
        suite = self.task_suites.get(task, USER_SUITE)
        return Task(task, suite, (), USER_SUITE, 0)

    def choose(self, attribute: str, value: str) -> list[str]:
        """The tasks of a suite or group that take part."""
        return [task for task in self.tasks if getattr(self.facts(task), attribute) == value]


def suites_of(records: Iterable[EpisodeRecord]) -> dict[str, str]:
    """Task → suite, as the records of other environments than RoboMME name it."""
    return {r.task: r.suite for r in records if r.suite and r.task not in TASK_FACTS}


def groupings_of(records: Iterable[EpisodeRecord]) -> dict[str, dict[str, str]]:
    """Title → task → group, as the records name them."""
    groupings: dict[str, dict[str, str]] = {}
    for record in records:
        for title, group in (record.groups or {}).items():
            groupings.setdefault(title, {})[record.task] = group
    return groupings


def tasks_of(records: Iterable[EpisodeRecord]) -> tuple[str, ...]:
    """The tasks that a run consists of by default: the benchmark's, if a record is of one, and the
    user's own.
    """
    names = {record.task for record in records}
    user_tasks = tuple(sorted(names - TASK_FACTS.keys()))
    if user_tasks and not names & TASK_FACTS.keys():
        return user_tasks
    return (*PAPER_ORDER, *user_tasks)


GROUPING = "grouping: "


class Scope(NamedTuple):
    """What a figure is about: `kind` is task, suite, group, difficulty, average, or `GROUPING` and
    the title of a grouping.
    """

    kind: str
    name: str
    tasks: tuple[str, ...]


def scopes(protocol: Protocol) -> list[Scope]:
    """Everything figures are made of, whole tasks at a time (difficulties cut across them)."""
    result = [Scope("task", task, (task,)) for task in protocol.tasks]
    for kind, names in (("suite", protocol.suites), ("group", GROUPS)):
        for name in names:
            result.append(Scope(kind, name, tuple(protocol.choose(kind, name))))
    for title, grouping in protocol.groupings.items():
        for group in dict.fromkeys(grouping.values()):
            members = [task for task in protocol.tasks if grouping.get(task) == group]
            result.append(Scope(GROUPING + title, group, tuple(members)))
    result.append(Scope("average", "average", protocol.averaged))
    return [scope for scope in result if scope.tasks]
