"""Choosing among options instead of moving: what a task offers, in words and as numbers."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from string import ascii_lowercase
from typing import Any

from mme_vla.errors import UserError, brief

Place = tuple[float, float]
MOST_WORDS = 400  # characters of an option
MIDDLE: Place = (0.5, 0.5)
"""The point of a choice that needs none, as shares of the picture's height and width."""


@dataclass(frozen=True)
class Option:
    """What can be chosen: its letter (`a`, `b`, …), what it does in words, and whether it needs a point."""

    label: str
    action: str
    needs_point: bool = False

    @property
    def number(self) -> int:
        """Which letter of the alphabet it has, from 0."""
        return ascii_lowercase.index(self.label)

    def to_dict(self) -> dict[str, Any]:
        """As the benchmark writes it in `available_multi_choices`."""
        return {"label": self.label, "action": self.action, "need_parameter": self.needs_point}


def read_options(given: Any, letters: int) -> tuple[Option, ...]:
    """Options as the benchmark gives them: a list of `label`, `action` and `need_parameter`.

    Args:
        letters: how many there can be.

    Raises:
        UserError: not such a list, a letter twice, or one that comes after the last.
    """
    known = ascii_lowercase[:letters]
    expected = f'a list of {{"label": "a", "action": "…", "need_parameter": false}}, labels {known[0]} to {known[-1]}'
    if not isinstance(given, Sequence) or isinstance(given, str) or not 1 <= len(given) <= letters:
        raise UserError(f"The options to choose from are {brief(given)}; expected {expected}.")
    found = []
    for option in given:
        right = isinstance(option, Mapping) and isinstance(option.get("action"), str)
        label = str(option.get("label")).strip().lower() if right else ""
        needs = option.get("need_parameter", False) if right else None
        wordy = right and len(option["action"]) > MOST_WORDS
        if len(label) != 1 or label not in known or wordy or not isinstance(needs, bool):
            raise UserError(f"The option {brief(option)} cannot be chosen; expected {expected}.")
        found.append(Option(label, " ".join(option["action"].split()), needs))
    if len({option.label for option in found}) < len(found):
        raise UserError(f"The options {brief(given)} have a letter twice.")
    return tuple(found)


def in_words(options: Sequence[Option]) -> str:
    """The options as a prompt lists them: `a pick up the cube (point), b press the button`."""
    return ", ".join(f"{o.label} {o.action}{' (point)' * o.needs_point}" for o in options)
