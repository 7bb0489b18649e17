"""What people look at: one writer of videos, one contact sheet, one border. Images are [H, W, 3]
uint8 throughout.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, Self

import numpy as np

from mme_vla.utils import write_atomically
from mme_vla.utils.style import rgb

if TYPE_CHECKING:
    from PIL.Image import Image
    from PIL.ImageFont import FreeTypeFont, ImageFont

FPS = 30  # of videos; the simulator's steps simply play faster
RED = (255, 0, 0)  # the border of a conditioning video's images, as in the benchmark's own
BORDER = 10  # pixels
CAPTION = 20  # pixels of a line of text below a video's images
GROUND, INK, FAINT = rgb("card", dark=True), rgb("ink", dark=True), rgb("faint", dark=True)
"""Of sheets: a dark ground suits pages of both grounds."""
TILE, GAP, MARGIN, LABEL = 160, 12, 20, 20  # pixels of a contact sheet


class VideoWriter:
    """An H.264 mp4 that is compressed as its frames come, so that no video is held in memory.

    A context manager: the video ends with the block.

    Args:
        target: a path, written in place (draw into a draft what is to appear whole), or a binary
            file.
        fps: frames a second.
        crf, preset: the encoder's, quality and effort.
    """

    def __init__(
        self,
        target: Path | str | BinaryIO,
        fps: float = FPS,
        crf: int = 20,
        preset: str = "veryfast",
    ) -> None:
        import av

        if isinstance(target, Path):
            target = str(target)
        self._container: Any = av.open(target, "w", format="mp4")
        self._rate = Fraction(fps)
        self._options = {"crf": str(crf), "preset": preset, "threads": "1"}
        processor = Path("/proc/cpuinfo")
        if processor.is_file() and b"avx512bw" in processor.read_bytes():
            # x264's AVX-512 routines read uninitialised memory: equal frames made unequal bytes.
            # It has them wherever the CPU does, also where a variable hides that from PyTorch.
            self._options["x264-params"] = "asm=MMX2,SSE2Fast,SSSE3,SSE4.2,AVX,FMA3,BMI2,AVX2"
        self._stream: Any = None
        self.frames = 0

    def add(self, image: np.ndarray) -> None:
        """Append a frame; the first says how large all are."""
        import av

        if self._stream is None:
            height, width = image.shape[:2]
            self._stream = self._container.add_stream("libx264", rate=self._rate)
            self._stream.height, self._stream.width = height, width
            # Colours at half the resolution, which every player takes, need even sides.
            self._stream.pix_fmt = "yuv420p" if height % 2 == width % 2 == 0 else "yuv444p"
            # One thread: the file does not depend on how threads were scheduled.
            self._stream.codec_context.thread_count = 1
            self._stream.options = self._options
        frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(image), format="rgb24")
        self._container.mux(self._stream.encode(frame))
        self.frames += 1

    def close(self, complete: bool = True) -> None:
        """End the video; with `complete=False` what the encoder still holds is dropped, for a file
        that is removed.
        """
        if complete and self._stream is not None:
            self._container.mux(self._stream.encode(None))
        self._container.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self.close(complete=kind is None)


def write_video(frames: Iterable[np.ndarray], path: Path, **options: Any) -> int:
    """Write frames of one size as a video that appears only when it is whole; return their number.

    Args:
        options: as `VideoWriter`.

    Raises:
        ValueError: there is no frame.
    """
    with write_atomically(path) as draft, VideoWriter(draft, **options) as video:
        for frame in frames:
            video.add(frame)
        if not video.frames:
            raise ValueError("A video needs at least one frame.")
    return video.frames


def png_bytes(image: np.ndarray) -> bytes:
    from PIL import Image

    buffer = BytesIO()
    Image.fromarray(image).save(buffer, "PNG")
    return buffer.getvalue()


def video_frame(
    views: Sequence[np.ndarray], caption: str | None = None, video: bool = False
) -> np.ndarray:
    """One frame [H, W, 3] of a robot's views of one moment, in a margin of `BORDER` pixels.

    Args:
        views: side by side in this order; those of other heights stand on the upper edge.
        caption: lines of a band below them; None for no band. Every frame of a video needs as many.
        video: they belong to a conditioning video: the margin is red, else black.

    Returns:
        Sides are even, as the format wants them.
    """
    height = max(len(view) for view in views)
    width = sum(view.shape[1] for view in views)
    lines = [] if caption is None else caption.split("\n")
    framed_height = height + height % 2 + 2 * BORDER
    framed_width = width + width % 2 + 2 * BORDER
    canvas = np.zeros((framed_height + CAPTION * len(lines), framed_width, 3), np.uint8)
    if video:
        canvas[:framed_height] = RED
        canvas[BORDER : BORDER + height, BORDER : BORDER + width] = 0
    left = BORDER
    for view in views:
        canvas[BORDER : BORDER + len(view), left : left + view.shape[1]] = view
        left += view.shape[1]
    if not any(lines):
        return canvas
    from PIL import Image, ImageDraw

    image = Image.fromarray(canvas)
    draw = ImageDraw.Draw(image)
    for number, line in enumerate(lines):
        place = (BORDER, framed_height + CAPTION * number + 2)
        draw.text(place, fitted(line, width, 13), (255, 255, 255), font(13))
    return np.asarray(image)


@dataclass(frozen=True)
class Tile:
    """One image of a contact sheet. outline: a colour around it; None for none."""

    image: np.ndarray
    label: str
    outline: tuple[int, int, int] | None = None


def contact_sheet(
    tiles: Sequence[Tile],
    columns: int,
    title: str = "",
    header: "Image | None" = None,
    side: int = TILE,
) -> "Image":
    """Tiles in rows, each above its label.

    Args:
        columns: tiles a row.
        title: one line above them.
        header: an image between title and tiles.
        side: pixels of a tile.
    """
    from PIL import Image, ImageDraw

    rows = -(-len(tiles) // columns)
    columns = min(columns, len(tiles))
    inner = columns * (side + GAP) - GAP
    top = MARGIN
    if title:
        top += LABEL + MARGIN
    if header is not None:
        inner = max(inner, header.width)
        top += header.height
    width = 2 * MARGIN + inner
    sheet = Image.new("RGB", (width, top + rows * (side + LABEL + GAP) + MARGIN), GROUND)
    draw = ImageDraw.Draw(sheet)
    draw.text((MARGIN, MARGIN), fitted(title, width - 2 * MARGIN, 17), INK, font(17))
    if header is not None:
        sheet.paste(header, (MARGIN, top - header.height))
    for place, tile in enumerate(tiles):
        row, column = divmod(place, columns)
        x = MARGIN + column * (side + GAP)
        y = top + row * (side + LABEL + GAP)
        sheet.paste(thumbnail(tile.image, side), (x, y))
        if tile.outline is not None:
            draw.rectangle(
                (x - 2, y - 2, x + side + 1, y + side + 1), outline=tile.outline, width=2
            )
        draw.text((x, y + side + 3), fitted(tile.label, side, 13), INK, font(13))
    return sheet


def evenly_spaced(count: int, limit: int) -> list[int]:
    """At most `limit` places of a list of `count`, evenly from the first to the last."""
    places: list[int] = np.unique(np.linspace(0, count - 1, limit).round().astype(int)).tolist()
    return places


def thumbnail(image: np.ndarray, side: int = TILE) -> "Image":
    from PIL import Image

    return Image.fromarray(image).resize((side, side), Image.Resampling.LANCZOS)


def font(size: int) -> "FreeTypeFont | ImageFont":
    """Pillow's own face, so that sheets look alike on every machine."""
    from PIL import ImageFont

    return ImageFont.load_default(size)


def fitted(text: str, width: int, size: int) -> str:
    """The text, cut with an ellipsis where it is too long for `width` pixels."""
    face = font(size)
    if face.getlength(text) <= width:
        return text
    while text and face.getlength(text + "…") > width:
        text = text[:-1]
    return text.rstrip() + "…"
