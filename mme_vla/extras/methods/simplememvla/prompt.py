"""The prompt of SimpleMemVLA, token for token: a user's turn with time-stamped video, and the
sub-task as its response.

Shapes: L tokens.
"""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files
from itertools import groupby
from pathlib import Path
from typing import Any, Self

import numpy as np

from mme_vla.errors import UserError, brief, missing_extra
from mme_vla.extras.methods.simplememvla.video import timestamp
from mme_vla.processing.tokenizer import HUB

BYTES, WORDS = "bytes", "words"
QWEN = f"{HUB}Qwen/Qwen3.5-4B/tokenizer.json"
_WORDS_SIZE = 1000
_LARGEST_FILE = 64 * 2**20  # bytes; Qwen's has 20 MiB
SPECIAL = (
    "<|endoftext|>",
    "<|im_start|>",
    "<|im_end|>",
    "<|vision_start|>",
    "<|vision_end|>",
    "<|image_pad|>",
    "<|video_pad|>",
    "<think>",
    "</think>",
)
TEXT, IMAGE, VIDEO, MEMORY = range(4)
"""Kinds of tokens: what their embeddings are replaced by. Memory tokens count
positions like text.
"""
_LABELS = {
    "front": "Front camera",
    "base": "Front camera",
    "wrist": "Wrist camera",
    "hand": "Wrist camera",
}


class WordTokenizer:
    """A tokenizer of the `tokenizers` package with Qwen's special tokens.

    Attributes:
        spec: where it came from, in the words `load` takes.
        fingerprint: hash of the file.
    """

    def __init__(self, content: str, spec: str) -> None:
        try:
            from tokenizers import Tokenizer
        except ImportError:
            raise missing_extra("SimpleMemVLA", "vlm") from None
        try:
            self._tokenizer: Tokenizer = Tokenizer.from_str(content)
        except Exception as error:  # the package raises bare exceptions
            reason = brief(str(error), 200, quote=False)
            raise UserError(
                f"processor.tokenizer={brief(spec, 300)} is no tokenizer.json: {reason}"
            ) from None
        self.content = content
        self.spec = spec
        self.fingerprint = hashlib.sha256(content.encode()).hexdigest()[:16]
        if lacking := [token for token in SPECIAL if self._tokenizer.token_to_id(token) is None]:
            raise UserError(
                f"The tokenizer {brief(spec, 300)} lacks {', '.join(lacking)}, which SimpleMemVLA's"
                " prompts need. Give Qwen3.5's tokenizer.json (processor.tokenizer)."
            )

    @classmethod
    def load(cls, spec: str | Path) -> Self:
        """Load a tokenizer.

        Args:
            spec: `bytes` (one token a byte, no file), `words` (a small vocabulary of RoboMME's
                language, no file), the path of a tokenizer.json or of a folder with one, or
                `hf://owner/repository/tokenizer.json`.
        """
        spec = str(spec)
        if spec in (BYTES, WORDS):
            return cls(_small_tokenizer(spec), spec)
        path = _download(spec) if spec.startswith(HUB) else Path(spec).expanduser()
        if path.is_dir():
            path = path / "tokenizer.json"
        if not path.is_file():
            raise UserError(
                f"No tokenizer at {brief(spec, 300)}. Set processor.tokenizer to the path of"
                f" Qwen3.5's tokenizer.json, to {QWEN}, or to {BYTES!r} or {WORDS!r} to try things"
                " out."
            )
        if path.stat().st_size > _LARGEST_FILE:
            raise UserError(
                f"{path} has {path.stat().st_size:,} bytes; a tokenizer has at most"
                f" {_LARGEST_FILE:,}."
            )
        try:
            return cls(path.read_text(encoding="utf-8"), spec)
        except UnicodeDecodeError:
            raise UserError(
                f"{path} is damaged or no tokenizer.json: it is not UTF-8 text."
            ) from None

    @property
    def vocab_size(self) -> int:
        """One more than the largest id."""
        return max(self._tokenizer.get_vocab(with_added_tokens=True).values()) + 1

    def encode(self, text: str) -> list[int]:
        ids: list[int] = self._tokenizer.encode(text, add_special_tokens=False).ids
        return ids

    def decode(self, ids: Sequence[int]) -> str:
        """The text of ids, without special tokens."""
        return str(self._tokenizer.decode(list(ids), skip_special_tokens=True))

    def id(self, token: str) -> int:
        """The id of a special token."""
        return int(self._tokenizer.token_to_id(token))


@lru_cache(maxsize=2)
def _small_tokenizer(spec: str) -> str:
    """A tokenizer.json without any file: of one token a byte and two line breaks, or trained on
    RoboMME's language.
    """
    try:
        from tokenizers import AddedToken, Tokenizer, decoders, models, pre_tokenizers, trainers
    except ImportError:
        raise missing_extra("SimpleMemVLA", "vlm") from None
    alphabet = pre_tokenizers.ByteLevel.alphabet()
    tokenizer: Any
    if spec == WORDS:
        tokenizer = Tokenizer(models.BPE())
        tokenizer.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False)
        corpus = files("mme_vla").joinpath("assets/tokenizer_corpus.txt").read_text("utf-8")
        request = instruction("", Robot("Panda single-arm robot", 20, 30), 1, 1)
        texts = [*corpus.splitlines(), *[request] * 200]
        texts += [timestamp(place / 4) for place in range(400)]
        texts += ["Front camera:\n\n"] * 200
        trainer = trainers.BpeTrainer(
            vocab_size=_WORDS_SIZE, initial_alphabet=alphabet, show_progress=False
        )
        tokenizer.train_from_iterator(texts, trainer)
    else:
        newline = "\u010a"  # how byte-level tokenizers spell a line break
        vocabulary = {letter: i for i, letter in enumerate([*sorted(alphabet), newline * 2])}
        tokenizer = Tokenizer(models.BPE(vocab=vocabulary, merges=[(newline, newline)]))
        tokenizer.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False, use_regex=False)
    tokenizer.decoder = decoders.ByteLevel()
    tokenizer.add_special_tokens([AddedToken(token, normalized=False) for token in SPECIAL])
    content: str = tokenizer.to_str()
    return content


def _download(spec: str) -> Path:
    from huggingface_hub import hf_hub_download
    from huggingface_hub.errors import HfHubHTTPError, LocalEntryNotFoundError

    owner, _, remainder = spec.removeprefix(HUB).partition("/")
    repository, _, file = remainder.partition("/")
    try:
        return Path(hf_hub_download(f"{owner}/{repository}", file))
    except (HfHubHTTPError, LocalEntryNotFoundError, OSError, ValueError) as error:
        reason = str(error).strip().splitlines()
        raise UserError(
            f"The tokenizer {brief(spec, 300)} could not be fetched"
            f" ({reason[0] if reason else 'no reply'}). Connect once so that it is kept, or set"
            " processor.tokenizer to the path of a tokenizer.json."
        ) from None


@dataclass(frozen=True)
class Robot:
    """What a prompt says of the robot. hz: rate of control. horizon: actions of a chunk."""

    words: str
    hz: float
    horizon: int


@dataclass(frozen=True)
class CameraTokens:
    """The tokens of one camera in a prompt.

    grid: rows and columns of merged tokens of an image or temporal patch.
    times: of each temporal patch in seconds; None for one image.
    memory: memory tokens before the first patch.
    """

    name: str
    grid: tuple[int, int]
    times: Sequence[float] | None = None
    memory: int = 0

    @property
    def expanded(self) -> str:
        """Its part of the prompt, a placeholder for each vision token."""
        label = _LABELS.get(self.name, f"{self.name.replace('_', ' ').capitalize()} camera")
        count = self.grid[0] * self.grid[1]
        if self.times is None:
            inside = "<|image_pad|>" * count
        else:
            patch = f"<|vision_start|>{'<|video_pad|>' * count}<|vision_end|>"
            inside = "<|video_pad|>" * self.memory
            for time in self.times:
                inside += timestamp(time) + patch
        return f"{label}:<|vision_start|>{inside}<|vision_end|>"


def instruction(goal: str, robot: Robot, videos: int, images: int) -> str:
    """The request of a prompt, for a task in words, and so many cameras with and without a past."""
    if videos == 1 and not images:
        history = "the recent history video (frames tagged with timestamps)"
    else:
        sources = "one camera" if videos == 1 else f"{videos} cameras"
        history = (
            f"the recent history video from {sources} (each frame is tagged with its timestamp in"
            " seconds)"
        )
    current = ""
    if images:
        others = "one more camera" if images == 1 else f"{images} more cameras"
        current = f", plus the current image from {others}"
    task = goal.strip().replace("_", " ").rstrip(". ")
    return (
        f"The robot is a {robot.words}. The control frequency is {robot.hz:g} Hz. The next"
        f" {robot.horizon} control actions are predicted from the current sub-task. You are given"
        f" {history}{current}. The overall task is: {task}. Identify the current sub-task."
    )


def clean_response(subtask: str) -> str:
    """A sub-task as it is learned."""
    return subtask.strip().replace("_", " ")


@dataclass(frozen=True)
class Tokens:
    """A prompt, and the response where there is one.

    ids: [L] int64.
    kinds: [L] int8, `TEXT`, `IMAGE`, `VIDEO` or `MEMORY`.
    positions: [3, L] int64, time, row, column.
    prompt: tokens before the response.
    prefix: tokens up to the last one of the temporal patch before the last of the first video; 0
        where a prompt does not begin with two patches.
    """

    ids: np.ndarray
    kinds: np.ndarray
    positions: np.ndarray
    prompt: int
    prefix: int


def encode(
    tokenizer: WordTokenizer,
    cameras: Sequence[CameraTokens],
    request: str,
    response: str | None = None,
) -> Tokens:
    """A prompt as tokens, and behind it the response that is learned.

    The prompt is encoded by itself, so it is the same in training and where a response is
    generated. With the published tokenizer this makes no difference, since it separates line breaks
    from words.

    Args:
        cameras: in the order in which they are shown.
        request: of `instruction`.
        response: of `clean_response`.
    """
    views = "".join(camera.expanded for camera in cameras)
    prompt = tokenizer.encode(
        f"<|im_start|>user\n{views}{request}<|im_end|>\n<|im_start|>assistant\n<think>\n\n</think>\n\n"
    )
    learned = [] if response is None else tokenizer.encode(f"{response}<|im_end|>\n")
    ids = np.array([*prompt, *learned], np.int64)
    kinds = np.zeros(len(ids), np.int8)
    kinds[ids == tokenizer.id("<|image_pad|>")] = IMAGE
    video = np.flatnonzero(ids == tokenizer.id("<|video_pad|>"))
    kinds[video] = VIDEO
    used = 0
    for camera in cameras:
        if camera.times is not None:
            kinds[video[used : used + camera.memory]] = MEMORY
            used += camera.memory + len(camera.times) * camera.grid[0] * camera.grid[1]
    prefix = 0
    first = cameras[0]
    if first.times is not None and len(first.times) > 1:
        n_before_last = (len(first.times) - 1) * first.grid[0] * first.grid[1]
        prefix = int(video[first.memory + n_before_last - 1]) + 1
    return Tokens(ids, kinds, rope_positions(kinds, cameras), len(prompt), prefix)


def rope_positions(kinds: np.ndarray, cameras: Sequence[CameraTokens]) -> np.ndarray:
    """Rotary positions [3, L] (time, row, column): text counts up, an image or temporal patch takes
    one place in time.

    What follows an image begins after its longer side.
    """
    images = iter([camera.grid for camera in cameras if camera.times is None])
    patches = iter([camera.grid for camera in cameras for _ in camera.times or ()])
    groups, start = [], 0
    for kind, members in groupby(np.where(kinds == MEMORY, TEXT, kinds).tolist()):
        count = len(list(members))
        if kind == TEXT:
            groups.append(np.broadcast_to(start + np.arange(count), (3, count)))
            start += count
        else:
            rows, columns = next(images if kind == IMAGE else patches)
            places = np.indices((1, rows, columns)).reshape(3, -1)
            groups.append(start + places)
            start += max(rows, columns)
    return np.concatenate(groups, 1)
