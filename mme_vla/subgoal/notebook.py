"""`notebook`: a prompted model that takes typed notes whenever a subgoal is complete.

A *monitor* reports whether the current subgoal is complete. Then a *planner* updates the notebook
and names the next subgoal.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, PlainValidator, StrictInt

from mme_vla.config.sections import Range
from mme_vla.errors import UserError, brief
from mme_vla.registry import SUBGOALS
from mme_vla.subgoal.base import Subgoal, SubgoalEpisode
from mme_vla.subgoal.models.api import MediaPart
from mme_vla.subgoal.prompted import CLIP, PromptedPredictor
from mme_vla.subgoal.text import MalformedReply, json_object, numbered
from mme_vla.subgoal.vocabulary import describe_subgoals, example_of
from mme_vla.utils import is_text
from mme_vla.utils.validation import validated

MONITOR = (
    "You watch a robot arm at a table through a camera in front of it, and judge one thing alone:"
    " whether it has completed the subgoal that it was given. An object is picked up once it is in"
    " the air; it is put down once the gripper has let go of it; a button is pressed once it was"
    " pushed down; a place is reached once the tool is over it. What only seems to be about to"
    ' happen is not complete.\n\nAnswer with JSON alone: {"why": "what is to be seen", "done":'
    ' true} or {"why": "…", "done": false}.'
)


def planner_system(task: str, kind: str) -> str:
    """Return the system prompt of the planner.

    Args:
        task: its name; for an unknown one the subgoals of all tasks are listed.
        kind: `simple` or `grounded`.
    """
    example = example_of(task, kind)
    parts = [
        (
            "You lead a robot arm at a table, which you see through a camera in front of it. You"
            " keep a notebook, the only thing that you remember from one question to the next:"
            " write down what later decisions depend on. Whether a subgoal is complete is judged by"
            " somebody else; you are asked once it is, and name the next one."  # codespell:ignore
        ),
        *describe_subgoals(task, kind),
        (
            "Notes are of three kinds. A count says how often something has been done; it may stay"
            " or grow by one. An identity says which thing is meant, in words that tell it from the"
            " others, where it is now. A route is a list of steps that never changes, and how many"
            " of them are done. A note with a name that is there already takes its place."
        ),
        (
            'Answer with JSON alone: {"notes": [{"kind": "count", "name": "cubes in the bin",'
            ' "value": 1}, {"kind": "identity", "name": "the container with the red cube",'
            ' "words": "the left one of the two in front"}, {"kind": "route", "name": "the'
            f' pattern", "steps": ["move left"], "done": 0}}], "subgoal": "{example}"}}. Leave'
            ' "notes" empty where there is nothing to write.'
        ),
    ]
    return "\n\n".join(parts)


MOST_NOTES = 16
MOST_STEPS = 32  # of a route
MOST_WORDS = 200  # characters of a text
MOST_COUNT = 99


def _words(value: Any) -> str:
    text = " ".join(value.split()) if isinstance(value, str) else ""
    if not text or not is_text(text):
        raise ValueError("is no text")
    if len(text) > MOST_WORDS:
        raise ValueError(f"has more than {MOST_WORDS} characters")
    return text


Words = Annotated[str, PlainValidator(_words)]


@dataclass(frozen=True)
class Count:
    """How often something has been done; a finished subgoal adds at most one."""

    value: Annotated[StrictInt, Range(0, MOST_COUNT)]

    def check(self, before: "Count | None", finished: bool) -> None:
        """Raise MalformedReply if this may not follow the note `before`."""
        if before is not None:
            _check_growth("a count", before.value, self.value, finished)


@dataclass(frozen=True)
class Identity:
    """The description of an object that distinguishes it from the others."""

    words: Words

    def check(self, before: "Identity | None", finished: bool) -> None:
        """Accept any change: an object that was moved needs another description."""


@dataclass(frozen=True)
class Route:
    """Steps that never change, and how many are done; a finished subgoal adds at most one."""

    steps: Annotated[tuple[Words, ...], Field(min_length=1, max_length=MOST_STEPS)]
    done: Annotated[StrictInt, Range(0, MOST_STEPS)] = 0

    def check(self, before: "Route | None", finished: bool) -> None:
        """Raise MalformedReply if this may not follow the note `before`."""
        if self.done > len(self.steps):
            raise MalformedReply(f"{self.done} of {len(self.steps)} steps cannot be done")
        if before is None:
            return
        if before.steps != self.steps:
            raise MalformedReply("the steps of a route were changed")
        _check_growth("done", before.done, self.done, finished)


def _check_growth(what: str, before: int, value: int, finished: bool) -> None:
    most = before + 1 if finished else before
    if not before <= value <= most:
        raise MalformedReply(f"{what} goes from {before} to {value}; it may stay or grow by one")


Note = Count | Identity | Route
KINDS: Mapping[str, type[Note]] = {"count": Count, "identity": Identity, "route": Route}


@dataclass(frozen=True)
class Entry:
    """What an entry of an answer has beside the fields of its kind."""

    name: Words
    kind: Literal["count", "identity", "route"]


@dataclass(frozen=True)
class Notebook:
    """Notes by name, and the finished subgoals in order."""

    notes: Mapping[str, Note] = field(default_factory=dict)
    finished: tuple[str, ...] = ()

    def with_entries(self, entries: Sequence[tuple[str, Note]], finished: str | None) -> "Notebook":
        """Return the notebook with these entries, which replace notes of the same name.

        Args:
            finished: the subgoal that was just completed; None before the first one.

        Raises:
            MalformedReply: a note changes in a way that its kind forbids.
        """
        notes = dict(self.notes)
        for name, note in entries:
            before = self.notes.get(name)
            if before is not None and type(before) is not type(note):
                raise MalformedReply(f"{brief(name)} was another kind of note before")
            note.check(before, finished is not None)  # type: ignore[arg-type]
            notes[name] = note
        if len(notes) > MOST_NOTES:
            raise MalformedReply(f"the notebook takes {MOST_NOTES} notes")
        if finished is None:
            return Notebook(notes, self.finished)
        return Notebook(notes, (*self.finished, finished))

    def in_words(self) -> str:
        """Return the notebook as a model reads it, one note a line."""
        lines = []
        for name, note in self.notes.items():
            if isinstance(note, Count):
                lines.append(f"- count, {name}: {note.value}")
            elif isinstance(note, Identity):
                lines.append(f"- identity, {name}: {note.words}")
            else:
                steps = numbered(note.steps)
                lines.append(f"- route, {name}: {steps} ({note.done} of {len(note.steps)} done)")
        lines += [f"- finished: {text}" for text in self.finished]
        return "\n".join(lines) or "- nothing yet"


def read_notes(entries: Any) -> list[tuple[str, Note]]:
    """Read the notes of a planner's answer: objects with `name`, `kind` and the kind's fields.

    Returns:
        Names and notes, at most one more than a notebook takes.

    Raises:
        MalformedReply: a field is missing or of another type.
    """
    if not isinstance(entries, list):
        raise MalformedReply("notes is not a list of objects")
    notes = []
    for fields in entries[: MOST_NOTES + 1]:
        try:
            entry = validated(Entry, fields, "A note")
            note = validated(KINDS[entry.kind], fields, "A note")
        except UserError as error:
            raise MalformedReply(str(error)) from None
        notes.append((entry.name, note))
    return notes


LONGEST = 200  # frames of a subgoal that are shown: the last ones of a longer one


class NotebookEpisode(SubgoalEpisode):
    """An episode, its notebook, and the frames of the current subgoal.

    since: [H, W, 3] each, since the subgoal was named.
    agreed: the monitor has reported the current subgoal as complete, and the planner has not named
        the next one yet.
    """

    def __init__(self, goal: str, video: np.ndarray | None, task: str) -> None:
        super().__init__(goal, video, task)
        self.notebook = Notebook()
        self.since: list[np.ndarray] = []
        self.agreed = False

    def observe(self, frames: np.ndarray, info: Mapping[str, Any] | None = None) -> None:
        super().observe(frames, info)
        self.since = [*self.since, *frames][-LONGEST:]

    def images(self) -> list[MediaPart]:
        """Return the video of the current subgoal, unless it is very short, and the image."""
        if len(self.since) < CLIP:
            return [MediaPart(self.frame)]
        return [MediaPart(np.stack(self.since)), MediaPart(self.frame)]


@SUBGOALS.register("notebook")
class NotebookPredictor(PromptedPredictor):
    """Asks the monitor whether the subgoal is complete, and only then the planner for the next one.

    A question contains the notebook and the frames of the current subgoal, and no conversation.
    After a failure the notebook stays as it was.

    Args:
        interval: steps between two questions to the monitor.
    """

    episode_type = NotebookEpisode

    def __init__(
        self,
        kind: str = "grounded",
        interval: int = 16,
        workers: int = 4,
        api: str = "openai",
        client: Any = None,
        **settings: Any,
    ) -> None:
        super().__init__(kind, interval, workers, api, client, settings)

    def _predict_one(self, episode: NotebookEpisode, replies: list[str]) -> Subgoal:
        last = episode.subgoal
        if last.text is not None and not self._complete(episode, last.text, replies):
            return Subgoal(last.text, last.points, queried=True, reply=replies[0])
        return self._next(episode, replies)

    def _complete(self, episode: NotebookEpisode, subgoal: str, replies: list[str]) -> bool:
        """Return whether the monitor has reported the subgoal as complete, now or before.

        Its answer is added to `replies`.
        """
        if episode.agreed:
            return True
        images = episode.images()
        context = "The image shows the scene now."
        if len(images) > 1:
            context = (
                "The video shows what the robot did since it was given the subgoal, the image the"
                " scene now."
            )
        query = (
            f"The task: {episode.goal}\nThe subgoal: {subgoal}\n{context} Is the subgoal complete?"
        )
        reply = self.api.ask(MONITOR, [("user", [*images, query])]).text
        replies.append(reply)
        done = json_object(reply).get("done")
        if not isinstance(done, bool):
            raise MalformedReply("the monitor's answer does not say whether it is done")
        episode.agreed = done
        return done

    def _next(self, episode: NotebookEpisode, replies: list[str]) -> Subgoal:
        """Return the planner's next subgoal, and replace the notebook.

        The planner's answer is added to `replies`.
        """
        finished = episode.subgoal.text
        if finished is None:
            images = [MediaPart(episode.frame)]
            context = "The image shows the scene at the start."
            if len(episode.video):
                images.insert(0, MediaPart(episode.video))
                context = (
                    "The video shows what happened before the robot's turn, the image shows the"
                    " scene now. Note what has to be remembered of the video."
                )
            query = f"{context} Name the first subgoal."
        else:
            images = episode.images()
            context = "The image shows the scene now."
            if len(images) > 1:
                context = "The video shows how it was done, the image the scene now."
            query = (
                f"Your notebook:\n{episode.notebook.in_words()}\nThe subgoal {finished!r} is"
                f" complete. {context} Bring the notebook up to date, and name the next subgoal."
            )
        query = f"The task: {episode.goal}\n{query}"
        system = planner_system(episode.task, self.kind)
        reply = self.api.ask(system, [("user", [*images, query])]).text
        replies.append(reply)

        # The whole answer is read before anything of the episode is changed.
        subgoal = self._named(episode, replies)
        entries = read_notes(json_object(reply).get("notes", []))
        notebook = episode.notebook.with_entries(entries, finished)
        episode.notebook = notebook
        episode.since = []
        episode.agreed = False
        return subgoal
