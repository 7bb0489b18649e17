"""Tasks, splits, and the seed and difficulty of every episode; importing this needs no simulator.

The shipped tables are the benchmark's own. A seed follows from task, split and episode by a
formula, except where the official demonstrator failed on it and the seed was raised until it
succeeded (see benchmarks/episode_seeds.py).
"""

import csv
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from importlib.resources import files
from numbers import Integral
from typing import Any

from mme_vla.envs.rows import (
    DIFFICULTIES,
    OOD,
    TaskOptions,
    check_row,
    is_row_split,
    rows_of,
    task_options,
)
from mme_vla.errors import UserError, check_known, did_you_mean, require
from mme_vla.registry import TASKS

TASK_NAMES = (
    "PickXtimes", "StopCube", "SwingXtimes", "BinFill",
    "VideoUnmaskSwap", "VideoUnmask", "ButtonUnmaskSwap", "ButtonUnmask",
    "VideoRepick", "VideoPlaceButton", "VideoPlaceOrder", "PickHighlight",
    "InsertPeg", "MoveCube", "PatternLock", "RouteStick",
)  # fmt: skip
"""In the benchmark's order, which the seeds of the episodes follow."""

STICK_TASKS = ("PatternLock", "RouteStick")
"""Tasks whose robot holds a stick instead of a gripper."""

BASE = "test"
TWIN, STRESS = "twin", "stress"
DIALS: dict[str, tuple[str, ...]] = {
    "count": ("PickXtimes", "SwingXtimes", "StopCube", "VideoRepick"),
    "containers": ("VideoUnmask", "ButtonUnmask"),
    "swaps": ("VideoUnmaskSwap", "ButtonUnmaskSwap"),
    "delay": (
        "VideoUnmask",
        "VideoUnmaskSwap",
        "VideoPlaceButton",
        "VideoPlaceOrder",
        "VideoRepick",
        "MoveCube",
    ),
    "path": ("PatternLock",),
    "distractors": ("PickHighlight",),
}
"""Dial → the tasks that have it.

count: repetitions or visits more. containers: more, over nothing. swaps: more of them. delay: steps
more between what is shown and the execution. path: discs more on the way. distractors: more objects
that are not targets.
"""
_STRESS = re.compile(rf"{STRESS}:([a-z_]+)=(\d{{1,4}})")
HARD, CHALLENGE = "hard", "challenge"
"""The test split's hard episodes (its numbers 3, 7, …, 47), and the held-out scenes of the 2026
challenge.
"""
HARD_EPISODES = 12
"""Episodes a task has in `hard`."""
STEPS = {CHALLENGE: 1500, OOD: 1800}
"""Control steps that a split allows, where it is not `DEFAULT_STEPS`; `ood` also means
its tiers.
"""
DEFAULT_STEPS = 1300


def step_limit(split: str) -> int:
    """Control steps that an episode of a split may take, the conditioning video not counted."""
    base = base_of(split)
    if is_row_split(base):
        base = OOD
    return STEPS.get(base, DEFAULT_STEPS)


@dataclass(frozen=True)
class Variant:
    """How the scenes of a split differ from those of another. dial, turned: of a stress split."""

    twin: bool = False
    dial: str = ""
    turned: int = 0
    base: str = BASE
    """The split whose scenes are varied."""

    @property
    def options(self) -> TaskOptions:
        """Keyword arguments of the task."""
        options: TaskOptions = {}
        if self.turned:
            options["stress"] = {self.dial: self.turned}
        if self.twin:
            options["in_view"] = True
        return options

    def check(self, task: str) -> None:
        """Make sure that a task of the benchmark can be varied so."""
        require(
            task in TASK_NAMES,
            f"split={TWIN} and split={STRESS}:… vary the benchmark's tasks alone, and {task} is"
            " none.",
        )
        if self.dial:
            dials = dials_of(task)
            require(
                self.dial in dials,
                f"{task} has no dial {self.dial!r}; it has {', '.join(dials) or 'none'}."
                f" {self.dial} is for {', '.join(DIALS[self.dial])}.",
            )


def dials_of(task: str) -> list[str]:
    """The dials of a task."""
    return [dial for dial, tasks in DIALS.items() if task in tasks]


def read_variant(split: str) -> Variant | None:
    """The variant that a split names; None for any other text."""
    require(
        isinstance(split, str), f"split={split!r} is no text, such as 'test' or 'scenes.jsonl'."
    )
    if split == TWIN:
        return Variant(twin=True)
    if split.startswith(f"{TWIN}:"):
        base = split.removeprefix(f"{TWIN}:")
        varied = read_variant(base) or Variant(base=base)
        require(not varied.twin, f"split={split!r}: name {TWIN} once, as {TWIN}:{varied.base}.")
        return replace(varied, twin=True)
    if not split.startswith(STRESS):
        return None
    match = _STRESS.fullmatch(split)
    if match is None:
        raise UserError(
            f"split={split!r}: say which dial is turned how far, as {STRESS}:count=2; the dials are"
            f" {', '.join(DIALS)}."
        )
    require(
        match[1] in DIALS,
        f"split={split!r}: there is no dial {match[1]!r}. {did_you_mean(match[1], DIALS)}",
    )
    return Variant(dial=match[1], turned=int(match[2]))


def base_of(split: str) -> str:
    """The split whose scenes a variant varies; any other split itself."""
    variant = read_variant(split)
    return split if variant is None else variant.base


SPLITS = {"train": 100, "val": 50, "test": 50}
"""Episodes a task has in each split of the benchmark."""
MORE = "more"
"""Episodes beyond the benchmark's, for recording at scale; their seeds are in none of its splits,
nor is it a split.
"""
FURTHER, FURTHER_EPISODES = "further", 100
"""Episodes that continue where the test split's rule ends, for tests on new scenes; no split
either.
"""
_CYCLE = ("easy", "easy", "medium", "hard")
FURTHER_SPLITS = {FURTHER: FURTHER_EPISODES} | {f"{FURTHER}_{level}": 400 for level in DIFFICULTIES}
"""Episodes a task has in each of these; `further_hard` are the hard ones as the same rule
continues, and so forth.
"""
RESERVED = "reserved"
"""Episodes for one final test of what was chosen on others; no split of the benchmark."""
_COUNTS = {**SPLITS, MORE: 900, **FURTHER_SPLITS, RESERVED: 100}
KNOWN = (*_COUNTS, HARD, CHALLENGE, OOD)
_TEST_SEED = (500_000, 10_000)
_FIRST_SEED = {
    "train": (0, 1000), "val": (1_000_000, 10_000), "test": _TEST_SEED, MORE: (2_000_000, 100_000),
    RESERVED: (5_000_000, 10_000), **dict.fromkeys(FURTHER_SPLITS, _TEST_SEED),
}  # fmt: skip
_RECOVERY = ("z", "z", "z", "xy", "xy", "xy")


@dataclass(frozen=True)
class EpisodeSpec:
    """One episode of a split."""

    task: str
    split: str
    episode: int
    seed: int
    difficulty: str
    """`easy`, `medium` or `hard`; in RoboMME-OOD the tier."""
    row: Mapping[str, Any] | None = field(default=None, compare=False, repr=False)
    """The scene's values, where they are not sampled from the seed."""

    @property
    def options(self) -> TaskOptions:
        """Keyword arguments of the task that make this episode's scene."""
        options: TaskOptions = {"seed": self.seed, "difficulty": self.difficulty}
        if self.row is not None:
            options = task_options(self.row)
        variant = read_variant(self.split)
        if variant is not None:
            options |= variant.options
        return options

    @property
    def recovery(self) -> str | None:
        """How the demonstration's one failed grasp misses: `z` in train episodes 0-2, `xy` in 3-5,
        None elsewhere.
        """
        if self.split != "train" or self.episode >= len(_RECOVERY):
            return None
        return _RECOVERY[self.episode]


def formula(task: str, split: str, episode: int) -> tuple[int, str]:
    """Seed before any retry, and difficulty, of an episode; of a task of the user's own, as if it
    were number 0.
    """
    offset, stride = _FIRST_SEED[split]
    number = 0
    if task in TASK_NAMES:
        number = TASK_NAMES.index(task) + 1
    place = episode
    if split in FURTHER_SPLITS:
        first = SPLITS["test"]
        place = first + episode
        level = split.removeprefix(FURTHER).removeprefix("_")
        if level:
            # The places of this difficulty in the first cycle beyond the test split
            cycle = range(first, first + len(_CYCLE))
            places = [other for other in cycle if _CYCLE[other % len(_CYCLE)] == level]
            n_cycles, index = divmod(episode, len(places))
            place = places[index] + n_cycles * len(_CYCLE)
    return offset + stride * number + 100 * place, _CYCLE[place % 4]


def check_task_name(task: str) -> None:
    """Make sure that a task is the benchmark's or registered."""
    check_known("task", task, all_tasks())


def episodes(task: str, split: str = "test") -> list[EpisodeSpec]:
    """The episodes of a task in a split, in order.

    Args:
        task: one of the 16 task names, or a task of the user's own registered in `TASKS`.
        split: `train`, `val` or `test`; `hard`, the hard ones of the latter; `challenge`; `ood` or
            `ood:<tier>`; the path of a JSONL file of scenes (`rows`); a variant (`Variant`), whose
            seeds are the same; or `more`, 900 episodes a task that the benchmark does not have, or
            `further`, 100 that the rule of the test split gives after its own 50 (number 0 is what
            number 50 would be; no seed was raised), or `further_easy`, `further_medium`,
            `further_hard`, 400 of one difficulty by the same rule, or `reserved`, 100 with seeds of
            their own from 5,010,000 on.
    """
    check_task_name(task)
    variant = check_split(split)
    if variant is not None:
        variant.check(task)
        return [replace(spec, split=split) for spec in episodes(task, variant.base)]
    if split == HARD:
        hard = [spec for spec in episodes(task, BASE) if spec.difficulty == HARD]
        return [replace(spec, split=split, episode=i) for i, spec in enumerate(hard)]
    if is_row_split(split):
        rows = rows_of(task, split, all_tasks())
        return [_spec_of(row, split, i) for i, row in enumerate(rows)]
    if split == CHALLENGE:
        require(
            task in TASK_NAMES,
            f"split={CHALLENGE} has the benchmark's tasks alone, and {task} is none.",
        )
    elif task not in TASK_NAMES or split not in SPLITS:
        return [
            EpisodeSpec(task, split, i, *formula(task, split, i)) for i in range(_COUNTS[split])
        ]
    return list(_table(split)[task])


def check_split(split: str) -> Variant | None:
    """Make sure that a split exists; returns its variant where it has one."""
    base = base_of(split)
    if base not in KNOWN and not is_row_split(base):
        known = did_you_mean(base, [*KNOWN, TWIN, STRESS])
        raise UserError(f"Unknown split {split!r}. {known} A file of scenes ends in .jsonl.")
    return read_variant(split)


def all_tasks() -> tuple[str, ...]:
    """The benchmark's tasks and the user's own."""
    return (*TASK_NAMES, *(task for task in TASKS if task not in TASK_NAMES))


def read_row(value: Any) -> EpisodeSpec:
    """The episode that one row of values describes, as `env.scene_values()` gives it."""
    return _spec_of(check_row(value, "The row", all_tasks()), "rows", 0)


def _spec_of(row: Mapping[str, Any], split: str, number: int) -> EpisodeSpec:
    difficulty = row.get("tier") or row.get("difficulty", HARD)
    return EpisodeSpec(row["task"], split, number, row["seed"], difficulty, row)


def episode(task: str, split: str = "test", index: int = 0) -> EpisodeSpec:
    """One episode of a split."""
    return numbered(episodes(task, split), task, split, index)


def numbered(known: Sequence[EpisodeSpec], task: str, split: str, number: int) -> EpisodeSpec:
    """The episode of this number among the known ones of a task in a split."""
    require(known, f"{task} has no episodes in split {split!r}.")
    is_number = isinstance(number, Integral) and not isinstance(number, bool)
    require(
        is_number and 0 <= number < len(known),
        f"Unknown episode {number!r} of {task}, split {split!r}; expected 0 to {len(known) - 1}.",
    )
    return known[number]


@cache
def _table(split: str) -> dict[str, list[EpisodeSpec]]:
    text = (
        files("mme_vla")
        .joinpath("assets", "robomme_metadata", f"{split}.csv")
        .read_text(encoding="utf-8")
    )
    table: dict[str, list[EpisodeSpec]] = {task: [] for task in TASK_NAMES}
    for row in csv.DictReader(text.splitlines()):
        table[row["task"]].append(
            EpisodeSpec(
                row["task"], split, int(row["episode"]), int(row["seed"]), row["difficulty"]
            )
        )
    return table
