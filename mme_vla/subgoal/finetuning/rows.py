"""Training rows of the subgoal predictors, in the layout of ms-swift: messages, images, videos, objects."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from mme_vla.embodiment.robomme import SIDE
from mme_vla.errors import UserError, did_you_mean
from mme_vla.subgoal.answers import SubgoalHistory
from mme_vla.subgoal.finetuning.labels import Labels, keyframes, selected_steps, windows
from mme_vla.subgoal.words.parsing import Point, mark_points
from mme_vla.subgoal.words.prompts import memer_answer, memer_system, memer_user, subgoal_system, subgoal_user

Row = dict[str, Any]
SETS = {"simple": ("qwenvl", "simple"), "grounded": ("qwenvl", "grounded"), "memer": ("memer", "grounded")}
SETS |= {"memer_simple": ("memer", "simple")}
"""A set's name → (folder of its pictures, kind of subgoal). The paper trains the first three."""


@dataclass(frozen=True)
class RowOptions:
    """How rows are made.

    noise: lowest and highest integer added to every coordinate, drawn anew for each row; None adds none.
    repeat_changes: repeat rows at changes of subgoal (as released only while drawing figures).
    short_segments: a row for segments shorter than the stride too (not as released).
    second_keyframe: find a second keyframe in one window (as released it is missed, and all that follow with it).
    substring_match: give ButtonUnmask the extra keyframes of ButtonUnmaskSwap, as released.
    seed: of the noise.
    """

    noise: tuple[int, int] | None = (-2, 1)
    repeat_changes: bool = True
    short_segments: bool = False
    second_keyframe: bool = True
    substring_match: bool = False
    seed: int = 42

    def __post_init__(self) -> None:
        if self.noise is not None:
            whole = all(isinstance(value, int) for value in self.noise)
            if not whole or len(self.noise) != 2 or self.noise[0] > self.noise[1]:
                raise UserError(f"noise={list(self.noise)} must be [lowest, highest] in whole pixels, or null.")
        if not isinstance(self.seed, int) or self.seed < 0:
            raise UserError(f"seed={self.seed!r} must be a whole number, 0 or more.")


@dataclass(frozen=True)
class EpisodeRows:
    """The rows of one episode in one set, and the pictures they refer to: frames by file name, and the video's name."""

    rows: list[Row]
    images: dict[str, int]
    video: str | None


def episode_rows(name: str, labels: Labels, options: RowOptions) -> EpisodeRows:
    """The rows of one episode.

    Args:
        name: a key of `SETS`.

    Raises:
        UserError: another name.
    """
    if name not in SETS:
        raise UserError(f"sets: {name!r}. {did_you_mean(str(name), SETS)}")
    folder, kind = SETS[name]
    build = _memer if folder == "memer" else _qwenvl
    stem = f"{folder}/images/{labels.task}_ep{labels.number}"
    video = f"{stem}_video.mp4" if labels.exec_start else None
    # Bytes of the names, so that the noise of an episode does not depend on which others are built.
    rng = np.random.default_rng([options.seed, *f"{name}/{labels.task}".encode(), labels.number])
    rows: list[Row] = []
    images: dict[str, int] = {}
    for messages, points, frames in build(kind, labels, options):
        names = [f"{stem}_step{t}.png" for t in frames]
        images.update(zip(names, frames, strict=True))
        system, user, answer = messages
        row: Row = {
            "messages": [
                {"role": "system", "content": system},
                {"role": "user", "content": user},
                {"role": "assistant", "content": answer},
            ]
        }
        if kind == "grounded":
            row["objects"] = {"ref": [], "bbox": [_moved(point, options.noise, rng) for point in points]}
        row["images"] = names
        if video:
            row["videos"] = [video]
        rows.append(row)
    return EpisodeRows(rows, images, video)


Draft = tuple[tuple[str, str, str], list[Point], list[int]]  # texts, points, frames


def _qwenvl(kind: str, labels: Labels, options: RowOptions) -> Iterator[Draft]:
    steps, repeats = selected_steps(labels, options.short_segments)
    history = SubgoalHistory()
    for t in steps:
        answer, points = mark_points(labels.texts(kind)[t])
        user = subgoal_user(kind, labels.goal, history.entries, video=labels.exec_start > 0)
        texts = (subgoal_system(kind), user, answer)
        for _ in range(1 + (repeats.get(t, 0) if options.repeat_changes else 0)):
            yield texts, [*history.points, *points], [t]
        history.add(answer, points)


def _memer(kind: str, labels: Labels, options: RowOptions) -> Iterator[Draft]:
    wanted = keyframes(labels, options.substring_match)
    for window in windows(labels, wanted, one_a_window=not options.second_keyframe):
        subtask, points = mark_points(labels.texts(kind)[window.frames[-1]])
        user = memer_user(labels.goal, len(window.past), len(window.frames), video=labels.exec_start > 0)
        texts = (memer_system(), user, memer_answer(subtask, window.positions))
        yield texts, points, [*window.past, *window.frames]


def _moved(point: Point, noise: tuple[int, int] | None, rng: np.random.Generator) -> list[int]:
    if noise is None:
        return list(point)
    shift = rng.integers(noise[0], noise[1] + 1, 2)
    return np.clip(np.array(point) + shift, 0, SIDE - 1).tolist()
