"""Building a vision cache: episode by episode, each written whole or not at all."""

import logging
import os
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from io import BytesIO
from itertools import groupby
from pathlib import Path
from typing import IO, Any

import numpy as np
import torch
from torch import Tensor

from mme_vla.data.cache import (
    COMMAND,
    DTYPES,
    FINGERPRINT,
    CacheMissingError,
    VisionCache,
    cache_folder,
    check_fingerprint,
    fingerprint,
    score_file,
    stored_frames,
    sum_file,
    token_file,
)
from mme_vla.data.console import progress
from mme_vla.data.episodes import EpisodeSource
from mme_vla.errors import UserError, require
from mme_vla.memory.base import Memory
from mme_vla.memory.history import score_frame
from mme_vla.utils import sum_line, write_atomically, write_json, write_text

PAGE = 4096  # bytes
CHUNKS_AHEAD = 2

Encode = Callable[[np.ndarray], Tensor]  # frames [n, H, W, 3] uint8 → pooled tokens [n, grid², d]


def process_rank() -> tuple[int, int]:
    """(rank, world size) as torchrun gives them, (0, 1) without it."""
    return int(os.environ.get("RANK", "0")), int(os.environ.get("WORLD_SIZE", "1"))


def clear_cache(folder: Path) -> None:
    """Remove the files of a cache, and nothing else."""
    if not folder.exists():
        return
    require(
        (folder / FINGERPRINT).is_file() or not any(folder.iterdir()),
        f"{folder} has no {FINGERPRINT}: it is not a vision cache, so nothing is removed.",
    )
    for pattern in ("episode_*.np[yz]", "episode_*.sha256", "*.partial", FINGERPRINT):
        for path in folder.glob(pattern):
            path.unlink(missing_ok=True)


def build_cache(
    source: EpisodeSource,
    memory: Memory,
    encode: Encode,
    folder: Path,
    expected: dict[str, Any],
    *,
    batch_size: int = 32,
    shard: tuple[int, int] | None = None,
) -> int:
    """Encode the episodes that are still missing; return how many were written.

    Stopped at any moment, it continues with the next call. Processes share the work: of the
    episodes, each takes those whose number is its rank modulo the world size.
    """
    rank, world = process_rank() if shard is None else shard
    folder.mkdir(parents=True, exist_ok=True)
    if not (folder / FINGERPRINT).is_file():
        if any(not path.name.endswith(".partial") for path in folder.iterdir()):
            check_fingerprint(folder, expected)
        write_json(folder / FINGERPRINT, expected, indent=1)
    check_fingerprint(folder, expected)
    share = list(range(rank, len(source), world))
    missing = [episode for episode in share if not token_file(folder, episode).is_file()]
    for episode in missing:
        require(
            len(stored_frames(source, episode, memory.storage)),
            f"{source.name}, episode {episode}: none of the frames that the memory stores was"
            " rendered.",
        )
    total = int(source.lengths[share].sum())
    left = int(source.lengths[missing].sum())
    with (
        progress(f"vision cache {source.name}", total, total - left, "frames") as advance,
        # Images are decoded in a thread while the ones before them are encoded.
        closing(ahead(_chunks(source, missing, memory, batch_size), CHUNKS_AHEAD)) as chunks,
    ):
        for episode, parts in groupby(chunks, lambda chunk: chunk.episode):
            _build_episode(episode, parts, memory, encode, folder, expected["dtype"], advance)
    return len(missing)


def estimate(
    source: EpisodeSource,
    memory: Memory,
    encode: Encode,
    dtype: str = "bfloat16",
    batch_size: int = 32,
) -> tuple[int, int, float]:
    """Measure a few batches of the first episode and extrapolate to the dataset.

    Returns:
        The frames to encode, their bytes on disk, and the seconds that it takes one process.
    """
    n_stored = 0
    for episode in range(len(source)):
        n_stored += len(stored_frames(source, episode, memory.storage))
    chunk = next(_chunks(source, [0], memory, batch_size))
    encode(chunk.stored_images[:1])  # the first call pays for warming up
    started = time.perf_counter()
    n_frames = 0
    bytes_per_frame = 0
    for chunk in _chunks(source, [0], memory, batch_size):
        tokens = encode(chunk.stored_images)
        bytes_per_frame = tokens[0].numel() * np.dtype(DTYPES[dtype]).itemsize
        n_frames += chunk.length
        if time.perf_counter() - started > 5:
            break
    seconds = (time.perf_counter() - started) / n_frames * int(source.lengths.sum())
    return n_stored, n_stored * bytes_per_frame, seconds


@dataclass(frozen=True)
class _Chunk:
    """A stretch of an episode: how many frames it spans, the images to encode, and the scores that
    came up.
    """

    episode: int
    length: int
    stored_images: np.ndarray
    score_frames: list[int]
    score_values: list[np.ndarray]


def _chunks(
    source: EpisodeSource, episodes: Sequence[int], memory: Memory, batch_size: int
) -> Iterator[_Chunk]:
    """The chunks of episodes, one after the other."""
    spec = memory.storage
    span = batch_size * spec.keep_every  # so that about `batch_size` frames of a chunk are kept
    for episode in episodes:
        length = int(source.lengths[episode])
        stored = stored_frames(source, episode, spec)
        scorer = memory.make_scorer()
        scored = np.zeros(0, np.int64)
        if scorer is not None:
            scored = scorer.frames_scored(length)
        for start in range(0, length, span):
            stop = min(start + span, length)
            in_chunk = stored[(stored >= start) & (stored < stop)]
            required = np.union1d(in_chunk, scored[(scored >= start) & (scored < stop)])
            if not len(required):
                continue
            images = source.frames(episode, required)
            stored_images = images[np.isin(required, in_chunk)]
            chunk = _Chunk(episode, stop - start, stored_images, [], [])
            if scorer is not None:
                for frame, image in zip(required.tolist(), images, strict=True):
                    try:
                        row = score_frame(scorer, frame, image)
                    except UserError as error:
                        camera = source.robot.memory_camera
                        column = source.columns[camera]
                        raise UserError(
                            f"{source.root}, {column} (the camera {camera!r}): {error}"
                        ) from None
                    if row is not None:
                        chunk.score_frames.append(frame)
                        chunk.score_values.append(row)
            yield chunk


def _build_episode(
    episode: int,
    chunks: Iterable[_Chunk],
    memory: Memory,
    encode: Encode,
    folder: Path,
    dtype: str,
    advance: Callable[[int], None],
) -> None:
    patches = memory.storage.grid**2
    rows: list[np.ndarray] = []
    frames: list[int] = []
    values: list[np.ndarray] = []
    for chunk in chunks:
        frames += chunk.score_frames
        values += chunk.score_values
        if len(chunk.stored_images):
            tokens = encode(chunk.stored_images)
            if tokens.shape[:2] != (len(chunk.stored_images), patches):
                raise ValueError(
                    f"encode() gave {list(tokens.shape)} for {len(chunk.stored_images)} frames"
                )
            tokens = tokens.detach()
            if dtype == "bfloat16":  # which numpy does not know
                stored = tokens.to(torch.bfloat16).view(torch.uint16)
            else:
                stored = tokens.float()
            rows.append(stored.cpu().numpy())
        advance(chunk.length)
    sums = ""
    if memory.storage.scorer:
        stacked = np.stack(values) if values else np.zeros((0, patches), np.float32)
        path = score_file(folder, episode)
        with write_atomically(path) as draft:
            with draft.open("wb") as file:
                np.savez(file, frames=np.asarray(frames, np.int64), values=stacked)
                _flush(file)
            sums += sum_line(draft, path.name)
    path = token_file(folder, episode)
    with write_atomically(path) as draft:
        with draft.open("wb") as file:
            save_aligned(file, np.concatenate(rows))
            _flush(file)
        sums += sum_line(draft, path.name)
        # Tokens come last: where they are, all else is.
        write_text(sum_file(folder, episode), sums)


def _flush(file: IO[bytes]) -> None:
    """Put what was written on the disk."""
    file.flush()
    os.fsync(file.fileno())


def save_aligned(file: IO[bytes], array: np.ndarray) -> None:
    """Write an array as .npy whose numbers begin at a page: a row of one page is then read as one,
    not as two.
    """
    buffer = BytesIO()
    np.lib.format.write_array_header_1_0(buffer, np.lib.format.header_data_from_array_1_0(array))
    magic = buffer.getvalue()[:8]
    described = buffer.getvalue()[10:].rstrip()
    described += b" " * (PAGE - 11 - len(described)) + b"\n"
    file.write(magic + len(described).to_bytes(2, "little") + described)
    file.write(np.ascontiguousarray(array).data)


log = logging.getLogger(__name__)


def ensure_cache(
    source: EpisodeSource,
    memory: Memory,
    encode: Encode,
    encoder: str,
    *,
    root: Path | str | None = None,
    dtype: str = "bfloat16",
    max_build_frames: int = 5000,
    batch_size: int = 32,
    command: str = COMMAND,
) -> VisionCache:
    """Open the cache of a dataset for this memory; build it first, or finish it, where the dataset
    is small.

    Args:
        source, memory: whose tokens.
        encode: `policy.encode_frames`.
        encoder: `policy.vision_fingerprint()`.
        root: folder of all caches; None for `default_cache_root()`.
        dtype: of the stored tokens.
        batch_size: frames encoded at once.
        max_build_frames: datasets of more frames are not built here: that is worth a command of its
            own.
        command: that command, for messages.
    """
    coded = source.lossy.get(source.robot.memory_camera)
    if coded is not None and memory.make_scorer() is not None:
        log.warning(
            "%s: its videos are coded as %s, and this memory scores patches by how little they"
            " change: what compression changes passes for motion. Convert the recordings with"
            " lossless videos, or choose another memory.",
            source.name,
            coded,
        )
    expected = fingerprint(source, memory.storage, encoder, dtype)
    folder = cache_folder(root, source, expected)
    try:
        return VisionCache(folder, source, expected, command)
    except CacheMissingError as error:
        frames = int(source.lengths.sum())
        if frames > max_build_frames:
            raise UserError(
                f"{error} (It is not built here because {source.name} has {frames} frames, more"
                f" than data.cache.max_build_frames={max_build_frames}; add dry_run=true to see"
                " size and time first.)"
            ) from None
    # All of it here, also under torchrun, where training has its first process prepare the data for
    # the others.
    build_cache(source, memory, encode, folder, expected, batch_size=batch_size, shard=(0, 1))
    return VisionCache(folder, source, expected, command)


_END = object()


def ahead[T](things: Iterable[T], count: int) -> Generator[T, None, None]:
    """The same things, made in a thread up to `count` ahead; what goes wrong there is raised where
    they are used.
    """
    iterator = iter(things)
    pool = ThreadPoolExecutor(1, "ahead")
    pending: deque[Future[Any]] = deque()
    try:
        for _ in range(count + 1):
            pending.append(pool.submit(next, iterator, _END))
        while (thing := pending.popleft().result()) is not _END:
            pending.append(pool.submit(next, iterator, _END))
            yield thing
    finally:
        pool.shutdown(cancel_futures=True)
