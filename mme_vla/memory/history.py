"""`StorageSpec`, `FrameScorer`, and `History`: one episode's stored vision tokens.

A history grows in an episode (`OnlineHistory`, `LazyHistory`) or is read from the cache
(`CachedHistory`). A memory reads all of them through the same members.
"""

import ast
import hashlib
import inspect
import math
import textwrap
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields

import numpy as np
import torch
from torch import Tensor

from mme_vla.errors import UserError, brief, check_choice, check_sizes, require
from mme_vla.types import FrameBatch, send


def on_interval[T: (int, np.ndarray)](frames: T, every: int) -> T:
    """Which frames are kept of every so many: frame 0, and frames k·every − 1."""
    return (frames == 0) | ((frames + 1) % every == 0)


@dataclass(frozen=True)
class StorageSpec:
    """What is stored of each frame for a memory. It is data, so that a cache can be named after it.

    grid: side of the pooled token grid: a view's tokens are pooled to grid×grid before they are
        stored. It divides the backbone's (`build_memory`).
    pooling: `mean` (as released) or `max` (paper, section 4.2).
    keep_every: frame 0 and frames k·keep_every − 1 are kept; 1 keeps all. Others are never encoded.
        Options of memories call this interval `every` or `stride`, keys of a cache `every`.
    scorer: key of the frame scorer whose rows are stored beside the tokens (`FrameScorer.key`);
        empty for none.
    """

    grid: int
    pooling: str = "mean"
    keep_every: int = 1
    scorer: str = ""

    def __post_init__(self) -> None:
        check_sizes("memory", grid=self.grid, every=self.keep_every)
        check_choice("memory.pooling", self.pooling, ("mean", "max"))

    def stored_frames(self, length: int) -> np.ndarray:
        """Ascending indices of the stored frames among the first `length`."""
        frames = np.arange(length)
        return frames[on_interval(frames, self.keep_every)]


FORMER_KEYS: dict[str, str] = {}
"""Digest of a scorer's code → the format of its key in caches that were built before keys had a
digest.
"""


class FrameScorer:
    """Scores raw frames as they pass, for memories that choose by content. One instance per
    episode.

    Subclasses are dataclasses: their fields are the options.
    """

    @classmethod
    def digest(cls) -> str:
        """A hash of the code of the class and its bases, without comments, docstrings and helper
        functions.
        """
        classes = cls.__mro__[: cls.__mro__.index(FrameScorer)]
        code = []
        for scorer in classes:
            tree = ast.parse(textwrap.dedent(inspect.getsource(scorer)))
            for node in ast.walk(tree):
                if not isinstance(node, ast.FunctionDef | ast.ClassDef):
                    continue
                if ast.get_docstring(node) is not None:
                    node.body = node.body[1:] or [ast.Pass()]
            code.append(ast.unparse(tree))
        return hashlib.sha256("\n".join(code).encode()).hexdigest()[:8]

    @property
    def key(self) -> str:
        """The name of these scores in a cache: it follows from the class, its code and
        its options.
        """
        options = {f.name: getattr(self, f.name) for f in fields(self) if f.init}  # type: ignore[arg-type]
        digest = self.digest()
        if digest in FORMER_KEYS:
            return FORMER_KEYS[digest].format(**options)
        settings = [f"{name}{value}" for name, value in options.items()]
        return "-".join([type(self).__name__.lower(), *settings, digest])

    def frames_scored(self, length: int) -> np.ndarray:
        """Which of the first `length` frames the scorer needs, ascending; by default all.

        Frames that are neither scored nor stored are not rendered.
        """
        return np.arange(length)

    def __call__(self, frame_index: int, frame: np.ndarray) -> np.ndarray | None:
        """Take one RGB frame [H, W, 3] uint8 of the memory view; return a score per patch [grid²]
        or None.
        """
        raise NotImplementedError


@dataclass
class FrameScores:
    """Rows that a scorer returned: `frames` [m] ascending, `values` [m, patches] float32."""

    frames: np.ndarray
    values: np.ndarray

    @classmethod
    def empty(cls, patches: int) -> "FrameScores":
        return cls(np.zeros(0, np.int64), np.zeros((0, patches), np.float32))

    def until(self, step: int) -> "FrameScores":
        """Return only the rows of frames ≤ `step`."""
        count = int(np.searchsorted(self.frames, step, side="right"))
        return FrameScores(self.frames[:count], self.values[:count])


def score_frame(scorer: FrameScorer, frame: int, image: np.ndarray) -> np.ndarray | None:
    """What the scorer gives for a frame, RGB [H, W, 3] uint8, as float32.

    Raises:
        UserError: an image that it does not take; of a size that does not fit, with what would.
    """
    try:
        row = scorer(frame, image)
    except UserError as error:
        grid = getattr(scorer, "grid", 1)
        fitting = math.gcd(grid, *image.shape[:2])
        if fitting == grid:
            raise
        raise UserError(
            f"{error} Scale the images to sides that are multiples of {grid}, set"
            f" memory.grid={fitting}, or choose a memory that compares no images"
            " (memory=framesamp)."
        ) from None
    return None if row is None else np.array(row, np.float32)


def score_frames(
    scorer: FrameScorer | None, images: Mapping[int, np.ndarray], patches: int
) -> FrameScores:
    """The scores of an episode's frames, in order.

    Args:
        images: number of a frame → RGB [H, W, 3] uint8.
        patches: scores of a frame.
    """
    rows: dict[int, np.ndarray] = {}
    for frame in sorted(images):
        values = None if scorer is None else score_frame(scorer, frame, images[frame])
        if values is not None:
            rows[frame] = values
    if not rows:
        return FrameScores.empty(patches)
    return FrameScores(np.array(list(rows), np.int64), np.stack(list(rows.values())))


class History:
    """One episode's stored tokens. `exec_start` is the index of the first execution frame (0
    without a video).

    motion: proprioception and actions at frames [n], normalised: [n, w] float32, the first
        `state_width` numbers the robot's state. Set for memories that declare `uses_proprio`.
    """

    motion: Callable[[np.ndarray], Tensor] | None = None
    state_width: int = 0
    clock_starts: tuple[int, ...] = (0,)
    """Frames at which the frame index began at 0: the first one, and those of restarts."""

    def __init__(self, spec: StorageSpec, exec_start: int = 0) -> None:
        self.spec = spec
        self.exec_start = exec_start

    def __len__(self) -> int:
        """Number of frames observed, kept or not."""
        raise NotImplementedError

    @property
    def scores(self) -> FrameScores:
        raise NotImplementedError

    @property
    def stored_frames(self) -> np.ndarray:
        """The frames that have tokens, int64 [m], ascending."""
        raise NotImplementedError

    def newest_stored(self, frames: np.ndarray) -> np.ndarray:
        """For each of frames [n] the newest with tokens up to it, or the first."""
        stored = self.stored_frames
        return stored[np.maximum(np.searchsorted(stored, frames, side="right") - 1, 0)]

    def gather(self, indices: np.ndarray) -> Tensor:
        """Return tokens [n, d_vision] at `indices` [n, 2] of (frame, patch)."""
        raise NotImplementedError

    def restart_clock(self) -> None:
        """Count the current frame as 0 again; earlier ones keep their times."""
        self.clock_starts = (*self.clock_starts, max(len(self) - 1, 0))

    def times(self, frames: np.ndarray) -> np.ndarray:
        """The frame index that frames [n] have: their number, or counted from the last restart
        before them.
        """
        starts = np.array(self.clock_starts)
        restart = np.searchsorted(starts, frames, side="right") - 1
        times: np.ndarray = frames - starts[restart]
        return times

    def timed(self, indices: np.ndarray) -> np.ndarray:
        """`indices` [n, 2] of (frame, patch) as (time, patch)."""
        return np.stack([self.times(indices[:, 0]), indices[:, 1]], axis=1)

    def stored(self, indices: np.ndarray) -> Tensor:
        """`gather` without the prompt's conditioning: what `select` may read, in training as in
        episodes.
        """
        return self.gather(indices)

    def motion_rows(self, frames: np.ndarray) -> Tensor:
        """Proprioception and actions at frames [n]: [n, w] float32, normalised.

        Raises:
            UserError: the history has none.
        """
        if self.motion is None:
            raise UserError(
                "This memory reads the robot's own states and actions, and this history has none of"
                " them: give states with the frames (`Episode.observe`)."
            )
        return self.motion(frames)

    def proprio(self, frames: np.ndarray) -> Tensor:
        """The robot's states at frames [n], normalised: [n, s] float32; what `select` may read, as
        `stored`.
        """
        return self.motion_rows(frames)[:, : self.state_width]

    def _rows_of(self, indices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rows among the stored frames, and patches, of `indices` [n, 2] of (frame, patch).

        Raises:
            UserError: these are no such indices, or one of the frames is not stored.
        """
        indices = np.asarray(indices)
        patches = self.spec.grid**2
        is_pairs = indices.ndim == 2 and indices.shape[1] == 2 and indices.dtype.kind in "iu"
        if not is_pairs or ((indices[:, 1] < 0) | (indices[:, 1] >= patches)).any():
            raise UserError(
                "A history is read by whole numbers [n, 2], each row a frame and a patch from 0 to"
                f" {patches - 1}; got {indices.dtype} {list(indices.shape)}:"
                f" {brief(indices.tolist())}."
            )
        frames = indices[:, 0]
        stored = self.stored_frames
        rows = np.searchsorted(stored, frames)
        # Frames later than all stored ones have a row behind the last, whose frame is −1.
        is_missing = np.append(stored, -1)[rows] != frames
        if is_missing.any():
            missing = np.unique(frames[is_missing])
            raise UserError(
                f"The history holds no tokens of frames {missing[:5].tolist()}: it has seen"
                f" {len(self)} frames and keeps frame 0 and every {self.spec.keep_every}th, as far"
                " as they were rendered. The memory selects frames that its StorageSpec does not"
                " keep, or that its `frames_read` does not name, which are not rendered."
            )
        return rows, indices[:, 1].astype(np.int64)


MISSING_SCORES = (
    "The memory chooses by scores of frames ({}), and this history gets none: give"
    " memory.make_scorer(), or of a CachedHistory its scores, score_frames(…)."
)


class CachedHistory(History):
    """Tokens read from disk: only the rows that a selection names are read.

    tokens: array-like [kept, patches, d_vision] (usually a memory map); an array holds bfloat16 as
        its uint16 bits.
    scores: required where the spec names a scorer (`score_frames`).
    """

    def __init__(
        self,
        spec: StorageSpec,
        tokens: np.ndarray,
        stored_frames: np.ndarray,
        length: int,
        scores: FrameScores | None = None,
        exec_start: int = 0,
    ) -> None:
        super().__init__(spec, exec_start)
        require(scores is not None or not spec.scorer, MISSING_SCORES.format(spec.scorer))
        self._tokens = tokens
        self._stored_frames = stored_frames
        self._length = length
        self._scores = FrameScores.empty(spec.grid**2) if scores is None else scores

    def __len__(self) -> int:
        return self._length

    @property
    def scores(self) -> FrameScores:
        return self._scores

    @property
    def stored_frames(self) -> np.ndarray:
        return self._stored_frames

    def gather(self, indices: np.ndarray) -> Tensor:
        tokens = torch.as_tensor(self._tokens[self._rows_of(indices)])
        if tokens.dtype == torch.uint16:
            return tokens.view(torch.bfloat16)
        return tokens


class OnlineHistory(History):
    """Tokens appended as the episode goes, in storage that doubles when it is full.

    Tokens stay on the device that encoded them; scores are numbers on the CPU.
    """

    def __init__(
        self, spec: StorageSpec, scorer: FrameScorer | None = None, exec_start: int = 0
    ) -> None:
        super().__init__(spec, exec_start)
        require(scorer is not None or not spec.scorer, MISSING_SCORES.format(spec.scorer))
        self._scorer = scorer
        self._length = 0
        self._stored_frames: list[int] = []
        self._tokens: Tensor | None = None
        self._scored_frames: list[int] = []
        self._score_rows: list[np.ndarray] = []

    def __len__(self) -> int:
        return self._length

    @property
    def scores(self) -> FrameScores:
        empty = np.zeros((0, self.spec.grid**2), np.float32)
        values = np.vstack([empty, *self._score_rows])
        return FrameScores(np.array(self._scored_frames, np.int64), values)

    @property
    def stored_frames(self) -> np.ndarray:
        return np.asarray(self._stored_frames, np.int64)

    def to_encode(self, count: int, rendered: np.ndarray | None = None) -> np.ndarray:
        """Of the next `count` frames, which (offsets from 0) `take` encodes.

        Args:
            rendered: offsets of those that have an image; by default all.
        """
        stored = self.spec.stored_frames(self._length + count)
        offsets = stored[stored >= self._length] - self._length
        if rendered is None:
            return offsets
        return np.intersect1d(offsets, rendered)

    def take(self, frames: FrameBatch, encode: Callable[[np.ndarray], Tensor]) -> None:
        """Add frames in order.

        Args:
            encode: images [n, H, W, 3] uint8 → tokens [n, patches, d_vision]; called once, for the
                frames of `to_encode`.
        """
        offsets = self.to_encode(frames.length, frames.index)
        tokens = encode(frames.select(offsets))
        patches = self.spec.grid**2
        if len(tokens) != len(offsets) or (len(tokens) and tokens.shape[1] != patches):
            raise ValueError(
                f"encode() returned tokens {list(tokens.shape)}, expected [{len(offsets)},"
                f" {patches}, d]: see StorageSpec.grid."
            )
        self._score(frames)
        if len(tokens):
            start = len(self._stored_frames)
            stop = start + len(tokens)
            capacity = 0 if self._tokens is None else len(self._tokens)
            if stop > capacity:
                larger = tokens.new_empty((max(stop, 2 * capacity, 16), *tokens.shape[1:]))
                if self._tokens is not None:
                    larger[:start] = self._tokens[:start]
                self._tokens = larger
            assert self._tokens is not None
            self._tokens[start:stop] = tokens
            self._stored_frames.extend((offsets + self._length).tolist())
        self._length += frames.length

    def _score(self, frames: FrameBatch) -> None:
        """Score the next frames that have an image."""
        if self._scorer is None:
            return
        for frame, image in zip((frames.index + self._length).tolist(), frames.images, strict=True):
            values = score_frame(self._scorer, frame, image)
            if values is not None:
                self._scored_frames.append(frame)
                self._score_rows.append(values)

    def gather(self, indices: np.ndarray) -> Tensor:
        if self._tokens is None:
            raise UserError("The history is empty: observe at least one frame before acting.")
        rows, patches = map(torch.from_numpy, self._rows_of(indices))
        device = self._tokens.device
        return self._tokens[send(rows, device), send(patches, device)]


class DerivedHistory(History):
    """A history of the same frames as its `source`. A subclass changes their tokens."""

    def __init__(self, source: History) -> None:
        super().__init__(source.spec, source.exec_start)
        self._source = source
        self.motion = source.motion
        self.state_width = source.state_width
        self.clock_starts = source.clock_starts

    def __len__(self) -> int:
        return len(self._source)

    @property
    def scores(self) -> FrameScores:
        return self._source.scores

    @property
    def stored_frames(self) -> np.ndarray:
        return self._source.stored_frames


class TokensReadError(UserError):
    """A memory reads vision tokens to choose, and there are none."""


class TokenlessHistory(DerivedHistory):
    """A history without vision tokens, for memories that choose without them."""

    def gather(self, indices: np.ndarray) -> Tensor:
        raise TokensReadError(
            "This memory reads vision tokens to choose its frames, and a memory alone has none. A"
            " trained policy has them: `mme-vla inspect checkpoint=… dataset=… episode=… step=…`"
            " draws what it chooses, and `mme-vla analyse writing --checkpoint FOLDER` scores what"
            " it keeps."
        )


class PromptConditionedHistory(DerivedHistory):
    """A history whose tokens are changed as they are gathered, by `with_prompt`
    (`MMEModel.prompt_condition`, of a batch of one).
    """

    def __init__(self, source: History, with_prompt: Callable[[Tensor], Tensor]) -> None:
        super().__init__(source)
        self.with_prompt = with_prompt

    def gather(self, indices: np.ndarray) -> Tensor:
        return self.with_prompt(self._source.gather(indices)[None])[0]

    def stored(self, indices: np.ndarray) -> Tensor:
        return self._source.stored(indices)


class LazyHistory(OnlineHistory):
    """Frames are kept as images in the CPU's memory until they are read. Their tokens stay on the
    device that encoded them.

    A recurrent memory reads one frame in sixteen: the vision tower then runs sixteen times less. An
    image of 256×256 takes 192 KiB, less than its 8×8 tokens at full width would on the GPU.

    Args:
        encode: frames [n, H, W, 3] uint8 → tokens [n, patches, d_vision].
    """

    def __init__(
        self,
        spec: StorageSpec,
        encode: Callable[[np.ndarray], Tensor],
        scorer: FrameScorer | None = None,
        exec_start: int = 0,
    ) -> None:
        super().__init__(spec, scorer, exec_start)
        self._encode = encode
        self._waiting: dict[int, np.ndarray] = {}
        self._encoded: dict[int, Tensor] = {}

    def take(self, frames: FrameBatch, encode: Callable[[np.ndarray], Tensor]) -> None:
        """Add frames in order, without encoding any."""
        offsets = self.to_encode(frames.length, frames.index)
        images = frames.select(offsets)
        self._score(frames)
        for frame, image in zip((offsets + self._length).tolist(), images, strict=True):
            # A copy: a view would keep the whole message alive that a frame came in.
            self._waiting[frame] = image.copy()
            self._stored_frames.append(frame)
        self._length += frames.length

    def gather(self, indices: np.ndarray) -> Tensor:
        """Return tokens [n, d_vision] at `indices` [n, 2] of (frame, patch), encoding the frames
        that wait.
        """
        stored_rows, patch = self._rows_of(indices)
        unique_rows, rows = np.unique(stored_rows, return_inverse=True)
        frames = self.stored_frames[unique_rows].tolist()
        waiting = [frame for frame in frames if frame in self._waiting]
        if waiting:
            tokens = self._encode(np.stack([self._waiting[frame] for frame in waiting]))
            for frame, row in zip(waiting, tokens, strict=True):
                self._encoded[frame] = row
                del self._waiting[frame]
        encoded = torch.stack([self._encoded[frame] for frame in frames])
        device = encoded.device
        return encoded[send(torch.from_numpy(rows), device), send(torch.from_numpy(patch), device)]
