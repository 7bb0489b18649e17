"""A typed notebook of one episode: counts, identities and routes, which only change as such things can.

A model proposes entries; `Notebook.written` takes them all or refuses them all.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from mme_vla.errors import brief
from mme_vla.files import is_text
from mme_vla.subgoal.words.parsing import MalformedAnswer

MOST_NOTES, MOST_STEPS, MOST_WORDS, MOST_COUNT = 16, 32, 200, 99


@dataclass(frozen=True)
class Count:
    """How often something has been done; it never falls, and one finished subgoal adds one at most."""

    value: int

    def to_dict(self) -> dict[str, Any]:
        """As a model writes it, without the name."""
        return {"kind": "count", "value": self.value}

    def check(self, before: "Count | None", finished: bool) -> None:
        """See `Notebook.written`."""
        if before is not None and not before.value <= self.value <= before.value + finished:
            raise MalformedAnswer(f"a count goes from {before.value} to {self.value}; it may stay or grow by one")


@dataclass(frozen=True)
class Identity:
    """Which thing is meant, in words that tell it from the others."""

    words: str

    def to_dict(self) -> dict[str, Any]:
        """As a model writes it, without the name."""
        return {"kind": "identity", "words": self.words}

    def check(self, before: "Identity | None", finished: bool) -> None:
        """See `Notebook.written`: things are moved, so that other words may tell them."""


@dataclass(frozen=True)
class Route:
    """Steps in order, and how many are done; they stay what they were, and one finished subgoal does one at most."""

    steps: tuple[str, ...]
    done: int = 0

    def to_dict(self) -> dict[str, Any]:
        """As a model writes it, without the name."""
        return {"kind": "route", "steps": list(self.steps), "done": self.done}

    def check(self, before: "Route | None", finished: bool) -> None:
        """See `Notebook.written`."""
        if self.done > len(self.steps):
            raise MalformedAnswer(f"{self.done} of {len(self.steps)} steps cannot be done")
        if before is not None and before.steps != self.steps:
            raise MalformedAnswer("the steps of a route were changed")
        if before is not None and not before.done <= self.done <= before.done + finished:
            raise MalformedAnswer(f"done goes from {before.done} to {self.done}; it may stay or grow by one")


Note = Count | Identity | Route


@dataclass(frozen=True)
class Notebook:
    """What is known, by name; and the subgoals that were finished, in order."""

    notes: Mapping[str, Note] = field(default_factory=dict)
    finished: tuple[str, ...] = ()

    def written(self, entries: Sequence[tuple[str, Note]], finished: str | None) -> "Notebook":
        """The notebook with these entries.

        Args:
            finished: the subgoal that was just completed; None where notes are taken before anything was done.

        Raises:
            MalformedAnswer: an entry changes in a way that its kind does not; nothing is written then.
        """
        notes = dict(self.notes)
        for name, note in entries:
            before = self.notes.get(name)
            if before is not None and type(before) is not type(note):
                raise MalformedAnswer(f"{brief(name)} was another kind of note before")
            note.check(before, finished is not None)  # type: ignore[arg-type]
            notes[name] = note
        if len(notes) > MOST_NOTES:
            raise MalformedAnswer(f"the notebook has room for {MOST_NOTES} notes")
        return Notebook(notes, self.finished if finished is None else (*self.finished, finished))

    def in_words(self) -> str:
        """The notebook as a model reads it, a note a line."""
        lines = []
        for name, note in self.notes.items():
            if isinstance(note, Count):
                lines.append(f"- count, {name}: {note.value}")
            elif isinstance(note, Identity):
                lines.append(f"- identity, {name}: {note.words}")
            else:
                steps = "; ".join(f"{i}. {step}" for i, step in enumerate(note.steps, 1))
                lines.append(f"- route, {name}: {steps} ({note.done} of {len(note.steps)} done)")
        lines += [f"- finished: {text}" for text in self.finished]
        return "\n".join(lines) or "- nothing yet"


def read_notes(given: Any) -> list[tuple[str, Note]]:
    """Entries that a model proposes: a list of maps with `name`, `kind` and what the kind has.

    Raises:
        MalformedAnswer: something else.
    """
    if not isinstance(given, list) or not all(isinstance(entry, dict) for entry in given):
        raise MalformedAnswer("notes is not a list of objects")
    return [(_words(entry.get("name"), "name"), _read(entry)) for entry in given[: MOST_NOTES + 1]]


def _read(entry: dict[str, Any]) -> Note:
    kind = entry.get("kind")
    if kind == "count":
        return Count(_whole(entry.get("value"), "value", MOST_COUNT))
    if kind == "identity":
        return Identity(_words(entry.get("words"), "words"))
    if kind == "route":
        steps = entry.get("steps")
        if not isinstance(steps, list) or not 1 <= len(steps) <= MOST_STEPS:
            raise MalformedAnswer(f"steps is not a list of 1 to {MOST_STEPS} texts")
        return Route(tuple(_words(step, "steps") for step in steps), _whole(entry.get("done", 0), "done", MOST_STEPS))
    raise MalformedAnswer(f"there are notes of the kinds count, identity and route, not {brief(kind)}")


def _words(given: Any, what: str) -> str:
    if not isinstance(given, str) or not is_text(given) or not (text := " ".join(given.split())):
        raise MalformedAnswer(f"the {what} of a note is no text")
    if len(text) > MOST_WORDS:
        raise MalformedAnswer(f"the {what} of a note has more than {MOST_WORDS} characters")
    return text


def _whole(given: Any, what: str, most: int) -> int:
    if isinstance(given, bool) or not isinstance(given, int) or not 0 <= given <= most:
        raise MalformedAnswer(f"the {what} of a note is no whole number from 0 to {most}")
    return given
