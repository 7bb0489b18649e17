"""A memory as an image: a timeline of how much is remembered of each frame, and the frames
themselves.
"""

import numpy as np
from PIL import Image, ImageDraw

from mme_vla.errors import counted
from mme_vla.utils.media import (
    FAINT,
    GAP,
    GROUND,
    INK,
    LABEL,
    TILE,
    Tile,
    contact_sheet,
    font,
    thumbnail,
)
from mme_vla.utils.style import rgb

COLUMNS = 8  # tiles a row
MOST = 47  # remembered frames that are shown
TIMELINE = 90  # pixels
VIDEO, EXECUTION, NOW = rgb("video"), rgb("series-1"), rgb("border")


def memory_sheet(
    frames: np.ndarray, selected: np.ndarray, grid: int, exec_start: int, step: int, title: str
) -> Image.Image:
    """Draw what is remembered at `step`.

    Args:
        frames: [step + 1, H, W, 3] uint8.
        selected: [n, 2] of (frame, patch), as `Memory.select` returns.
        grid: side of a frame's patch grid.
        exec_start: first execution frame.
        title: one line above.

    Returns:
        An image: remembered patches in colour, the rest of their frames dimmed, the current frame
        last.
    """
    counts = np.bincount(selected[:, 0], minlength=len(frames))
    remembered = np.flatnonzero(counts)
    displayed = remembered
    if len(remembered) > MOST:  # the first frame, and those of which most is kept
        fullest = remembered[np.argsort(-counts[remembered], kind="stable")[:MOST]]
        displayed = np.unique(np.append(fullest, remembered[0]))[:MOST]
    tiles = []
    for frame in displayed.tolist():
        patches = selected[selected[:, 0] == frame, 1]
        kind, colour = "execution", EXECUTION
        if frame < exec_start:
            kind, colour = "video", VIDEO
        label = f"{frame} {kind} {len(patches)}/{grid**2}"
        tiles.append(Tile(np.asarray(_highlighted(frames[frame], patches, grid)), label, colour))
    tiles.append(Tile(frames[step], f"now: frame {step}", NOW))
    columns = max(min(COLUMNS, len(tiles)), 6)
    header = Image.new("RGB", (columns * (TILE + GAP) - GAP, TIMELINE + 2 * LABEL), GROUND)
    draw = ImageDraw.Draw(header)
    _timeline(draw, counts, grid**2, exec_start, step, header.width)
    hidden = len(remembered) - len(displayed)
    note = "In colour: remembered patches. Dimmed: the rest of those frames."
    if hidden:
        note += f" Remembered in part: {counted(hidden, 'more frame')}."
    draw.text((0, header.height - LABEL - 4), note, FAINT, font(13))
    return contact_sheet(tiles, COLUMNS, title, header)


def _highlighted(frame: np.ndarray, patches: np.ndarray, grid: int) -> Image.Image:
    """The frame, bright in the remembered patches and outlined around them."""
    image = thumbnail(frame)
    mask = np.isin(np.arange(grid**2), patches).reshape(grid, grid)
    large = Image.fromarray(mask.astype(np.uint8) * 255).resize(
        (TILE, TILE), Image.Resampling.NEAREST
    )
    grey = image.convert("L").convert("RGB")
    dimmed = Image.blend(grey, Image.new("RGB", grey.size, GROUND), 0.62)
    tile = Image.composite(image, dimmed, large)
    draw = ImageDraw.Draw(tile)
    edge = np.linspace(0, TILE, grid + 1).round().astype(int)
    padded = np.pad(mask, 1)
    for row, column in zip(*np.nonzero(mask), strict=True):
        left, upper, right, lower = edge[column], edge[row], edge[column + 1] - 1, edge[row + 1] - 1
        for inside, line in (
            (padded[row, column + 1], (left, upper, right, upper)),
            (padded[row + 2, column + 1], (left, lower, right, lower)),
            (padded[row + 1, column], (left, upper, left, lower)),
            (padded[row + 1, column + 2], (right, upper, right, lower)),
        ):
            if not inside:
                draw.line(tuple(int(value) for value in line), fill=INK)
    return tile


def _timeline(
    draw: ImageDraw.ImageDraw,
    counts: np.ndarray,
    full: int,
    exec_start: int,
    step: int,
    width: int,
) -> None:
    """Bars of the tokens remembered of each frame, over video and execution."""
    bottom = TIMELINE - LABEL
    scale = width / max(len(counts), 1)
    split = exec_start * scale
    for begin, end, colour in ((0, split, VIDEO), (split, width, EXECUTION)):
        if end > begin:
            pale = tuple(g + (c - g) // 5 for g, c in zip(GROUND, colour, strict=True))
            draw.rectangle((begin, 0, end, bottom), fill=pale)
    for frame in np.flatnonzero(counts):
        x = frame * scale
        y = bottom - max(3, counts[frame] / full * bottom)
        colour = VIDEO if frame < exec_start else EXECUTION
        draw.rectangle((x, y, x + max(scale, 2), bottom), fill=colour)
    draw.line((0, bottom, width, bottom), fill=INK)
    phases = {0: "0 · conditioning video", exec_start: f"{exec_start} · execution", step: str(step)}
    for frame, text in phases.items():
        x = min(frame * scale, width - draw.textlength(text, font(13)))
        draw.text((x, bottom + 3), text, INK, font(13))
