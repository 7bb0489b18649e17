"""The events of an episode, as the key `event` names them: what happens, and where."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from mme_vla.errors import UserError, brief, check_choice, require
from mme_vla.evaluation.records import EventEntry
from mme_vla.memory.perturbation import (
    ROLLOUT,
    Perturbation,
    build_word,
    overrides,
    split_word,
)

if TYPE_CHECKING:
    from mme_vla.policy.episode import Episode

FORM = "write pause:100, pause:100@step:64 or pause:100@subtask:2; + joins several of one episode"


class Event(NamedTuple):
    """What happens to an episode while it runs: a perturbation that acts in the simulation or on
    the conditioning video (`memory/perturbation.py`), and its place.

    It takes place at the first decision from control step `number` on, or in sub-task `number` on.

    Control steps are counted from 0 at the execution's first frame, without those for which an
    event held the robot; sub-tasks of the execution from 1.
    """

    text: str
    perturbation: Perturbation
    unit: str
    number: int

    @property
    def resamples_video(self) -> bool:
        """Whether it acts on the conditioning video, and so has no place."""
        return not overrides(type(self.perturbation), "hold", "act")

    def reached(self, step: int, subtask: int) -> bool:
        """Whether the place was reached."""
        return (subtask if self.unit == "subtask" else step) >= self.number


def read_events(text: str | None) -> tuple[Event, ...]:
    """The events of one arm, such as `pause:100@subtask:2+gap:32@step:64`; none of None.

    Raises:
        UserError: another form, an unknown event, a number that it does not take, or an unknown
            place.
    """
    if text is None:
        return ()
    events = []
    for part in text.split("+"):
        key = f"event={brief(part, quote=False)}"
        word = split_word(part)
        if word is None:
            raise UserError(f"{key}: {FORM}.")
        unit = word.unit or "step"
        number = word.number or 0
        event = Event(part, build_word(word, ROLLOUT, key), unit, number)
        require(
            word.unit is None or not event.resamples_video,
            f"{key}: {word.name} takes no place; leave out @{word.unit}:….",
        )
        check_choice(f"{key}: place", unit, ("step", "subtask"))
        least = 0 if unit == "step" else 1
        require(number >= least, f"{key}: {unit}:{number} must be {least} or more.")
        events.append(event)
    return tuple(events)


def event_arms(value: Any) -> list[str]:
    """The arms of the key `event`: none, one, or a list, each once."""
    if value is None:
        return []
    arms = [value] if isinstance(value, str) else value
    require(
        isinstance(arms, Sequence)
        and all(isinstance(arm, str) for arm in arms)
        and len({*arms}) == len(arms),
        f"event={brief(value)}: {FORM}, [pause:50,pause:100] runs several arms, each once.",
    )
    for arm in arms:
        read_events(arm)
    return list(arms)


class EventCourse:
    """The events of one running episode.

    log: each event, and when it acted.
    hold_steps: control steps for which events held the robot.
    holding: what holds it, if its frames come next.
    """

    def __init__(self, events: Sequence[Event]) -> None:
        self._events = events
        self.log = [EventEntry(event=event.text, step=None) for event in events]
        self.hold_steps = 0
        self.holding: Perturbation | None = None

    def video(self, length: int) -> np.ndarray:
        """Which of the video's `length` frames are observed, in order, int64 [n]."""
        real = np.arange(length)
        for event, entry in zip(self._events, self.log, strict=True):
            if event.resamples_video and length:
                real = np.repeat(real, event.perturbation.repeats(len(real), len(real)))
                entry["step"] = 0
        return real

    def next(self, episode: "Episode", step: int, subtask: int) -> None:
        """Let events take place that are due, up to one that holds the robot.

        Args:
            step: control steps so far.
            subtask: number of the current sub-task, 0 where the environment has none.
        """
        self.holding = None
        for event, entry in zip(self._events, self.log, strict=True):
            if entry["step"] is not None or event.resamples_video:
                continue
            if event.unit == "subtask" and not subtask:
                raise UserError(
                    f"event={event.text}: this environment reports no sub-tasks; place it by"
                    " @step:<n>."
                )
            if event.reached(step - self.hold_steps, subtask):
                entry["step"] = step - self.hold_steps
                event.perturbation.act(episode)
                if event.perturbation.hold:
                    self.holding = event.perturbation
                    return
