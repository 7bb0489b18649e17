"""An episode to look at: a film of both views, and a contact sheet with what is being done."""

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

from mme_vla.data.hdf5 import EpisodeRef, RawFrame, open_episode
from mme_vla.data.memory_picture import fitted, font

CAPTION, BORDER, FPS = 22, 10, 30  # pixels, pixels, frames a second
TILES, COLUMNS, TILE = 12, 6, 192
VIDEO_RED, INK = (200, 33, 33), (40, 40, 40)


def paired(frame: RawFrame, caption: str | None = None) -> Image.Image:
    """Both views side by side, red-bordered in the conditioning video, the caption below."""
    picture = np.concatenate([frame.front, frame.wrist], axis=1)
    if frame.is_demo:
        picture = picture.copy()
        for edge in (np.s_[:BORDER], np.s_[-BORDER:], np.s_[:, :BORDER], np.s_[:, -BORDER:]):
            picture[edge] = VIDEO_RED
    if caption is None:
        return Image.fromarray(picture)
    height, width = picture.shape[:2]
    framed = Image.new("RGB", (width, height + CAPTION), "white")
    framed.paste(Image.fromarray(picture))
    ImageDraw.Draw(framed).text((6, height + 3), fitted(caption, width - 12, 13), INK, font(13))
    return framed


def write_film(pictures: Sequence[Image.Image], path: Path, fps: int = FPS) -> None:
    """Write pictures of any sizes as an H.264 mp4, each at the top left of a white frame that holds the largest."""
    import av

    width, height = (-(-max(picture.size[axis] for picture in pictures) // 2) * 2 for axis in (0, 1))
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=Fraction(fps))
        stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
        stream.options = {"crf": "23"}
        for picture in pictures:
            canvas = Image.new("RGB", (width, height), "white")
            canvas.paste(picture)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(np.asarray(canvas), format="rgb24")))
        container.mux(stream.encode())


def contact_sheet(frames: Sequence[RawFrame], title: str, tiles: int = TILES) -> Image.Image:
    """Front views spread evenly over an episode, each with its step and sub-task."""
    steps = np.unique(np.linspace(0, len(frames) - 1, tiles).round().astype(int))
    rows = -(-len(steps) // COLUMNS)
    sheet = Image.new("RGB", (COLUMNS * (TILE + 8) + 8, 34 + rows * (TILE + CAPTION + 8)), "white")
    draw = ImageDraw.Draw(sheet)
    draw.text((8, 8), fitted(title, sheet.width - 16, 15), INK, font(15))
    for i, step in enumerate(steps):
        frame = frames[step]
        x, y = 8 + i % COLUMNS * (TILE + 8), 34 + i // COLUMNS * (TILE + CAPTION + 8)
        sheet.paste(Image.fromarray(frame.front).resize((TILE, TILE), Image.Resampling.LANCZOS), (x, y))
        if frame.is_demo:
            draw.rectangle((x, y, x + TILE - 1, y + TILE - 1), outline=VIDEO_RED, width=4)
        caption = f"{step} {frame.subgoals['simple_subgoal_online']}"
        draw.text((x, y + TILE + 3), fitted(caption, TILE, 11), INK, font(11))
    return sheet


def write_previews(file: Path, index: int, task: str, folder: Path) -> tuple[Path, Path]:
    """Write `<task>-<index>.png` and `.mp4` of a recorded episode; return their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    sheet, film = (folder / f"{task}-{index:04d}.{end}" for end in ("png", "mp4"))
    with open_episode(EpisodeRef(file, index, task)) as episode:
        frames, goal = list(episode), episode.goals[0]
    contact_sheet(frames, f"{task} {index}: {goal}").save(sheet)
    write_film([paired(frame, frame.subgoals["simple_subgoal_online"]) for frame in frames], film)
    return sheet, film
