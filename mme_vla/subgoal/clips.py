"""Images and videos as models read them: frames sampled from a video in memory or in a file."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import numpy as np

from mme_vla.errors import UserError
from mme_vla.utils import decoding, require_file
from mme_vla.utils.media import FPS

VIDEO_FRAMES = 10  # of a video, at most
FRAMES_PER_SECOND = 2.0  # of video
LEAST_FRAMES = 4  # of a video, if it has as many
ENCODING: dict[str, Any] = {"crf": 18, "preset": "medium"}
"""Compression of videos of training data, finer than that of videos for people."""

_REMEDY = "Build the training data again."


def read_image(path: Path) -> np.ndarray:
    """Read an image as [H, W, 3] uint8."""
    from PIL import Image

    with decoding(require_file(path, "an image"), "an image", _REMEDY), Image.open(path) as image:
        return np.array(image.convert("RGB"))


@dataclass(frozen=True)
class Clip:
    """Frames of a video that a model reads.

    frames: [n, H, W, 3] uint8.
    indices: [n] their frame numbers in the video.
    length: frames of the whole video.
    """

    frames: np.ndarray
    indices: np.ndarray
    length: int

    @classmethod
    def of(cls, video: np.ndarray) -> Self:
        """Sample a video [t, H, W, 3] uint8."""
        indices = sample_video(len(video))
        return cls(np.ascontiguousarray(video[indices]), indices, len(video))

    @classmethod
    def read(cls, path: Path) -> Self:
        """Sample a file; of the other frames no image is made.

        Raises:
            UserError: the file is damaged.
        """
        import av

        with (
            decoding(require_file(path, "a video"), "a video", _REMEDY),
            av.open(str(path)) as container,
        ):
            length = container.streams.video[0].frames
            indices = sample_video(length)
            required = set(indices.tolist())
            frames = []
            for i, frame in enumerate(container.decode(video=0)):
                if i in required:
                    frames.append(frame.to_ndarray(format="rgb24"))
        if len(frames) != len(indices) or len({frame.shape for frame in frames}) != 1:
            raise UserError(f"{path} is damaged: it announces {length} frames. {_REMEDY}")
        return cls(np.stack(frames), indices, length)


def sample_video(length: int, most: int = VIDEO_FRAMES) -> np.ndarray:
    """Sample an even number of frames of a video, as Qwen models do.

    Args:
        length: frames of the video.
        most: sampled ones.

    Returns:
        int64 indices, evenly spaced from the first to the last frame.
    """
    count = max(int(length / FPS * FRAMES_PER_SECOND), LEAST_FRAMES)
    count = min(count, most, length)
    count -= count % 2
    count = max(count, min(2, length))
    return np.linspace(0, length - 1, count).round().astype(np.int64)
