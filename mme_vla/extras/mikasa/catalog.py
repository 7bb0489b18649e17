"""The tasks of MIKASA-Robo-VLA 1.0.0: kinds of memory, step limits, and what each needs.

The package lists them in no file of its own, so they are here. A test compares names and limits
with those that it registers. Kinds of memory are those of the benchmark's task overview
(mikasarobo.github.io), and the horizons its limits: Short to 200 steps, Medium to 600, Long beyond.
"""

from collections.abc import Mapping
from dataclasses import dataclass

BULB, YCB = "bulb", "ycb"


@dataclass(frozen=True)
class Family:
    """Tasks of one kind.

    memory: the kind of memory.
    tasks: name → step limit.
    needs: `BULB`, `YCB`, both or none: what its scenes need beside the package.
    frozen: whether no action has an effect while the cue is shown (except in tasks with `-Long`).
    """

    memory: str
    tasks: Mapping[str, int]
    needs: tuple[str, ...] = ()
    frozen: bool = False


def _sizes(name: str, sizes: str, steps: int, ending: str = "") -> dict[str, int]:
    return {f"{name}{size}{ending}": steps for size in sizes.split()}


_COLORS = "3 5 9"
_PAIRS = "3x2 3x3 5x3"
_SPANS = {"3": 800, "5": 1000, "7": 1200}
_LEVELS = "Easy Medium Hard"


def _spans(name: str) -> dict[str, int]:
    tasks = _sizes(name, "3 5 7", 400)
    for size, steps in _SPANS.items():
        tasks[f"{name}{size}-Long"] = steps
    return tasks


FAMILIES: Mapping[str, Family] = {
    "RememberColor": Family(
        "Object",
        _sizes("RememberColor", _COLORS, 25) | _sizes("RememberColor", _COLORS, 600, "-Long"),
        frozen=True,
    ),
    "RememberShape": Family(
        "Object",
        _sizes("RememberShape", _COLORS, 25) | _sizes("RememberShape", _COLORS, 600, "-Long"),
        frozen=True,
    ),
    "RememberShapeAndColor": Family(
        "Object",
        _sizes("RememberShapeAndColor", _PAIRS, 25)
        | _sizes("RememberShapeAndColor", _PAIRS, 600, "-Long"),
        frozen=True,
    ),
    "FindImposterColor": Family("Negative", _sizes("FindImposterColor", _COLORS, 25), frozen=True),
    "FindImposterShape": Family("Negative", _sizes("FindImposterShape", _COLORS, 25), frozen=True),
    "FindImposterShapeAndColor": Family(
        "Negative",
        {
            "FindImposterShapeAndColor3x2": 25,
            "FindImposterShapeAndColor3x3": 25,
            "FindImposterShapeAndColor5x3": 40,
        },
        frozen=True,
    ),
    "Intercept": Family("Spatial", _sizes("Intercept", "Slow Medium Fast", 60)),
    "InterceptGrab": Family("Spatial", _sizes("InterceptGrab", "Slow Medium Fast", 60)),
    "RotateLenient": Family("Spatial", _sizes("RotateLenient", "Pos PosNeg", 60)),
    "RotateStrict": Family("Spatial", _sizes("RotateStrict", "Pos PosNeg", 90)),
    "TakeItBack": Family("Spatial", {"TakeItBack": 60}),
    "ShellGame": Family(
        "Spatial",
        {"ShellGameTouch": 30, "ShellGamePush": 30},
        needs=(YCB,),
        frozen=True,
    ),
    "ShellGameColorLamp": Family(
        "Spatial",
        {"ShellGameColorLampTouch": 30},
        needs=(BULB, YCB),
        frozen=True,
    ),
    "ShellGameShuffle": Family(
        "Tracking",
        {"ShellGameShuffleTouch": 60, "ShellGameShuffleTouch-Long": 600},
        needs=(YCB,),
        frozen=True,
    ),
    "ShellGameShuffleColorLamp": Family(
        "Tracking",
        {"ShellGameShuffleColorLampTouch": 60, "ShellGameShuffleColorLampTouch-Long": 600},
        needs=(BULB, YCB),
        frozen=True,
    ),
    "BunchOfColors": Family(
        "Capacity",
        _sizes("BunchOfColors", "3 5 7", 400) | _sizes("BunchOfColors", "3 5 7", 700, "-Long"),
    ),
    "SeqOfColors": Family("Capacity", _spans("SeqOfColors")),
    "ChainOfColors": Family("Sequential", _spans("ChainOfColors")),
    "BlinkCountButtonPress": Family(
        "Temporal",
        {
            "BlinkCountButtonPressEasy": 150,
            "BlinkCountButtonPressMedium": 200,
            "BlinkCountButtonPressHard": 300,
            **_sizes("BlinkCountButtonPress", _LEVELS, 1200, "-Long"),
        },
        needs=(BULB,),
    ),
    "TimedTransfer": Family(
        "Temporal",
        {
            "TimedTransferEasy": 200,
            "TimedTransferMedium": 250,
            "TimedTransferHard": 300,
            "TimedTransferEasy-Long": 600,
            "TimedTransferMedium-Long": 900,
            "TimedTransferHard-Long": 1200,
        },
        needs=(BULB,),
    ),
    "TraceShape": Family(
        "Procedural",
        {"TraceShapeEasy": 250, "TraceShapeMedium": 300, "TraceShapeHard": 350},
        needs=(BULB,),
    ),
    "TraceShapeSeq": Family("Procedural", _sizes("TraceShapeSeq", _LEVELS, 1500), needs=(BULB,)),
    "BatteriesChecker": Family(
        "Checklist",
        {
            "BatteriesCheckerEasy-3": 540,
            "BatteriesCheckerEasy-6": 1080,
            "BatteriesCheckerHard-3": 1080,
            "BatteriesCheckerHard-6": 2160,
        },
        needs=(BULB,),
    ),
    "GatherAndRecall": Family(
        "Prospective",
        {f"GatherAndRecall{number}": 200 * (number + 1) // 2 for number in (1, 3, 5, 7, 9)},
        needs=(BULB,),
    ),
}
FAMILY_OF = {task: family for family in FAMILIES.values() for task in family.tasks}
STEPS = {task: steps for family in FAMILIES.values() for task, steps in family.tasks.items()}


def by_memory() -> dict[str, tuple[str, ...]]:
    """Kind of memory → tasks, in the order of the catalog."""
    kinds: dict[str, tuple[str, ...]] = {}
    for family in FAMILIES.values():
        kinds[family.memory] = (*kinds.get(family.memory, ()), *family.tasks)
    return kinds


def by_horizon() -> dict[str, tuple[str, ...]]:
    """Short, Medium and Long → tasks, by their step limits."""
    horizons: dict[str, list[str]] = {"Short": [], "Medium": [], "Long": []}
    for task, steps in STEPS.items():
        name = "Long"
        if steps <= 200:
            name = "Short"
        elif steps <= 600:
            name = "Medium"
        horizons[name].append(task)
    return {name: tuple(tasks) for name, tasks in horizons.items()}
