"""The vision cache: pooled tokens of the memory view, computed once with the frozen encoder and
read memory-mapped.

`mme-vla cache model=… data=…` builds it; under `torchrun` every process takes its share of the
episodes. One folder holds the tokens of one dataset under one encoder and one way of pooling; what
it was made of is in its `fingerprint.json`, and a folder whose fingerprint is not the expected one
is refused, never read and never replaced unless asked to.
"""

import re
from collections import OrderedDict
from dataclasses import asdict
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

from mme_vla.data.episodes import EpisodeSource
from mme_vla.embodiment import ROBOMME_JOINT
from mme_vla.errors import UserError, brief, listed, require
from mme_vla.memory.history import CachedHistory, FrameScores, StorageSpec
from mme_vla.utils import Sums, decoding, files_to_hold, read_json, require_file, user_cache

FORMAT = 1  # of the files below
PREPROCESSING = "antialiased bilinear resize with padding to the encoder's size, [-1, 1]"
FINGERPRINT = "fingerprint.json"
COMMAND = "mme-vla cache model=<model> data=<data>"
DTYPES = {"bfloat16": np.uint16, "float32": np.float32}  # bfloat16 is stored as its bits


class CacheMissingError(UserError):
    """There is no cache, or not all of it yet: building (on) mends it."""


def default_cache_root() -> Path:
    """Where caches go unless told otherwise: `vision` in $MME_VLA_CACHE, else in
    ~/.cache/mme_vla.
    """
    return user_cache("vision")


def fingerprint(
    source: EpisodeSource, spec: StorageSpec, encoder: str, dtype: str = "bfloat16"
) -> dict[str, Any]:
    """Everything the tokens of a cache depend on.

    Args:
        source: the dataset.
        spec: what a memory stores of each frame.
        encoder: hash of the vision tower's weights (`policy.vision_fingerprint()`).
        dtype: `bfloat16` or `float32`.
    """
    require(dtype in DTYPES, f"A cache holds {' or '.join(DTYPES)} tokens, not {dtype!r}.")
    return {
        "format": FORMAT,
        "encoder": encoder,
        "preprocessing": PREPROCESSING,
        "view": source.columns[source.robot.memory_camera],
        "dtype": dtype,
        "storage": asdict(spec),
        "dataset": {
            "content": source.fingerprint,
            "episodes": len(source),
            "frames": int(source.lengths.sum()),
        },
    }


def cache_folder(root: Path | str | None, source: EpisodeSource, expected: dict[str, Any]) -> Path:
    """The folder of a cache below `root`, or below `default_cache_root()`: readable, and another
    one for another dataset, encoder, pooling or camera.
    """
    spec = StorageSpec(**expected["storage"])
    scorer = f"-{spec.scorer}" if spec.scorer else ""
    encoder = sha256(f"{expected['encoder']}{expected['dtype']}".encode()).hexdigest()[:8]
    # RoboMME's memory camera goes without saying, as in caches that were built before there were
    # others.
    view = ""
    if expected["view"] != ROBOMME_JOINT.cameras[0].key:
        view = re.sub(r"[^\w.-]", "_", f"-{expected['view']}")
    name = f"{spec.grid}x{spec.grid}-{spec.pooling}-every{spec.keep_every}{scorer}{view}-{encoder}"
    caches = Path(root) if root else default_cache_root()
    return caches / f"{source.name}-{source.fingerprint[:8]}" / name


def stored_frames(source: EpisodeSource, episode: int, spec: StorageSpec) -> np.ndarray:
    """Frames of an episode whose tokens are stored: those that `spec` keeps, as far as they were
    rendered.
    """
    stored = spec.stored_frames(int(source.lengths[episode]))
    return stored[source.rendered(episode)[stored]]


def token_file(folder: Path, episode: int) -> Path:
    """Tokens of an episode, [kept frames, patches, d]."""
    return folder / f"episode_{episode:06d}.npy"


def score_file(folder: Path, episode: int) -> Path:
    """Scores of an episode, where the memory needs them; written before the tokens, so that tokens
    imply scores.
    """
    return folder / f"episode_{episode:06d}.scores.npz"


def sum_file(folder: Path, episode: int) -> Path:
    """SHA-256 sums of an episode's files; written before the tokens, too. Caches of older versions
    have none.
    """
    return folder / f"episode_{episode:06d}.sha256"


class VisionCache:
    """A finished cache of one dataset: histories of its episodes, of which only the rows asked for
    are read.

    An episode's files are compared with their checksums when its history is first asked for, once a
    process.
    """

    max_open: int
    """Histories kept at hand: of all episodes, as far as the process may hold their files."""

    def __init__(
        self, folder: Path, source: EpisodeSource, expected: dict[str, Any], command: str = COMMAND
    ) -> None:
        """Open and check a cache.

        Args:
            folder: where it is (`cache_folder`).
            source: the dataset it belongs to.
            expected: the fingerprint it must have.
            command: what to tell the user to run, without `rebuild=true`.
        """
        check_fingerprint(folder, expected, command)
        self.folder = folder
        self.spec = StorageSpec(**expected["storage"])
        self._source = source
        self._dtype = DTYPES[expected["dtype"]]
        self._command = command
        missing = []
        for episode in range(len(source)):
            has_tokens = token_file(folder, episode).is_file()
            if not has_tokens or (self.spec.scorer and not score_file(folder, episode).is_file()):
                missing.append(episode)
        if missing:
            raise CacheMissingError(
                f"The vision cache {folder} is half-written: {len(missing)} of {len(source)}"
                f" episodes are missing. Finish it with: {command}"
            )
        widths = {self._tokens(episode).shape[-1] for episode in range(len(source))}
        require(
            len(widths) <= 1,
            f"{folder} mixes tokens of widths {sorted(widths)}. Rebuild it: {command} rebuild=true",
        )
        self.width = widths.pop()
        self.max_open = files_to_hold(len(source))
        self._histories: OrderedDict[int, CachedHistory] = OrderedDict()
        self._verified: set[int] = set()

    def history(self, episode: int) -> CachedHistory:
        """The stored tokens of a whole episode."""
        if episode not in self._histories:
            self.verify(episode)
            self._histories[episode] = CachedHistory(
                self.spec,
                self._tokens(episode),
                stored_frames(self._source, episode, self.spec),
                int(self._source.lengths[episode]),
                self._scores(episode),
                int(self._source.exec_starts[episode]),
            )
            while len(self._histories) > self.max_open:
                self._histories.popitem(last=False)
        self._histories.move_to_end(episode)
        return self._histories[episode]

    def verify(self, episode: int) -> None:
        """Compare an episode's files with the checksums that were written with them, the first time
        it is asked for.
        """
        if episode in self._verified:
            return
        sums = Sums(self.folder, sum_file(self.folder, episode).name, self._remedy)
        read = [token_file(self.folder, episode).name]
        if self.spec.scorer:
            read.append(score_file(self.folder, episode).name)
        unlisted = [name for name in read if name not in sums.table]
        require(
            not (sums.there and unlisted),
            f"{self.folder / sums.name} is damaged: it does not list {listed(unlisted)}."
            f" {self._remedy}",
        )
        sums.check(*sums.table)
        self._verified.add(episode)

    @property
    def _remedy(self) -> str:
        return f"Rebuild the cache: {self._command} rebuild=true"

    def _tokens(self, episode: int) -> np.ndarray:
        path = token_file(self.folder, episode)
        rows = len(stored_frames(self._source, episode, self.spec))
        with decoding(require_file(path), "tokens of a vision cache", self._remedy):
            tokens = np.lib.format.open_memmap(path, mode="r")
        require(
            tokens.ndim == 3
            and tokens.shape[:2] == (rows, self.spec.grid**2)
            and tokens.dtype == self._dtype,
            f"{path} holds {tokens.dtype} {list(tokens.shape)} where {np.dtype(self._dtype)}"
            f" [{rows}, {self.spec.grid**2}, d] is expected. {self._remedy}",
        )
        return tokens

    def _scores(self, episode: int) -> FrameScores | None:
        if not self.spec.scorer:
            return None
        path = score_file(self.folder, episode)
        with (
            decoding(require_file(path), "scores of a vision cache", self._remedy),
            np.load(path) as stored,
        ):
            frames, values = stored["frames"], stored["values"]
        length = int(self._source.lengths[episode])
        patches = self.spec.grid**2
        is_frames = frames.dtype == np.int64 and frames.ndim == 1
        require(
            is_frames
            and values.dtype == np.float32
            and values.shape == (len(frames), patches)
            and ((frames >= 0) & (frames < length)).all()
            and (np.diff(frames) > 0).all()
            and np.isfinite(values).all(),
            f"{path} holds {values.dtype} scores {list(values.shape)} of {frames.dtype} frames"
            f" {list(frames.shape)}, where finite float32 [n, {patches}] of ascending int64 [n]"
            f" frames below {length} are expected. {self._remedy}",
        )
        return FrameScores(frames, values)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_histories": OrderedDict()}  # a worker maps its own


def check_fingerprint(folder: Path, expected: dict[str, Any], command: str = COMMAND) -> None:
    """Make sure that `folder` was made of what is expected."""
    path = folder / FINGERPRINT
    if not path.is_file():
        require(
            not folder.is_dir() or not any(folder.iterdir()),
            f"{folder} has no {FINGERPRINT}: it is not a vision cache. Choose another"
            " data.cache.root.",
        )
        raise CacheMissingError(f"There is no vision cache at {folder}. Build it with: {command}")
    recorded = read_json(path, "what a vision cache was made of")
    differences = []
    for key, value in expected.items():
        there = recorded.get(key)
        if there != value:
            differences.append(f"{key} is {brief(there, 200)}, expected {value!r}")
    require(
        not differences,
        f"The vision cache {folder} is stale: {'; '.join(differences)}. Rebuild it with: {command}"
        " rebuild=true",
    )
