"""Events of a rollout: what happens to an episode while it runs, at a control step or where a
sub-task begins.

An event acts in the simulation or on the stream of frames. An intervention of a probe acts on what
memory reads. One of your own is a class registered with `register("event", name)` in a module that
`plugins` names.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, NamedTuple

import numpy as np

from mme_vla.config.sections import NonNegativeInt, Range, read_section
from mme_vla.errors import UserError, brief, check_choice, require
from mme_vla.registry import EVENTS

if TYPE_CHECKING:
    from mme_vla.policy.base import Policy
    from mme_vla.policy.episode import Episode

FORM = "write pause:100, pause:100@step:64 or pause:100@subtask:2; + joins several of one episode"
_WORDS = re.compile(r"([A-Za-z]\w*)(?::(-?[\d.]+))?(?:@(\w+):(-?\d+))?")


@dataclass(frozen=True)
class Event:
    """Changes nothing. A subclass overrides what happens; a dataclass, so that its number is its
    field.

    dial: the field that `name:value` sets. neutral: its value without effect, that of the matched
    arm in a curve. placed: whether `@step:…` or `@subtask:…` may follow.
    """

    dial: ClassVar[str | None] = None
    neutral: ClassVar[float] = 0
    placed: ClassVar[bool] = True

    @property
    def hold(self) -> int:
        """Control steps for which the robot holds its pose and the scene continues; the step limit
        grows by as many.
        """
        return 0

    @property
    def observed(self) -> int:
        """How many frames of `hold` the policy observes, the newest ones, at least one."""
        return self.hold

    def video(self, length: int) -> np.ndarray:
        """How often each of the conditioning video's `length` frames is observed,
        int64 [length].
        """
        return np.ones(length, np.int64)

    def act(self, episode: "Episode") -> None:
        """Change the policy's running episode where the event takes place."""

    def check(self, policy: "Policy") -> None:
        """Refuse a policy to which this event cannot happen."""


@EVENTS.register("pause")
@dataclass(frozen=True)
class Pause(Event):
    """The robot holds its pose for `steps` control steps, and the policy observes every frame of
    them.
    """

    steps: NonNegativeInt = 64
    dial: ClassVar = "steps"

    @property
    def hold(self) -> int:
        return self.steps


@EVENTS.register("gap")
@dataclass(frozen=True)
class Gap(Event):
    """The robot holds its pose, `frames` frames are not observed, and the policy decides at the
    next one.
    """

    frames: NonNegativeInt = 64
    dial: ClassVar = "frames"

    @property
    def hold(self) -> int:
        return self.frames + 1 if self.frames else 0

    @property
    def observed(self) -> int:
        return min(self.hold, 1)


@EVENTS.register("speed")
@dataclass(frozen=True)
class VideoSpeed(Event):
    """The conditioning video is `factor` times as fast; below 1 it is slower."""

    factor: Annotated[float, Range(1 / 16, 16.0)] = 2.0
    dial: ClassVar = "factor"
    neutral: ClassVar = 1
    placed: ClassVar = False

    def video(self, length: int) -> np.ndarray:
        from mme_vla.memory.transforms import Speed  # PyTorch, which results do without

        return Speed(self.factor).repeats(length, length)


@EVENTS.register("restart")
@dataclass(frozen=True)
class Restart(Event):
    """The frame index restarts at 0: what is remembered keeps its content and its times, the clock
    begins anew.
    """

    def act(self, episode: "Episode") -> None:
        episode.restart_clock()

    def check(self, policy: "Policy") -> None:
        policy.start_episode("").restart_clock()


class Words(NamedTuple):
    """The parts of `pause:100@subtask:2`; what is not written is None."""

    name: str
    value: float | int | None
    unit: str | None
    number: int | None


class PlacedEvent(NamedTuple):
    """An event and its place: at the first decision from control step `number` on, or in sub-task
    `number` on.

    Control steps are counted from 0 at the execution's first frame, without those for which an
    event held the robot; sub-tasks of the execution from 1.
    """

    text: str
    event: Event
    unit: str
    number: int

    def reached(self, step: int, subtask: int) -> bool:
        """Whether the place was reached."""
        return (subtask if self.unit == "subtask" else step) >= self.number


def split_words(text: str) -> Words | None:
    """The parts of one event's text, known or not; None where it has another form."""
    if (match := _WORDS.fullmatch(text)) is None or (match[2] or "").count(".") > 1:
        return None
    value = None if match[2] is None else float(match[2]) if "." in match[2] else int(match[2])
    return Words(match[1], value, match[3], None if match[4] is None else int(match[4]))


def read_event(text: str) -> PlacedEvent:
    """One event from its text.

    Raises:
        UserError: another form, an unknown event, a number that it does not take, or an unknown
            place.
    """
    key, words = f"event={text}", split_words(text)
    if words is None:
        raise UserError(f"{key}: {FORM}.")
    check_choice(f"{key}: name", words.name, EVENTS)
    kind: Any = EVENTS[words.name]
    require(words.value is None or kind.dial is not None, f"{key}: {words.name} takes no number.")
    require(
        words.unit is None or kind.placed,
        f"{key}: {words.name} takes no place; leave out @{words.unit}:….",
    )
    options = {} if words.value is None else {kind.dial: words.value}
    event: Event = read_section(kind, options, f"{key}: {words.name}")
    unit, number = words.unit or "step", words.number or 0
    check_choice(f"{key}: place", unit, ("step", "subtask"))
    least = 0 if unit == "step" else 1
    require(number >= least, f"{key}: {unit}:{number} must be {least} or more.")
    return PlacedEvent(text, event, unit, number)


def read_events(text: str | None) -> tuple[PlacedEvent, ...]:
    """The events of one arm, such as `pause:100@subtask:2+gap:32@step:64`; none of None."""
    return () if text is None else tuple(map(read_event, text.split("+")))


def event_arms(value: Any) -> list[str]:
    """The arms of the key `event`: none, one, or a list, each once."""
    arms = [] if value is None else [value] if isinstance(value, str) else value
    require(
        isinstance(arms, Sequence)
        and all(isinstance(arm, str) for arm in arms)
        and len({*arms}) == len(arms),
        f"event={brief(value)}: {FORM}, [pause:50,pause:100] runs several arms, each once.",
    )
    for arm in arms:
        read_events(arm)
    return list(arms)


def folder_of(arm: str) -> str:
    """An arm's folder in that of the plain run."""
    return "event-" + re.sub(r"[^\w.+-]", "-", arm)


class EventCourse:
    """The events of one running episode.

    log: of each its text as `event`, and as `step` the control step at which it acted; None while
    it has not. hold_steps: control steps for which events held the robot. holding: the event whose
    frames come next.
    """

    def __init__(self, events: Sequence[PlacedEvent]) -> None:
        self._events = events
        self.log: list[dict[str, Any]] = [{"event": placed.text, "step": None} for placed in events]
        self.hold_steps = 0
        self.holding: Event | None = None

    def video(self, length: int) -> np.ndarray:
        """Which of the video's `length` frames are observed, in order, int64 [n]."""
        real = np.arange(length)
        for placed, entry in zip(self._events, self.log, strict=True):
            if not placed.event.placed and length:
                real = np.repeat(real, placed.event.video(len(real)))
                entry["step"] = 0
        return real

    def next(self, episode: "Episode", step: int, subtask: int) -> Event | None:
        """Let events take place that are due at this decision, up to one that holds the robot,
        which is returned.

        Args:
            step: control steps so far. subtask: number of the current sub-task, 0 where the
                environment tells none.
        """
        self.holding = None
        for placed, entry in zip(self._events, self.log, strict=True):
            if entry["step"] is not None or not placed.event.placed:
                continue
            if placed.unit == "subtask" and not subtask:
                raise UserError(
                    f"event={placed.text}: this environment tells no sub-tasks; place it by"
                    " @step:<n>."
                )
            if placed.reached(step - self.hold_steps, subtask):
                entry["step"] = step - self.hold_steps
                placed.event.act(episode)
                if placed.event.hold:
                    self.holding = placed.event
                    return placed.event
        return None
