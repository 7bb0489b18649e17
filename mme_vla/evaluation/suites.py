"""The 16 RoboMME tasks and how the paper groups them."""

from typing import NamedTuple

DIFFICULTIES = ("easy", "medium", "hard")
SUITES = ("Counting", "Permanence", "Reference", "Imitation")
GROUPS = (
    "Motion-Centric",
    "Time-Sensitive",
    "Short-Horizon Video Reasoning",
    "Long-Horizon Video Reasoning",
    "Dynamic Online Scene-Change",
    "Event-Salient",
)
OWN = "Own tasks"
"""Suite and group of the tasks that are not RoboMME's: a user's own."""
TEST_EPISODES = 50
"""Episodes a task has in the test split; the paper runs all of them."""
MAX_STEPS = 1300
"""Steps an episode may take in the paper's experiments."""
PAPER_SEEDS = (7, 42, 0)
"""Model seeds, in the order of the leaderboard's columns."""


class Task(NamedTuple):
    """What the paper says of a task.

    memory: what has to be remembered: T(ime), S(pace), O(bject), P(rocedure).
    video: whether a conditioning video comes first. steps: mean length of a demonstration.
    """

    name: str
    suite: str
    memory: tuple[str, ...]
    group: str
    video: bool
    steps: int


def _task(name: str, suite: int, memory: str, group: int, video: bool, steps: int) -> Task:
    return Task(name, SUITES[suite], tuple(memory.split("+")), GROUPS[group], video, steps)


# In the benchmark's own order, which also numbers the environments' seeds.
_TASKS = (
    _task("PickXtimes", 0, "T", 5, False, 538),
    _task("StopCube", 0, "T", 1, False, 317),
    _task("SwingXtimes", 0, "T", 0, False, 435),
    _task("BinFill", 0, "T", 5, False, 604),
    _task("VideoUnmaskSwap", 1, "S", 2, True, 348),
    _task("VideoUnmask", 1, "S", 2, True, 217),
    _task("ButtonUnmaskSwap", 1, "S", 4, False, 400),
    _task("ButtonUnmask", 1, "S", 4, False, 267),
    _task("VideoRepick", 2, "O+T", 2, True, 687),
    _task("VideoPlaceButton", 2, "O+T", 3, True, 974),
    _task("VideoPlaceOrder", 2, "O+T", 3, True, 1134),
    _task("PickHighlight", 2, "O", 4, False, 346),
    _task("InsertPeg", 3, "P+O", 0, True, 479),
    _task("MoveCube", 3, "P", 5, True, 394),
    _task("PatternLock", 3, "P", 0, True, 208),
    _task("RouteStick", 3, "P", 0, True, 370),
)
TASK_FACTS: dict[str, Task] = {task.name: task for task in _TASKS}
TASK_NAMES = tuple(TASK_FACTS)
"""The tasks in the benchmark's order."""
PAPER_ORDER = (
    "BinFill", "PickXtimes", "SwingXtimes", "StopCube",
    "VideoUnmask", "ButtonUnmask", "VideoUnmaskSwap", "ButtonUnmaskSwap",
    "PickHighlight", "VideoRepick", "VideoPlaceButton", "VideoPlaceOrder",
    "MoveCube", "InsertPeg", "PatternLock", "RouteStick",
)  # fmt: skip
"""The tasks in the order of the paper's tables, suite by suite."""


def task_facts(name: str) -> Task:
    """Look a task up; what RoboMME does not have is a user's own."""
    return TASK_FACTS.get(name) or Task(name, OWN, (), OWN, False, 0)
