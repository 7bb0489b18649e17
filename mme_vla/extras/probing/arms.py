"""Arms of a probe: interventions alone or together (`drop:2`, `nodemo+shuffle`)."""

import re
from collections.abc import Mapping
from dataclasses import dataclass, is_dataclass
from functools import reduce
from typing import Any

import numpy as np

from mme_vla.config.sections import read_section
from mme_vla.errors import UserError, brief, require
from mme_vla.extras.probing.channels import Channel, Remembered
from mme_vla.extras.probing.feed import Feed
from mme_vla.extras.probing.interventions import NEEDS, Intervention, Moment, Transform
from mme_vla.memory.transforms import build_transform
from mme_vla.policy.base import Policy
from mme_vla.registry import HISTORY_TRANSFORMS, INTERVENTIONS

_NUMBER = re.compile(r"\d+(\.\d+)?")
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
    """Interventions that act together, in this order, under one name."""

    name: str
    parts: tuple[Intervention, ...] = ()

    @property
    def feed(self) -> Feed:
        """What the policy observes."""
        return reduce(lambda feed, part: part.feed(feed), self.parts, Feed())

    @property
    def needs(self) -> frozenset[str]:
        return frozenset().union(*(part.needs for part in self.parts))

    @property
    def edits(self) -> bool:
        """Whether the memory is changed, and not only frames or subgoals."""
        return "entries" in self.needs

    def only(self, moment: Moment) -> np.ndarray | None:
        """The frames that may be remembered; of several such interventions those that all of them
        allow.
        """
        allowed = [frames for part in self.parts if (frames := part.only(moment)) is not None]
        if not allowed:
            return None
        both: np.ndarray = reduce(np.intersect1d, allowed)
        require(
            len(both), f"{self.name} leaves no frame to remember: its parts allow different ones."
        )
        return both

    def edit(self, store: Remembered, moment: Moment) -> Remembered:
        """What is remembered instead."""
        return reduce(lambda edited, part: part.edit(edited, moment), self.parts, store)

    def say(self, subgoal: str | None, moment: Moment) -> str | None:
        """The subgoal that the policy reads instead."""
        return reduce(
            lambda subgoal_text, part: part.say(subgoal_text, moment), self.parts, subgoal
        )

    def dial(self) -> float | None:
        """Where the arm stands on its dial, if it is one intervention with a number for one."""
        if len(self.parts) != 1 or self.parts[0].dial is None:
            return None
        part = self.parts[0]
        value = getattr(part.transform if isinstance(part, Transform) else part, self.parts[0].dial)
        return float(value) if isinstance(value, int | float) else None


UNPROBED = Arm("unprobed")


def read_arm(spec: Any) -> Arm:
    """An arm from a word such as `drop:2` or `nodemo+shuffle`, or from
    `{name: drop, count: 2, which: oldest}`.
    """
    if isinstance(spec, Mapping):
        options = ",".join(f"{key}={value}" for key, value in spec.items() if key != "name")
        return Arm(
            f"{spec.get('name')}({options})" if options else str(spec.get("name")), (_build(spec),)
        )
    if not isinstance(spec, str) or not spec:
        raise UserError(
            f"with={brief(spec)}: write words such as drop:2 or nodemo+shuffle, or {{name: drop,"
            " …}."
        )
    return Arm(spec, tuple(_read_part(word) for word in spec.split("+")))


def _read_part(word: str) -> Intervention:
    name, _, value = word.partition(":")
    dial = _kind(name).dial
    if not value:
        return _build({"name": name})
    if name in HISTORY_TRANSFORMS and dial is not None and _NUMBER.fullmatch(value):
        return _build({"name": name, dial: float(value) if "." in value else int(value)})
    if dial is None or (value != "all" and not value.removeprefix("-").isdecimal()):
        allowed = (
            f"{name}:<{dial}>, a whole number, or all where it counts"
            if dial
            else f"{name}, which has no dial"
        )
        raise UserError(f"{word!r}: write {allowed}.")
    return _build({"name": name, dial: None if value == "all" else int(value)})


def _kind(name: Any) -> Any:
    """The class of an intervention, or of a history transform, which a probe applies as well."""
    return (HISTORY_TRANSFORMS if name in HISTORY_TRANSFORMS else INTERVENTIONS)[name]


def _build(section: Mapping[str, Any]) -> Intervention:
    entry: Any = _kind(section.get("name"))
    if section.get("name") in HISTORY_TRANSFORMS:
        return Transform(build_transform(dict(section)))
    options = {key: value for key, value in section.items() if key != "name"}
    if not is_dataclass(entry):
        return INTERVENTIONS.build(section)
    return read_section(entry, options, section["name"])  # type: ignore[arg-type, return-value]


def read_arms(specs: Any) -> list[Arm]:
    """Arms of `with`, each once."""
    words = [specs] if isinstance(specs, str | Mapping) else list(specs)
    arms = [read_arm(word) for word in words]
    names = [arm.name for arm in arms]
    if twice := [name for i, name in enumerate(names) if name in names[:i]]:
        raise UserError(f"with= names {twice[0]} twice.")
    return arms


def lacking(
    arm: Arm, policy: Policy, channel: Channel, recordings: int, *, boundaries: bool
) -> str | None:
    """What an arm needs and lacks, for a message; None where it can be probed.

    recordings: recorded episodes to take from. boundaries: whether sub-tasks are recorded.
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
    }
    for need in sorted(arm.needs):
        if not there.get(need, False):
            return NEEDS.get(need, need)
    if arm.feed.sessions > recordings:
        return f"{arm.feed.sessions} recorded episodes to take from, and there are {recordings}"
    return None


def choose_arms(
    specs: Any, policy: Policy, channel: Channel, recordings: int, *, boundaries: bool
) -> tuple[list[Arm], list[str]]:
    """The arms of `specs`; by default those of `DEFAULT_ARMS` that policy and data allow, and why
    not the others.
    """
    arms, left_out = [], []
    for arm in read_arms(DEFAULT_ARMS if specs is None else specs):
        why = lacking(arm, policy, channel, recordings, boundaries=boundaries)
        if why is None:
            arms.append(arm)
        elif specs is None:
            left_out.append(f"{arm.name} was left out: it needs {why}.")
        else:
            raise UserError(
                f"with={arm.name} needs {why}; {policy.config.get('name', 'this policy')} has none"
                " here."
            )
    return arms, left_out


def options_of(arm: Arm) -> list[dict[str, Any]]:
    """The options of an arm's parts, as plain values."""
    parts = [part.transform if isinstance(part, Transform) else part for part in arm.parts]
    return [{"intervention": type(part).__name__, **vars(part)} for part in parts]


def slug(name: str) -> str:
    """An arm's name as a folder's."""
    return "".join(c if c.isalnum() or c in "-_+" else "-" for c in name)
