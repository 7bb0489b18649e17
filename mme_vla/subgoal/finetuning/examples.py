"""Rows of the fine-tuning data → questions with their pictures, batches, and Hugging Face datasets."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mme_vla.errors import UserError, brief
from mme_vla.files import Sums, inside, is_text, read_json_lines
from mme_vla.subgoal.clips import VIDEO_FRAMES, Clip, read_image
from mme_vla.subgoal.models.qwen3vl import IMAGE_TOKENS, TOKEN_SIDE, VIDEO_TOKENS, VLM, Question
from mme_vla.subgoal.words.parsing import write_boxes
from mme_vla.subgoal.words.prompts import BBOX

Row = dict[str, Any]
IGNORED = -100  # a label that does not count
_MARKS = 32  # tokens of the conversation's own marks, at most
_LIMIT = 2**31  # bytes of a file of rows
_TIME = 12  # tokens of a video frame's time stamp, at most


def read_rows(file: str | Path) -> list[Row]:
    """Read a JSON-lines file.

    Raises:
        UserError: it does not exist, is damaged, or holds no row.
    """
    path = Path(file)
    if not path.is_file():
        raise UserError(
            f"{path} does not exist. Build it: python -m mme_vla.subgoal.build input=… output={path.parent}"
        )
    Sums(path.parent, remedy="Build the training data again").check(path.name)
    rows: list[Row] = []
    for number, row in read_json_lines(path, "rows of training data", _LIMIT):
        if reason := _fault(row):
            raise UserError(f"{path}, line {number}, is no row: {reason}. Build the training data again.")
        rows.append(row)
    if not rows:
        raise UserError(f"{path} holds no row.")
    return rows


def _fault(row: Row) -> str:
    """What is wrong with a row; empty if nothing is."""
    messages = row.get("messages")
    if not isinstance(messages, list) or not all(isinstance(message, dict) for message in messages):
        return "it has no messages"
    if [message.get("role") for message in messages] != ["system", "user", "assistant"]:
        return "expected one message each of system, user and assistant"
    texts = [message.get("content") for message in messages]
    if not all(isinstance(text, str) and is_text(text) for text in texts):
        return "the content of a message is no text"
    for key in ("images", "videos"):
        names = row.get(key, [])
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            return f"{key} is {brief(names)}, not a list of files"
    objects = row.get("objects", {})
    points = objects.get("bbox", []) if isinstance(objects, dict) else None
    if not isinstance(points, list) or not all(_is_point(point) for point in points):
        return f"objects is {brief(objects)}, where bbox should be a list of [row, column]"
    if (marks := texts[1].count(BBOX) + texts[2].count(BBOX)) != len(points):
        return f"it has {marks} marks {BBOX} for {len(points)} points"
    return ""


def _is_point(point: object) -> bool:
    return isinstance(point, list) and len(point) == 2 and all(type(n) is int and 0 <= n < 2**20 for n in point)


def texts_of(row: Row) -> tuple[str, str, str]:
    """System, user and answer of a row, points written as the model sees them."""
    system, user, answer = (message["content"] for message in row["messages"])
    points = [(y, x) for y, x in row.get("objects", {}).get("bbox", [])]
    asked = user.count(BBOX)
    return system, write_boxes(user, points[:asked]), write_boxes(answer, points[asked:])


def question_of(row: Row, folder: Path) -> Question:
    """A row with its pictures; paths are relative to `folder`."""
    system, user, answer = texts_of(row)
    images = [read_image(inside(folder, name, "picture")) for name in row.get("images", [])]
    videos = [Clip.read(inside(folder, name, "video")) for name in row.get("videos", [])]
    return Question(system, user, images, videos, answer)


class RowDataset(torch.utils.data.Dataset[Question]):
    """The rows of a file that are no longer than `max_length` tokens, pictures read when asked for.

    left_out: how many are longer.
    """

    def __init__(self, file: str | Path, tokenizer: Any, max_length: int = 3200) -> None:
        self.folder = Path(file).parent
        self._sums = Sums(self.folder, remedy="Build the training data again")
        rows = read_rows(file)
        shown = next((name for row in rows for name in row.get("images", [])), None)
        if shown is None:
            raise UserError(f"{file} has no row with a picture. Build the training data again.")
        image = _image_tokens(read_image(inside(self.folder, shown, "picture")).shape)
        self.rows = [row for row in rows if _longest(row, tokenizer, image) <= max_length]
        self.left_out = len(rows) - len(self.rows)
        if not self.rows:
            raise UserError(f"All rows of {file} are longer than max_length={max_length}; raise it.")

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, index: int) -> Question:
        row = self.rows[index]
        for name in (*row.get("images", []), *row.get("videos", [])):
            self._sums.check(name)
        return question_of(row, self.folder)


class Collator:
    """Questions with answers → a batch with labels: the answer and its end count, all else is `IGNORED`."""

    def __init__(self, vlm: VLM) -> None:
        self.vlm = vlm
        self.start = vlm.processor.tokenizer.encode("<|im_start|>assistant\n", add_special_tokens=False)
        self.end = vlm.processor.tokenizer.eos_token_id

    def __call__(self, questions: Sequence[Question]) -> dict[str, Any]:
        batch = dict(self.vlm.encode(questions, side="right"))
        batch["labels"] = torch.stack([self.labels(ids) for ids in batch["input_ids"]])
        return batch

    def labels(self, ids: Tensor) -> Tensor:
        """Labels [n] of one conversation [n]."""
        listed = ids.tolist()
        width = len(self.start)
        starts = [i for i in range(len(listed) - width + 1) if listed[i : i + width] == self.start]
        first = starts[-1] + width
        stop = listed.index(self.end, first) + 1
        labels = torch.full_like(ids, IGNORED)
        labels[first:stop] = ids[first:stop]
        return labels


def hf_dataset(file: str | Path) -> Any:
    """A file of rows as a Hugging Face dataset in trl's conversational form.

    Columns: `messages` (role, and content as a list of parts with `type` and `text`), `images` (pictures, decoded when
    asked for) and `videos` (absolute paths).
    """
    from datasets import Dataset, Features, Image, List, Value

    folder = Path(file).resolve().parent
    columns: dict[str, list[Any]] = {"messages": [], "images": [], "videos": []}
    for row in read_rows(file):
        system, user, answer = texts_of(row)
        messages = Question(system, user, answer=answer).messages()
        for message in messages:
            message["content"] = [{"type": p["type"], "text": p.get("text")} for p in message["content"]]
        columns["messages"].append(messages)
        columns["images"].append([str(inside(folder, name, "picture")) for name in row.get("images", [])])
        columns["videos"].append([str(inside(folder, name, "video")) for name in row.get("videos", [])])
    part = {"type": Value("string"), "text": Value("string")}
    features = Features(
        messages=List({"role": Value("string"), "content": List(part)}),
        images=List(Image()),
        videos=List(Value("string")),
    )
    return Dataset.from_dict(columns, features=features)


def _image_tokens(shape: Sequence[int]) -> int:
    return min(max(round(shape[0] / TOKEN_SIDE) * round(shape[1] / TOKEN_SIDE), 4), IMAGE_TOKENS)


def _longest(row: Row, tokenizer: Any, image: int) -> int:
    """An upper bound of the row's tokens, without reading its pictures."""
    words = sum(len(tokenizer.encode(text, add_special_tokens=False)) for text in texts_of(row))
    pairs = VIDEO_FRAMES // 2
    video = pairs * (VIDEO_TOKENS + _TIME + 2)
    return words + _MARKS + len(row.get("images", [])) * (image + 2) + len(row.get("videos", [])) * video
