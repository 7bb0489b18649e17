r"""Compose the README's moving picture: an episode of each suite, with its goal and its outcome.

The policy is the one for all sixteen tasks that ships with the library.

    # VideoUnmaskSwap 13, PickXtimes 6, VideoRepick 12 and RouteStick 4
    mme-vla evaluate checkpoint=nano16 tasks=PickXtimes episodes=[6] split=reserved \
        seed=7 max_actions=20 only_possible=true video=all output=outputs/suites/PickXtimes
    python scripts/readme_video.py outputs/suites/*
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

import av
import numpy as np
from gallery_videos import bordered
from PIL import Image, ImageDraw

from mme_vla.evaluation.records import EpisodeRecord
from mme_vla.evaluation.results.scopes import TASK_FACTS
from mme_vla.evaluation.store import read_records
from mme_vla.utils import write_atomically
from mme_vla.utils.media import BORDER, evenly_spaced, font
from mme_vla.utils.style import PALETTE

TARGET = Path(__file__).resolve().parents[1] / "docs" / "images" / "suites.webp"
SIDE, CAPTION, GAP = 256, 76, 8  # pixels of an image, of the text below it, between episodes
TITLE, GOAL = 13, 14  # sizes of letters, readable on a page of 400 pixels too
FRAMES, DURATION, LAST, LIMIT = 56, 140, 2500, 2_000_000  # frames, milliseconds, bytes


def front_views(path: Path) -> list[np.ndarray]:
    """The front camera's part of the frames of an episode's video."""
    with av.open(str(path)) as video:
        frames = [frame.to_ndarray(format="rgb24") for frame in video.decode(video=0)]
    images = []
    for i in evenly_spaced(len(frames), FRAMES):
        image = frames[i][BORDER : BORDER + SIDE, BORDER : BORDER + SIDE]
        # The margin of a conditioning video's frames is red.
        red, green, blue = frames[i][: BORDER - 2, : BORDER - 2].mean((0, 1))
        images.append(bordered(image) if red > 180 and max(green, blue) < 80 else image)
    return images + images[-1:] * (FRAMES - len(images))


def wrapped(text: str, width: int, size: int, lines: int) -> list[str]:
    """The text in lines of at most `width` pixels; what does not fit ends in an ellipsis."""
    face = font(size)
    rows = [""]
    for word in text.split():
        longer = f"{rows[-1]} {word}".strip()
        if face.getlength(longer) <= width:
            rows[-1] = longer
        else:
            rows.append(word)
    if len(rows) > lines:
        rows = [*rows[: lines - 1], f"{rows[lines - 1]} …"]
    return rows


def panel(image: np.ndarray, record: EpisodeRecord, is_last: bool) -> Image.Image:
    """One image of an episode above its suite, goal and, at the end, outcome."""
    canvas = Image.new("RGB", (SIDE, SIDE + CAPTION), PALETTE["card"][1])
    canvas.paste(Image.fromarray(image))
    draw = ImageDraw.Draw(canvas)
    title = f"{TASK_FACTS[record.task].suite}: {record.task}"
    # A dark ground, which suits pages of both grounds.
    draw.text((4, SIDE + 4), title, PALETTE["accent"][1], font(TITLE))
    if is_last:
        solved = record.outcome == "success"
        outcome, colour = ("solved", "good") if solved else (record.outcome, "bad")
        draw.text((SIDE - 4, SIDE + 4), outcome, PALETTE[colour][1], font(TITLE), anchor="ra")
    goal = str(record.goal).removeprefix("watch the video carefully, then ")
    for row, line in enumerate(wrapped(goal, SIDE - 8, GOAL, 3)):
        draw.text((4, SIDE + 22 + 16 * row), line, PALETTE["ink"][1], font(GOAL))
    return canvas


def compose(folders: Sequence[Path]) -> list[Image.Image]:
    """The frames of the picture: the episodes of the folders, two in a row."""
    order = list(TASK_FACTS)
    episodes = []
    for folder in folders:
        (record,) = read_records(folder / "episodes.jsonl")
        (video,) = (folder / "videos").glob("*.mp4")
        episodes.append((record, front_views(video)))
    episodes.sort(key=lambda episode: order.index(episode[0].task))
    rows = -(-len(episodes) // 2)
    size = (2 * SIDE + GAP, rows * (SIDE + CAPTION + GAP) - GAP)
    frames = []
    for t in range(FRAMES):
        frame = Image.new("RGB", size, PALETTE["card"][1])
        for place, (record, images) in enumerate(episodes):
            row, column = divmod(place, 2)
            image = panel(images[t], record, is_last=t == FRAMES - 1)
            frame.paste(image, (column * (SIDE + GAP), row * (SIDE + CAPTION + GAP)))
        frames.append(frame)
    return frames


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folders", type=Path, nargs="+", help="evaluations of one episode each")
    parser.add_argument("--output", type=Path, default=TARGET)
    options = parser.parse_args()
    first, *others = compose(options.folders)
    with write_atomically(options.output) as draft:
        first.save(
            draft,
            "WEBP",
            save_all=True,
            append_images=others,
            duration=[DURATION] * (FRAMES - 1) + [LAST],
            loop=0,
            quality=62,
            method=6,
        )
        if draft.stat().st_size > LIMIT:
            raise SystemExit(f"{draft.stat().st_size:,} bytes, more than {LIMIT:,}.")
    print(f"{options.output}: {options.output.stat().st_size:,} bytes")


if __name__ == "__main__":
    main()
