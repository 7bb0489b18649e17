"""The pictures of a dataset, compared with what its tables and descriptions say of them."""

import io
import logging
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from mme_vla.data.episode_table import Description
from mme_vla.data.lerobot_files import REMEDY
from mme_vla.data.video import video_file
from mme_vla.errors import UserError, brief, require
from mme_vla.utils import decoding

log = logging.getLogger(__name__)

HALF = 0.5  # frames: what is nearer to another frame than to its own is that other frame
# frames: up to here a video's header is believed; beyond, its pictures are looked at one by one
QUARTER = 0.25
CORRECT = "Correct the one that is wrong, or record or convert the dataset again."
_FILES_AT_ONCE = 4  # video files
_DEEP_MODES = ("I", "F")  # of Pillow: more than 8 bits a pixel


def first_wrong(wrong: np.ndarray) -> int | None:
    """The first place at which something is wrong, [n] bool; None where nothing is."""
    places = np.flatnonzero(wrong)
    return int(places[0]) if len(places) else None


def check_colour(dataset: Description, column: str) -> None:
    """Refuse depth by what meta/info.json says of a camera: a policy reads colours of 8 bits."""
    about = dataset.info.features[column].about_images
    depth = about.get("is_depth_map", about.get("video.is_depth_map", False))
    if depth is True:
        raise _depth(dataset.root, column, "is_depth_map is true in meta/info.json")
    kind = about.get("video.pix_fmt")
    if isinstance(kind, str) and _is_deep_grey(kind):
        raise _depth(dataset.root, column, f"video.pix_fmt is {brief(kind)} in meta/info.json")


def _is_deep_grey(pixel_format: str) -> bool:
    """Whether pixels are one number of more than 8 bits: gray10le, gray12le, gray16be, grayf32le,
    y210 is colour.
    """
    return pixel_format.startswith("gray") and pixel_format not in ("gray", "gray8", "gray8a")


def _depth(root: Path, column: str, reason: str) -> UserError:
    return UserError(
        f"{root}: {column} holds depth, or numbers of more than 8 bits ({reason}). As a colour"
        " image it would be cut off to 8 bits. Name a colour camera in its place"
        " (embodiment.cameras.<name>.key), or leave the camera out."
    )


def check_mode(root: Path, column: str, image: Any) -> None:
    """Refuse a picture of Pillow whose pixels do not fit into 8 bits.

    Raises:
        UserError: it holds 16-bit, 32-bit or floating-point pixels.
    """
    if str(image.mode).partition(";")[0] in _DEEP_MODES:
        kind = {"F": "floating-point", "I": "32-bit"}.get(image.mode, "16-bit")
        raise _depth(root, column, f"its pictures are {kind}, mode {image.mode!r} of Pillow")


def check_images(dataset: Description, column: str, table: Any) -> None:
    """Look at the header of every episode's first picture; the others are looked at when they are
    read.
    """
    from PIL import Image

    sizes = set()
    for start in dataset.starts.tolist():
        cell = table[start : start + 1][column][0].as_py()
        content = cell["bytes"] if isinstance(cell, Mapping) else None
        if content is None:
            raise UserError(
                f"{dataset.root}: {dataset.place(start)}, holds no picture in {column} (only a"
                " path). Pictures lie in the tables; LeRobot embeds them when an episode is saved."
            )
        place = f"{dataset.root}, {dataset.place(start)}, {column}"
        with decoding(place, "a picture", REMEDY), Image.open(io.BytesIO(content)) as image:
            check_mode(dataset.root, column, image)
            sizes.add(image.size)
    for width, height in sizes:
        _compare_size(dataset, column, width, height)


def _compare_size(dataset: Description, column: str, width: int, height: int) -> None:
    """Warn of pictures of another size than described: all are scaled for the network anyway."""
    shape = dataset.info.features[column].shape
    # colours last, or first
    sides = [shape[:2], shape[-2:]]
    if len(shape) != 3 or (height, width) not in sides:
        log.warning(
            "%s: meta/info.json gives %s the shape %s, but its pictures have %d rows and %d"
            " columns.",
            dataset.root,
            column,
            list(shape),
            height,
            width,
        )


def check_videos(dataset: Description, column: str) -> None:
    """Compare the spans of episodes in video files with each other, with their lengths, and with
    the files.
    """
    meta = f"{dataset.root}/meta/episodes"
    spans = dataset.videos[column]
    if spans.end is not None:
        frames = (spans.end - spans.begin) * dataset.info.fps
        episode = first_wrong(~(np.abs(frames - dataset.lengths) <= HALF))
        if episode is not None:
            raise UserError(
                f"{meta}: the pictures of {column} of episode {episode} lie between"
                f" {spans.begin[episode]:.4f} s and {spans.end[episode]:.4f} s,"
                f" {frames[episode]:.2f} frames at fps={dataset.info.fps:g}, but the episode has"
                f" {dataset.lengths[episode]} frames. {CORRECT}"
            )
    # Which episodes each file holds, in the order of their images.
    episodes_of: dict[Path, np.ndarray] = {}
    places = np.stack([spans.chunk, spans.file], axis=1)
    files, file_of_episode = np.unique(places, axis=0, return_inverse=True)
    for number, (chunk, file) in enumerate(files.tolist()):
        path = video_file(dataset.root, dataset.info.video_path, column, chunk, file)
        episodes = np.flatnonzero(file_of_episode.reshape(-1) == number)
        episodes_of[path] = episodes[np.argsort(spans.begin[episodes], kind="stable")]
    # No two episodes have the same pictures of a file.
    for path, episodes in episodes_of.items():
        begins = spans.begin[episodes]
        ends = begins + dataset.lengths[episodes] / dataset.info.fps
        k = first_wrong((ends[:-1] - begins[1:]) * dataset.info.fps > HALF)
        if k is not None:
            raise UserError(
                f"{meta}: episodes {episodes[k]} and {episodes[k + 1]} overlap in the video"
                f" {path.name} of {column}: one ends at {ends[k]:.4f} s, and the other begins at"
                f" {begins[k + 1]:.4f} s (from_timestamp). One of them would show the other's"
                f" pictures. {CORRECT}"
            )
    check = partial(_check_file, dataset, column)
    with ThreadPoolExecutor(_FILES_AT_ONCE) as pool:
        sizes = set(pool.map(check, episodes_of, episodes_of.values()))
    for width, height in sizes:
        _compare_size(dataset, column, width, height)


def _check_file(
    dataset: Description, column: str, path: Path, episodes: np.ndarray
) -> tuple[int, int]:
    """Compare a video file with the episodes in it; where its header leaves a doubt, the time of
    every picture with the times at which rows look for theirs. Decodes nothing.

    Returns:
        The width and height of its pictures.
    """
    import av

    require(
        path.is_file(), f"{path} is missing: the dataset is incomplete. Copy or download it again."
    )
    begins = dataset.videos[column].begin[episodes]
    lengths, fps = dataset.lengths[episodes], dataset.info.fps
    firsts = np.cumsum(lengths) - lengths
    total = int(lengths.sum())
    with decoding(path, "a video", "Copy or convert it again."), av.open(str(path)) as container:
        stream = container.streams.video[0]
        time_base = float(stream.time_base or 0)
        rate, base = float(stream.average_rate or 0), float(stream.base_rate or 0)
        pixel_format = str(stream.codec_context.pix_fmt)
        size = (stream.codec_context.width, stream.codec_context.height)
        if _is_deep_grey(pixel_format):
            raise _depth(dataset.root, column, f"{path.name} is stored as {pixel_format}")
        # Pictures at one rate, of its episodes back to back.
        if (
            stream.frames == total
            and rate > 0
            and abs(rate - base) <= 1e-3 * base
            and abs((stream.start_time or 0) * time_base * fps) <= QUARTER
            and abs(total / rate - total / fps) * fps <= QUARTER
            and abs((stream.duration or 0) * time_base * fps - total) <= QUARTER
            and (np.abs(begins * fps - firsts) <= QUARTER).all()
        ):
            return size
        ticks = [packet.pts for packet in container.demux(stream) if packet.pts is not None]
        if not ticks:
            raise ValueError("it holds no picture")
    times = np.sort(np.array(ticks, np.int64)) * time_base
    for episode, begin, length, first in zip(episodes, begins, lengths, firsts, strict=True):
        targets = begin + np.arange(length) / fps
        after = np.clip(np.searchsorted(times, targets), 1, max(len(times) - 1, 1))
        following = np.minimum(after, len(times) - 1)
        is_before_nearer = targets - times[after - 1] <= times[following] - targets
        nearest = np.where(is_before_nearer, after - 1, following)
        away = np.abs(times[nearest] - targets) * fps
        # With a picture for every row, the n-th row's is the n-th. Otherwise only the distance
        # tells.
        wrong = away > QUARTER
        if len(times) == total:
            wrong = nearest != first + np.arange(length)
        frame = first_wrong(wrong | (away > HALF + 1e-6))
        if frame is not None:
            raise UserError(
                f"{path}: frame {frame} of episode {episode} is looked for at {targets[frame]:.4f}"
                f" s ({column}/from_timestamp {begin:.4f} s, fps={fps:g}), but the video, with"
                f" {len(times)} pictures to {times[-1]:.4f} s for {total} rows, has the nearest at"
                f" {times[nearest[frame]]:.4f} s: it is shorter than the table beside it, shifted,"
                f" or of another rate. {CORRECT}"
            )
    return size
