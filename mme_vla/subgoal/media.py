"""Pictures and videos as files and as bytes."""

import io
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from mme_vla.errors import UserError

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

    try:
        with Image.open(path) as image:
            return np.asarray(image.convert("RGB"))
    except OSError as error:
        raise UserError(f"{path} cannot be read ({error}). Build the training data again.") from None


def read_video(path: Path) -> np.ndarray:
    """Read all frames of a video, [t, H, W, 3] uint8.

    Raises:
        UserError: it is missing or damaged.
    """
    import av

    try:
        with av.open(str(path)) as container:
            frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    except (OSError, ValueError) as error:  # PyAV's errors derive from these
        raise UserError(f"{path} cannot be read ({error}). Build the training data again.") from None
    return np.stack(frames)


def sample_video(length: int, fps: float = FPS, rate: float = 2.0, least: int = 4, most: int = 10) -> np.ndarray:
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
                # One thread: the same frames always give the same file.
                stream.options = {"crf": "18", "preset": "medium", "threads": "1"}
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24")))
            count += 1
        if stream is not None:
            container.mux(stream.encode(None))
    if not count:
        raise ValueError("A video needs at least one frame.")
    return count
