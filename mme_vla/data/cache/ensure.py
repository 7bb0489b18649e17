"""A cache that is there: opened, or built first where that is a matter of minutes."""

import logging
from pathlib import Path

from mme_vla.data.cache.building import Encode, build_cache
from mme_vla.data.cache.store import (
    COMMAND,
    CacheMissingError,
    VisionCache,
    cache_folder,
    default_cache_root,
    fingerprint,
)
from mme_vla.data.episodes import EpisodeSource
from mme_vla.errors import UserError
from mme_vla.memory.base import Memory

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
    """Open the cache of a dataset for this memory; build it first, or finish it, where the dataset is small.

    Args:
        source, memory: whose tokens. encode: `policy.encode_frames`. encoder: `policy.vision_fingerprint()`.
        root: folder of all caches; None for `default_cache_root()`.
        dtype: of the stored tokens. batch_size: frames encoded at once.
        max_build_frames: datasets of more frames are not built here: that is worth a command of its own.
        command: that command, for messages.

    Raises:
        UserError: the dataset is larger than that and its cache is not there, or the cache is stale or damaged.
    """
    coded = source.lossy.get(source.robot.memory_camera)
    if coded is not None and memory.make_scorer() is not None:
        log.warning(
            "%s: its films are coded as %s, and this memory scores patches by how little they change: what compression "
            "moves passes for motion. Convert the recordings with lossless films, or choose another memory.",
            source.name, coded,
        )  # fmt: skip
    expected = fingerprint(source, memory.storage, encoder, dtype)
    folder = cache_folder(default_cache_root() if root is None else Path(root), source, expected)
    try:
        return VisionCache(folder, source, expected, command)
    except CacheMissingError as error:
        frames = int(source.lengths.sum())
        if frames > max_build_frames:
            raise UserError(
                f"{error} (It is not built here because {source.name} has {frames} frames, more than "
                f"data.cache.max_build_frames={max_build_frames}; add dry_run=true to see size and time first.)"
            ) from None
    # All of it here, also under torchrun, where training has its first process prepare the data for the others.
    build_cache(source, memory, encode, folder, expected, batch_size=batch_size, shard=(0, 1))
    return VisionCache(folder, source, expected, command)
