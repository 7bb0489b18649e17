"""The events of an episode, as the key `event` names them: what happens, and where."""

from collections.abc import Sequence
from typing import Any, NamedTuple

from mme_vla.errors import UserError, brief, check_choice, require
from mme_vla.memory.perturbation import (
    ROLLOUT,
    Perturbation,
    build_word,
    overrides,
    split_word,
)

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


def read_event(text: str) -> Event:
    """One event from its text.

    Raises:
        UserError: another form, an unknown event, a number that it does not take, or an unknown
            place.
    """
    key = f"event={brief(text, quote=False)}"
    word = split_word(text)
    if word is None:
        raise UserError(f"{key}: {FORM}.")
    unit = word.unit or "step"
    number = word.number or 0
    event = Event(text, build_word(word, ROLLOUT, key), unit, number)
    require(
        word.unit is None or not event.resamples_video,
        f"{key}: {word.name} takes no place; leave out @{word.unit}:….",
    )
    check_choice(f"{key}: place", unit, ("step", "subtask"))
    least = 0 if unit == "step" else 1
    require(number >= least, f"{key}: {unit}:{number} must be {least} or more.")
    return event


def read_events(text: str | None) -> tuple[Event, ...]:
    """The events of one arm, such as `pause:100@subtask:2+gap:32@step:64`; none of None."""
    return () if text is None else tuple(map(read_event, text.split("+")))


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
