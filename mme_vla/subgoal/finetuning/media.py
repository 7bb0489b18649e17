"""Pictures and videos as files and as bytes."""

import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Self

import numpy as np

from mme_vla.errors import UserError
from mme_vla.files import decoding, require_file

VIDEO_FRAMES = 10  # that a model looks at, at most
_REMEDY = "Build the training data again."
FPS = 30  # of the videos predictors are shown; the simulator's steps simply play faster


def write_mp4(frames: Iterable[np.ndarray], path: Path) -> int:
    """Write frames [H, W, 3] uint8 as an H.264 video; the file appears only when it is whole. Returns their number."""
    draft = path.with_name(f"{path.name}.partial")
    with draft.open("wb") as handle:
        count = _encode(frames, handle)
    draft.replace(path)
    return count


def mp4_bytes(frames: Sequence[np.ndarray] | np.ndarray) -> bytes:
    """The same in memory."""
    buffer = io.BytesIO()
    _encode(frames, buffer)
    return buffer.getvalue()


def png_bytes(frame: np.ndarray) -> bytes:
    """A picture [H, W, 3] uint8 as PNG."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(frame).save(buffer, "PNG")
    return buffer.getvalue()


def write_png(frame: np.ndarray, path: Path) -> None:
    """Write a picture; the file appears only when it is whole."""
    draft = path.with_name(f"{path.name}.partial")
    draft.write_bytes(png_bytes(frame))
    draft.replace(path)


def read_image(path: Path) -> np.ndarray:
    """Read a picture as [H, W, 3] uint8.

    Raises:
        UserError: it is missing or damaged.
    """
    from PIL import Image

    with decoding(require_file(path, "a picture"), "a picture", _REMEDY), Image.open(path) as image:
        return np.array(image.convert("RGB"))


@dataclass(frozen=True)
class Clip:
    """What a Qwen model looks at of a video.

    frames: [n, H, W, 3] uint8. indices: [n] their places in the video. length: of the whole video, in frames.
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
        """Sample a file; frames that are not looked at are decoded but not turned into pictures.

        Raises:
            UserError: it is missing or damaged.
        """
        import av

        with decoding(require_file(path, "a video"), "a video", _REMEDY), av.open(str(path)) as container:
            length = container.streams.video[0].frames
            indices = sample_video(length)
            wanted = set(indices.tolist())
            decoded = enumerate(container.decode(video=0))
            frames = [frame.to_ndarray(format="rgb24") for i, frame in decoded if i in wanted]
        if len(frames) != len(indices) or len({frame.shape for frame in frames}) != 1:
            raise UserError(f"{path} is damaged: it announces {length} frames. {_REMEDY}")
        return cls(np.stack(frames), indices, length)


def sample_video(
    length: int, fps: float = FPS, rate: float = 2.0, least: int = 4, most: int = VIDEO_FRAMES
) -> np.ndarray:
    """Which frames of a video a Qwen model looks at: `rate` a second, within bounds, an even number of them.

    Args:
        length: frames of the video. fps: of the video. rate: frames looked at a second.
        least, most: bounds of their number; a shorter video has fewer.

    Returns:
        int64 indices, evenly spaced from the first to the last frame.
    """
    count = min(max(int(length / fps * rate), least), most, length)
    count = max(count - count % 2, min(2, length))
    return np.linspace(0, length - 1, count).round().astype(np.int64)


def _encode(frames: Iterable[np.ndarray], handle: io.IOBase | object) -> int:
    import av

    count, stream = 0, None
    with av.open(handle, "w", format="mp4") as container:
        for frame in frames:
            if stream is None:
                height, width = frame.shape[:2]
                stream = container.add_stream("libx264", rate=FPS)
                stream.height, stream.width = height, width
                stream.pix_fmt = "yuv420p" if height % 2 == width % 2 == 0 else "yuv444p"
                # One thread: the file does not depend on how threads were scheduled.
                stream.codec_context.thread_count = 1
                stream.options = {"crf": "18", "preset": "medium", "threads": "1"}
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24")))
            count += 1
        if stream is not None:
            container.mux(stream.encode(None))
    if not count:
        raise ValueError("A video needs at least one frame.")
    return count
