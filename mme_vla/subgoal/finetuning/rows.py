"""Training rows of the subgoal predictors in the layout of ms-swift.

A row has `messages`, `images`, `videos` and `objects`.
"""

import shlex
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
import torch
from pydantic import BaseModel, Field, model_validator
from torch import Tensor

from mme_vla.embodiment.robomme import SIDE
from mme_vla.errors import UserError, did_you_mean, listed, require
from mme_vla.subgoal.answers import SubgoalHistory
from mme_vla.subgoal.clips import VIDEO_FRAMES, Clip, read_image
from mme_vla.subgoal.finetuning.labels import Labels, keyframes, selected_steps, windows
from mme_vla.subgoal.models.qwen3vl import IMAGE_TOKENS, TOKEN_SIDE, VIDEO_TOKENS, VLM, Question
from mme_vla.subgoal.text import (
    BBOX,
    MEMER_SYSTEM,
    Point,
    mark_points,
    memer_reply,
    memer_user,
    subgoal_system,
    subgoal_user,
    write_boxes,
)
from mme_vla.utils import Sums, inside, is_text, read_lines
from mme_vla.utils.validation import validated

Row = dict[str, Any]
SETS = {
    "simple": ("qwenvl", "simple"),
    "grounded": ("qwenvl", "grounded"),
    "memer": ("memer", "grounded"),
    "memer_simple": ("memer", "simple"),
}
"""A set's name → (folder of its images, kind of subgoal). The paper trains the first three."""


@dataclass(frozen=True)
class RowOptions:
    """How rows are made.

    noise: lowest and highest integer added to every coordinate, sampled for each row; None adds
        none.
    repeat_changes: repeat rows at changes of subgoal (as the released code does for figures).
    short_segments: a row for segments shorter than the stride too (not as released).
    second_keyframe: find a second keyframe in one window (as released it is missed, and all that
        follow with it).
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
        if self.noise is not None and self.noise[0] > self.noise[1]:
            raise UserError(
                f"noise={list(self.noise)} must be [lowest, highest] in whole pixels, or null."
            )


@dataclass(frozen=True)
class EpisodeRows:
    """The rows of one episode in one set.

    images: frame numbers by the file names of the rows.
    video: its file name; None without one.
    """

    rows: list[Row]
    images: dict[str, int]
    video: str | None


def episode_rows(name: str, labels: Labels, options: RowOptions) -> EpisodeRows:
    """Make the rows of one episode.

    Args:
        name: a key of `SETS`.
    """
    require(name in SETS, f"sets: {name!r}. {did_you_mean(str(name), SETS)}")
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
        system, user, target = messages
        row: Row = {
            "messages": [
                {"role": "system", "content": system},
                {"role": "user", "content": user},
                {"role": "assistant", "content": target},
            ]
        }
        if kind == "grounded":
            least, most = options.noise or (0, 0)
            boxes = []
            for point in points:
                moved = np.array(point) + rng.integers(least, most + 1, 2)
                boxes.append(np.clip(moved, 0, SIDE - 1).tolist())
            row["objects"] = {"ref": [], "bbox": boxes}
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
        target, points = mark_points(labels.texts(kind)[t])
        user = subgoal_user(kind, labels.goal, history.entries, video=labels.exec_start > 0)
        texts = (subgoal_system(kind), user, target)
        count = 1
        if options.repeat_changes:
            count += repeats.get(t, 0)
        for _ in range(count):
            yield texts, [*history.points, *points], [t]
        history.add(target, points)


def _memer(kind: str, labels: Labels, options: RowOptions) -> Iterator[Draft]:
    targets = keyframes(labels, options.substring_match)
    for window in windows(labels, targets, one_a_window=not options.second_keyframe):
        subtask, points = mark_points(labels.texts(kind)[window.frames[-1]])
        user = memer_user(
            labels.goal, len(window.past), len(window.frames), video=labels.exec_start > 0
        )
        texts = (MEMER_SYSTEM, user, memer_reply(subtask, window.positions))
        yield texts, points, [*window.past, *window.frames]


IGNORED = -100  # a label that does not count
_MARKS = 32  # tokens of the conversation's own marks, at most
_LIMIT = 2**31  # bytes of a file of rows
_TIME = 12  # tokens of a video frame's time stamp, at most

Coordinate = Annotated[int, Field(strict=True, ge=0, lt=2**20)]


class Message(BaseModel):
    """A part of a conversation."""

    role: Literal["system", "user", "assistant"]
    content: str


class Objects(BaseModel):
    """The points [row, column] that stand for the marks `BBOX`, in their order."""

    bbox: list[tuple[Coordinate, Coordinate]] = []


class TrainingRow(BaseModel):
    """A row of a file, which any program may have written. Paths are relative to the file."""

    messages: list[Message]
    images: list[str] = []
    videos: list[str] = []
    objects: Objects = Objects()

    @model_validator(mode="after")
    def _is_complete(self) -> Self:
        for i, message in enumerate(self.messages):
            if not is_text(message.content):
                raise ValueError(f"has half a character in messages[{i}].content.")
        roles = [message.role for message in self.messages]
        if roles != ["system", "user", "assistant"]:
            raise ValueError(
                "needs one message each of system, user and assistant, and has"
                f" {listed(roles) or 'none'}."
            )
        n_marks = sum(message.content.count(BBOX) for message in self.messages[1:])
        if n_marks != len(self.objects.bbox):
            raise ValueError(f"has {n_marks} marks {BBOX} for {len(self.objects.bbox)} points.")
        return self


def read_rows(file: str | Path) -> list[TrainingRow]:
    """Read a JSON-lines file."""
    path = Path(file)
    require(
        path.is_file(),
        f"{path} does not exist. Build it: mme-vla subgoal-build input=…"
        f" {shlex.quote(f'output={path.parent}')}",
    )
    Sums(path.parent, remedy="Build the training data again").check(path.name)
    rows = read_lines(path, _checked_row, "rows of training data", limit=_LIMIT)
    require(rows, f"{path} holds no row.")
    return rows


def _checked_row(row: Row) -> TrainingRow:
    try:
        return validated(TrainingRow, row, "The row of training data")
    except UserError as error:
        raise UserError(f"{error} Build the training data again.") from None


def texts_of(row: TrainingRow) -> tuple[str, str, str]:
    """Return system, user and answer of a row, points written as the model sees them."""
    system, user, target = (message.content for message in row.messages)
    points = row.objects.bbox
    n_points = user.count(BBOX)
    return system, write_boxes(user, points[:n_points]), write_boxes(target, points[n_points:])


def question_of(row: TrainingRow, folder: Path) -> Question:
    """Read the images of a row; paths are relative to `folder`."""
    system, user, target = texts_of(row)
    images = [read_image(inside(folder, name, "picture")) for name in row.images]
    videos = [Clip.read(inside(folder, name, "video")) for name in row.videos]
    return Question(system, user, images, videos, target)


class RowDataset(torch.utils.data.Dataset[Question]):
    """The rows of a file of at most `max_length` tokens; images are read with their row.

    left_out: number of longer rows.
    """

    def __init__(self, file: str | Path, tokenizer: Any, max_length: int = 3200) -> None:
        self.folder = Path(file).parent
        self._sums = Sums(self.folder, remedy="Build the training data again")
        rows = read_rows(file)
        with_images = [row for row in rows if row.images]
        require(with_images, f"{file} has no row with an image. Build the training data again.")
        example = with_images[0].images[0]
        height, width, _ = read_image(inside(self.folder, example, "picture")).shape
        n_tokens = round(height / TOKEN_SIDE) * round(width / TOKEN_SIDE)
        n_tokens = min(max(n_tokens, 4), IMAGE_TOKENS)
        # An image, and each pair of video frames, stands between two marks.
        video_tokens = VIDEO_FRAMES // 2 * (VIDEO_TOKENS + _TIME + 2)
        self.rows = []
        for row in rows:
            # An upper bound of the row's tokens, without reading its images
            total = _MARKS
            for text in texts_of(row):
                total += len(tokenizer.encode(text, add_special_tokens=False))
            total += len(row.images) * (n_tokens + 2)
            total += len(row.videos) * video_tokens
            if total <= max_length:
                self.rows.append(row)
        self.left_out = len(rows) - len(self.rows)
        require(self.rows, f"All rows of {file} are longer than max_length={max_length}; raise it.")

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, index: int) -> Question:
        row = self.rows[index]
        for name in (*row.images, *row.videos):
            self._sums.check(name)
        return question_of(row, self.folder)


class Collator:
    """Makes a batch with labels of questions with answers.

    Labels are the answer and its end; all other tokens are `IGNORED`.
    """

    def __init__(self, vlm: VLM) -> None:
        self.vlm = vlm
        self.start = vlm.processor.tokenizer.encode(
            "<|im_start|>assistant\n", add_special_tokens=False
        )
        self.end = vlm.processor.tokenizer.eos_token_id

    def __call__(self, questions: Sequence[Question]) -> dict[str, Any]:
        batch = dict(self.vlm.encode(questions, side="right"))
        batch["labels"] = torch.stack([self.labels(ids) for ids in batch["input_ids"]])
        return batch

    def labels(self, ids: Tensor) -> Tensor:
        listed = ids.tolist()
        width = len(self.start)
        starts = [i for i in range(len(listed) - width + 1) if listed[i : i + width] == self.start]
        first = starts[-1] + width
        stop = listed.index(self.end, first) + 1
        labels = torch.full_like(ids, IGNORED)
        labels[first:stop] = ids[first:stop]
        return labels


def hf_dataset(file: str | Path) -> Any:
    """Read a file of rows as a Hugging Face dataset in trl's conversational form.

    Columns: `messages` (role, and content as a list of parts with `type` and `text`), `images`
    (decoded on access) and `videos` (absolute paths).
    """
    from datasets import Dataset, Features, Image, List, Value

    folder = Path(file).resolve().parent
    columns: dict[str, list[Any]] = {"messages": [], "images": [], "videos": []}
    for row in read_rows(file):
        system, user, target = texts_of(row)
        messages = Question(system, user, target=target).messages()
        for message in messages:
            for content in message["content"]:
                content.setdefault("text", None)  # every part has the same keys
        images = [str(inside(folder, name, "picture")) for name in row.images]
        videos = [str(inside(folder, name, "video")) for name in row.videos]
        columns["messages"].append(messages)
        columns["images"].append(images)
        columns["videos"].append(videos)
    part = {"type": Value("string"), "text": Value("string")}
    features = Features(
        messages=List({"role": Value("string"), "content": List(part)}),
        images=List(Image()),
        videos=List(Value("string")),
    )
    return Dataset.from_dict(columns, features=features)
