"""`notebook`: a prompted model that watches for completion, and takes typed notes only when it has
seen it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mme_vla.errors import brief, require
from mme_vla.registry import SUBGOALS
from mme_vla.subgoal.base import Subgoal, SubgoalEpisode
from mme_vla.subgoal.models.api import ApiFailure, MediaPart
from mme_vla.subgoal.prompted import CLIP, PromptedPredictor
from mme_vla.subgoal.text import (
    MalformedReply,
    json_object,
    parse_gemini,
    pixels_of_pairs,
    says_done,
)
from mme_vla.subgoal.vocabulary import describe_subgoals, example_of
from mme_vla.utils import is_text

MONITOR = (
    "You watch a robot arm at a table through a camera in front of it, and judge one thing alone:"
    " whether it has completed the subgoal that it was given. An object is picked up once it is in"
    " the air; it is put down once the gripper has let go of it; a button is pressed once it was"
    " pushed down; a place is reached once the tool is over it. What only seems to be about to"
    ' happen is not complete.\n\nAnswer with JSON alone: {"why": "what is to be seen", "done":'
    ' true} or {"why": "…", "done": false}.'
)


def planner_system(task: str, kind: str) -> str:
    """The system prompt of the planner.

    Args:
        task: its name; for an unknown one the subgoals of all tasks are listed. kind: `simple` or
            `grounded`.
    """
    example = example_of(task, kind)
    parts = [
        (
            "You lead a robot arm at a table, which you see through a camera in front of it. You"
            " keep a notebook, the only thing that you remember from one question to the next:"
            " write down what later decisions depend on. Whether a subgoal is complete is judged by"
            " somebody else; you are asked once it is, and name the next one."
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


def opening_query(goal: str, video: bool) -> str:
    """The planner's first question; its images come before it, the demonstration video first."""
    context = (
        "The video shows what happened before the robot's turn, the image shows the scene now. Note"
        " what has to be remembered of the video."
        if video
        else "The image shows the scene at the start."
    )
    return f"The task: {goal}\n{context} Name the first subgoal."


def next_query(goal: str, finished: str, notes: str, clip: bool) -> str:
    """A later question to the planner; the video of the finished subgoal, if it has frames, comes
    before it.
    """
    context = "The image shows the scene now."
    if clip:
        context = "The video shows how it was done, the image the scene now."
    return (
        f"The task: {goal}\nYour notebook:\n{notes}\nThe subgoal {finished!r} is complete."
        f" {context} Bring the notebook up to date, and name the next subgoal."
    )


def monitor_query(goal: str, subgoal: str, clip: bool) -> str:
    """A question to the monitor; its images come before it."""
    context = (
        "The video shows what the robot did since it was given the subgoal, the image the scene"
        " now."
        if clip
        else "The image shows the scene now."
    )
    return f"The task: {goal}\nThe subgoal: {subgoal}\n{context} Is the subgoal complete?"


MOST_NOTES, MOST_STEPS, MOST_WORDS, MOST_COUNT = 16, 32, 200, 99


@dataclass(frozen=True)
class Count:
    """How often something has been done; it never falls, and one finished subgoal adds
    one at most.
    """

    value: int

    def check(self, before: "Count | None", finished: bool) -> None:
        if before is not None and not before.value <= self.value <= before.value + finished:
            raise MalformedReply(
                f"a count goes from {before.value} to {self.value}; it may stay or grow by one"
            )


@dataclass(frozen=True)
class Identity:
    """Which thing is meant, in words that tell it from the others."""

    words: str

    def check(self, before: "Identity | None", finished: bool) -> None:
        """See `Notebook.with_entries`: things are moved, so that other words may tell them."""


@dataclass(frozen=True)
class Route:
    """Steps in order, and how many are done; they stay what they were, and one finished subgoal
    does one at most.
    """

    steps: tuple[str, ...]
    done: int = 0

    def check(self, before: "Route | None", finished: bool) -> None:
        require(
            self.done <= len(self.steps),
            f"{self.done} of {len(self.steps)} steps cannot be done",
            MalformedReply,
        )
        require(
            before is None or before.steps == self.steps,
            "the steps of a route were changed",
            MalformedReply,
        )
        if before is not None and not before.done <= self.done <= before.done + finished:
            raise MalformedReply(
                f"done goes from {before.done} to {self.done}; it may stay or grow by one"
            )


Note = Count | Identity | Route


@dataclass(frozen=True)
class Notebook:
    """What is known, by name; and the subgoals that were finished, in order."""

    notes: Mapping[str, Note] = field(default_factory=dict)
    finished: tuple[str, ...] = ()

    def with_entries(self, entries: Sequence[tuple[str, Note]], finished: str | None) -> "Notebook":
        """The notebook with these entries.

        Args:
            finished: the subgoal that was just completed; None where notes are taken before
                anything was done.
        """
        notes = dict(self.notes)
        for name, note in entries:
            before = self.notes.get(name)
            if before is not None and type(before) is not type(note):
                raise MalformedReply(f"{brief(name)} was another kind of note before")
            note.check(before, finished is not None)  # type: ignore[arg-type]
            notes[name] = note
        require(len(notes) <= MOST_NOTES, f"the notebook takes {MOST_NOTES} notes", MalformedReply)
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


def read_notes(entries: Any) -> list[tuple[str, Note]]:
    """Entries that a model proposes: a list of maps with `name`, `kind` and what the kind has."""
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise MalformedReply("notes is not a list of objects")
    return [
        (_words(entry.get("name"), "name"), _read(entry)) for entry in entries[: MOST_NOTES + 1]
    ]


def _read(entry: dict[str, Any]) -> Note:
    kind = entry.get("kind")
    if kind == "count":
        return Count(_integer(entry.get("value"), "value", MOST_COUNT))
    if kind == "identity":
        return Identity(_words(entry.get("words"), "words"))
    if kind == "route":
        steps: Any = entry.get("steps")
        require(
            isinstance(steps, list) and 1 <= len(steps) <= MOST_STEPS,
            f"steps is not a list of 1 to {MOST_STEPS} texts",
            MalformedReply,
        )
        return Route(
            tuple(_words(step, "steps") for step in steps),
            _integer(entry.get("done", 0), "done", MOST_STEPS),
        )
    raise MalformedReply(
        f"there are notes of the kinds count, identity and route, not {brief(kind)}"
    )


def _words(value: Any, what: str) -> str:
    if not isinstance(value, str) or not is_text(value) or not (text := " ".join(value.split())):
        raise MalformedReply(f"the {what} of a note is no text")
    require(
        len(text) <= MOST_WORDS,
        f"the {what} of a note has more than {MOST_WORDS} characters",
        MalformedReply,
    )
    return text


def _integer(value: Any, what: str, most: int) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= most:
        raise MalformedReply(f"the {what} of a note is no whole number from 0 to {most}")
    return value


LONGEST = 200  # frames of a subgoal that are shown: the last ones of a longer one


class NotebookEpisode(SubgoalEpisode):
    """An episode, its notebook, and the frames since its subgoal was given.

    agreed: the monitor has seen the current subgoal complete, and the next one is still to be
    named.
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
        """The video of the current subgoal, if it is worth one, and the present image."""
        clip = [MediaPart(np.stack(self.since))] if len(self.since) >= CLIP else []
        return [*clip, MediaPart(self.frame)]


@SUBGOALS.register("notebook")
class NotebookPredictor(PromptedPredictor):
    """Asks whether the subgoal is complete; only then brings the notebook up to date and names the
    next one.

    The notebook is what a question tells of the past, beside the frames of the current subgoal: no
    conversation grows. Nothing that goes wrong ends an episode: it keeps its subgoal and its
    notebook, and the problem is counted.

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

    def _ask(self, episode: NotebookEpisode) -> Subgoal:
        replies: list[str] = []
        try:
            if episode.subgoal.text is not None and not self._complete(episode, replies):
                return Subgoal(
                    episode.subgoal.text, episode.subgoal.points, queried=True, reply=replies[0]
                )
            return self._next(episode, replies)
        except ApiFailure as failure:
            problem, reason = failure.problem, str(failure)
        except MalformedReply as error:
            problem, reason = "malformed", str(error)
        with self._lock:
            return self.unchanged(episode, problem, "\n".join(replies), reason)

    def _complete(self, episode: NotebookEpisode, replies: list[str]) -> bool:
        """Whether the monitor has seen the current subgoal complete, now or before; its answer goes
        into `replies`.
        """
        if not episode.agreed:
            images = episode.images()
            query = monitor_query(episode.goal, str(episode.subgoal.text), len(images) > 1)
            replies.append(self.api.ask(MONITOR, [("user", [*images, query])]).text)
            done: Any = json_object(replies[-1]).get("done")
            require(
                isinstance(done, bool),
                "the monitor's answer does not say whether it is done",
                MalformedReply,
            )
            episode.agreed = done
        return episode.agreed

    def _next(self, episode: NotebookEpisode, replies: list[str]) -> Subgoal:
        """The planner's next subgoal, its notes written; its answer is added to `replies`."""
        finished, parts = episode.subgoal.text, episode.images()
        if finished is None:
            video = [MediaPart(episode.video)] if len(episode.video) else []
            parts = [*video, MediaPart(episode.frame)]
            query = opening_query(episode.goal, bool(video))
        else:
            query = next_query(episode.goal, finished, episode.notebook.in_words(), len(parts) > 1)
        replies.append(
            self.api.ask(planner_system(episode.task, self.kind), [("user", [*parts, query])]).text
        )
        text = parse_gemini(replies[-1]).lower()
        notebook = episode.notebook.with_entries(
            read_notes(json_object(replies[-1]).get("notes", [])), finished
        )
        if says_done(text):
            subgoal = Subgoal(
                finished, episode.subgoal.points, queried=True, reply="\n".join(replies)
            )
        else:
            subgoal = self.accepted(pixels_of_pairs(text), "\n".join(replies))
        episode.notebook, episode.since, episode.agreed = notebook, [], False
        return subgoal
