"""Images out of video files, by time stamp, with PyAV.

PyAV brings its own FFmpeg, so the same decoder runs on every machine; torchcodec needs FFmpeg's
libraries from the system and is not used. Files stay open between calls, as many as the process may
hold: samples are sampled from all episodes at random, and opening a file takes longer than decoding
an image.
"""

import os
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mme_vla.data.lerobot_files import REMEDY
from mme_vla.errors import UserError, brief, require
from mme_vla.utils import decoding, files_to_hold, inside

# images: a target further ahead than this is sought, a nearer one is decoded up to
_SEEK_BEYOND = 64


class VideoReader:
    """Decodes single images from a bounded number of open files. Safe across `fork`: a child opens
    its own.
    """

    def __init__(self, max_open: int = 512) -> None:
        """Open nothing yet.

        Args:
            max_open: most files held; each takes one to two megabytes for its decoder.
        """
        self.max_open = max_open
        self._open: OrderedDict[Path, Any] = OrderedDict()
        self._process = os.getpid()

    def read(self, path: Path, timestamps: Sequence[float] | np.ndarray, fps: float) -> np.ndarray:
        """Return the images nearest to `timestamps` (seconds), [n, H, W, 3] uint8, in the order
        asked for.
        """
        order = np.argsort(np.asarray(timestamps), kind="stable")
        targets = np.asarray(timestamps, np.float64)[order]
        require(
            path.is_file(),
            f"{path} is missing: the dataset is incomplete. Copy or download it again.",
        )
        try:
            with decoding(path, "a video", "Copy or convert it again."):
                images = list(self._decode(self._container(path), targets, fps))
                if len({image.shape for image in images}) > 1:
                    raise ValueError("its images are not of one size")
        except UserError:
            self._drop(path)
            raise
        if len(images) < len(targets):
            self._drop(path)
            raise UserError(
                f"{path} holds no image at {targets[len(images)]:.3f} s ({fps:g} frames per"
                " second): the video is shorter than the table beside it, or damaged. Copy or"
                " convert the dataset again."
            )
        out = np.empty((len(targets), *images[0].shape), np.uint8)
        out[order] = images
        return out

    @staticmethod
    def _decode(container: Any, targets: np.ndarray, fps: float) -> Iterator[np.ndarray]:
        stream = container.streams.video[0]
        tolerance = 0.5 / fps
        near = _SEEK_BEYOND / fps
        frames: Iterator[Any] = iter(())
        time, image = -np.inf, None
        ahead: Any = None  # the image after `image`, where it was decoded already
        for target in targets:
            is_behind = image is None or target < time - tolerance
            if is_behind or target > time + near:
                # One tick early, so that rounding never lands behind the image's own key frame.
                container.seek(max(round(target / stream.time_base) - 1, 0), stream=stream)
                frames = container.decode(stream)
                time, image, ahead = -np.inf, None, None
            while time < target - tolerance:
                image = next(frames, None) if ahead is None else ahead
                ahead = None
                if image is None:
                    return
                time = float(image.pts * stream.time_base)
            while target - time > tolerance / 2:
                # of a video with more images a second, the next may be nearer
                ahead = next(frames, None) if ahead is None else ahead
                if ahead is None:
                    break
                next_time = float(ahead.pts * stream.time_base)
                if next_time - target >= target - time:
                    break
                time, image, ahead = next_time, ahead, None
            if time > target + tolerance or image is None:
                return
            yield image.to_ndarray(format="rgb24")

    def _container(self, path: Path) -> Any:
        import av

        if self._process != os.getpid():
            # open files of a parent process share their position with it
            self._open = OrderedDict()
            self._process = os.getpid()
        if path not in self._open:
            container = av.open(str(path))
            # parallelism is across workers
            container.streams.video[0].codec_context.thread_count = 1
            self._open[path] = container
            most = files_to_hold(self.max_open)
            while len(self._open) > most:
                self._open.popitem(last=False)[1].close()
        self._open.move_to_end(path)
        return self._open[path]

    def _drop(self, path: Path) -> None:
        if path in self._open:
            self._open.pop(path).close()

    def __getstate__(self) -> dict[str, Any]:
        return {"max_open": self.max_open}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(**state)  # type: ignore[misc]


def video_file(root: Path, template: object, view: str, chunk: int, file: int) -> Path:
    """The place of a video: `video_path` of meta/info.json, filled in."""
    path = str(template)
    for name, number in (("chunk_index", chunk), ("file_index", file)):
        for form in ("", ":d", ":03d"):
            path = path.replace(f"{{{name}{form}}}", format(number, form[1:]))
    remaining = path.replace("{video_key}", "")
    if not isinstance(template, str) or "{" in remaining or "}" in remaining:
        raise UserError(
            f"{root / 'meta' / 'info.json'}: video_path is {brief(template)}; expected a path with"
            f" the fields {{video_key}}, {{chunk_index:03d}} and {{file_index:03d}}. {REMEDY}"
        )
    return inside(root, path.replace("{video_key}", view), "video")
