"""Arms of a probe: perturbations alone or together (`drop:2`, `nodemo+shuffle`)."""

from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import reduce
from typing import Any

import numpy as np

from mme_vla.errors import UserError, require
from mme_vla.extras.probing.channels import Channel, Remembered
from mme_vla.extras.probing.feed import Feed
from mme_vla.extras.probing.interventions import NEEDS, Moment, perturb_store
from mme_vla.extras.probing.settings import listed_arms, words_of_arm
from mme_vla.memory.perturbation import (
    PROBE,
    Pause,
    Perturbation,
    build_perturbation,
    build_word,
    overrides,
)
from mme_vla.policy.base import Policy

DEFAULT_ARMS = (
    "drop:all",
    "nodemo",
    "swap",
    "shuffle",
    "recent",
    "oracle",
    "delay:16",
    "delay:64",
    "delay:256",
    "pause",
    "distract:1",
    "distract:3",
    "subgoal_swap",
    "subgoal_delay",
    "subgoal_count",
)
"""The default arms, as far as the policy and the data allow them."""


@dataclass(frozen=True)
class Arm:
    """Perturbations that act together, in this order, under one name."""

    name: str
    parts: tuple[Perturbation, ...] = ()

    @property
    def meaning(self) -> str:
        """What it does in plain words."""
        if not self.parts:
            return "the policy as it is, which the other arms are compared with"
        return " and ".join(part.meaning for part in self.parts)

    @property
    def feed(self) -> Feed:
        """What the policy observes."""
        return Feed.of(self.parts)

    @property
    def needs(self) -> frozenset[str]:
        """What a probe must have for them, of `NEEDS`."""
        needs: set[str] = set()
        for part in self.parts:
            needs |= part.needs
            if overrides(type(part), "perturb"):
                needs.add("entries")
            elif overrides(type(part), "repeats"):
                needs.add("pauses")
        return frozenset(needs)

    @property
    def shows(self) -> bool:
        """Whether frames are changed that were collected since the last decision."""
        return any(overrides(type(part), "show") or part.renews for part in self.parts)

    @property
    def in_closed_loop(self) -> bool:
        """Whether it acts where a policy runs an episode, and not at single recorded steps."""
        return self.shows or any(overrides(type(part), "instruct") for part in self.parts)

    @property
    def renews(self) -> bool:
        """Whether the policy begins an episode anew at each decision."""
        return any(part.renews for part in self.parts)

    @property
    def lag(self) -> int:
        """Frames before those since the last decision that are needed too."""
        return max((part.lag for part in self.parts), default=0)

    @property
    def edits(self) -> bool:
        """Whether the memory is changed, and not only frames or subgoals."""
        return "entries" in self.needs

    def only(self, moment: Moment) -> np.ndarray | None:
        """The frames that may be remembered; of several such perturbations those that all of them
        allow.
        """
        allowed: np.ndarray | None = None
        for part in self.parts:
            frames = part.only(moment)
            if frames is not None:
                allowed = frames if allowed is None else np.intersect1d(allowed, frames)
        require(
            allowed is None or len(allowed),
            f"{self.name} leaves no frame to remember: its parts allow different ones.",
        )
        return allowed

    def edit(self, store: Remembered, moment: Moment) -> Remembered:
        """What is remembered instead."""
        for part in self.parts:
            store = part.edit(store, moment)
            if overrides(type(part), "perturb"):
                store = perturb_store(store, part, moment.rng)
        return store

    def show(self, frames: Any, moment: Moment) -> Any:
        """The frames as the policy observes them."""
        return reduce(lambda shown, part: part.show(shown, moment), self.parts, frames)

    def instruct(self, goal: str, moment: Moment) -> str:
        """The goal that the policy reads instead."""
        return reduce(lambda text, part: part.instruct(text, moment), self.parts, goal)

    def say(self, subgoal: str | None, moment: Moment) -> str | None:
        """The subgoal that the policy reads instead."""
        return reduce(lambda text, part: part.say(text, moment), self.parts, subgoal)

    def dial(self) -> float | None:
        """Where the arm stands on its dial, if it is one perturbation with a number for one."""
        if len(self.parts) != 1 or self.parts[0].dial is None:
            return None
        value = getattr(self.parts[0], self.parts[0].dial)
        return float(value) if isinstance(value, int | float) else None


UNPROBED = Arm("unprobed")


def read_arm(spec: Any) -> Arm:
    """An arm from words such as `drop:2` or `nodemo+shuffle`, or from
    `{name: drop, count: 2, which: oldest}`.
    """
    if isinstance(spec, Mapping) and "name" in spec:
        name = str(spec["name"])
        options = ",".join(f"{key}={value}" for key, value in spec.items() if key != "name")
        if options:
            name += f"({options})"
        return Arm(name, (build_perturbation(spec, PROBE, "with"),))
    parts = [build_word(word, PROBE, f"with={text}") for text, word in words_of_arm(spec)]
    return Arm(spec, tuple(parts))


def read_arms(specs: Any) -> list[Arm]:
    """Arms of `with`, each once."""
    arms = [read_arm(spec) for spec in listed_arms(specs)]
    names: set[str] = set()
    for arm in arms:
        require(arm.name not in names, f"with= names {arm.name} twice.")
        names.add(arm.name)
    return arms


def lacking(
    arm: Arm,
    policy: Policy,
    channel: Channel,
    recordings: int,
    *,
    boundaries: bool,
    n_goals: int = 0,
) -> str | None:
    """What an arm needs and lacks, for a message; None where it can be probed.

    recordings: recorded episodes to take from.
    boundaries: whether sub-tasks are recorded.
    n_goals: how many goals the recorded episodes have.
    """
    robot = policy.embodiment
    there = {
        "entries": type(channel) is not Channel,
        "choice": channel.chooses,
        "clock": channel.clock is not None,
        "pauses": channel.sees_pauses,
        "subgoal": policy.require_processor().prompt_spec.reads_subgoal,
        "recordings": recordings > 0 and not robot.readings,
        "boundaries": boundaries,
        "stream": not robot.readings,
        "goals": n_goals > 1,
    }
    for need in sorted(arm.needs):
        if not there.get(need, False):
            return NEEDS.get(need, need)
    n_sessions = arm.feed.n_sessions
    if n_sessions > recordings:
        return f"{n_sessions} recorded episodes to take from, and there are {recordings}"
    return None


def choose_arms(
    specs: Any,
    policy: Policy,
    channel: Channel,
    recordings: int,
    *,
    boundaries: bool,
    n_goals: int = 0,
) -> tuple[list[Arm], list[str]]:
    """The arms of `specs`; by default those of `DEFAULT_ARMS` that policy and data allow, and why
    not the others: a sentence for each reason.

    Of a policy that reads no subgoals, arms of subgoals are none that a reader misses.
    """
    arms = []
    names_of_reasons: dict[str, list[str]] = {}
    for arm in read_arms(DEFAULT_ARMS if specs is None else specs):
        why = lacking(arm, policy, channel, recordings, boundaries=boundaries, n_goals=n_goals)
        if why is None:
            arms.append(arm)
        elif specs is not None:
            raise UserError(f"with={arm.name} needs {why}.")
        elif why != NEEDS["subgoal"]:
            names_of_reasons.setdefault(why, []).append(arm.name)
    left_out = []
    for why, names in names_of_reasons.items():
        if len(names) == 1:
            left_out.append(f"{names[0]} was left out: it needs {why}.")
        else:
            left_out.append(f"{', '.join(names)} were left out: they need {why}.")
    return arms, left_out


def meanings_of(names: Iterable[str]) -> dict[str, str]:
    """What arms of these names do, in plain words; without those that are more than words, or of a
    plugin that is not loaded.
    """
    meanings = {UNPROBED.name: UNPROBED.meaning}
    for name in names:
        with suppress(UserError):
            meanings.setdefault(name, read_arm(name).meaning)
    return meanings


def options_of(arm: Arm) -> list[dict[str, Any]]:
    """The options of an arm's parts, as plain values."""
    words = arm.name.split("+")
    options = []
    for i, part in enumerate(arm.parts):
        values = {"intervention": type(part).__name__, **vars(part)}
        # The two names of a pause are written as two classes, so that probes of before continue.
        if isinstance(part, Pause) and words[i : i + 1] and words[i].startswith("repeat_frame"):
            values["intervention"] = "RepeatFrame"
        elif isinstance(part, Pause):
            values = {"intervention": "Pause", "frames": part.frames, "at": part.at or 0}
        options.append(values)
    return options


def slug(name: str) -> str:
    """An arm's name as a folder's."""
    return "".join(c if c.isalnum() or c in "-_+" else "-" for c in name)
