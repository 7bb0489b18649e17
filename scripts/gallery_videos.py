"""Render one demonstrated episode of each task as a small animated WebP: the videos of
docs/benchmark/gallery.md.

    python scripts/gallery_videos.py                       # all sixteen, half an hour of one core
    python scripts/gallery_videos.py StopCube --output outputs/gallery

Episode 2 of the `test` split, front camera. A red border marks frames of the conditioning video.
Existing files are kept.
"""

import argparse
from io import BytesIO
from pathlib import Path

import numpy as np
from PIL import Image

from mme_vla.cli.gallery import demonstrated
from mme_vla.envs.episodes import choose_episodes
from mme_vla.utils import write_atomically
from mme_vla.utils.media import BORDER, RED, Tile, evenly_spaced

FOLDER = Path(__file__).resolve().parents[1] / "docs" / "benchmark" / "gallery"
SIDE, FRAMES, LIMIT = 192, 48, 150_000  # pixels, frames, bytes
DURATION, LAST = 120, 1500  # milliseconds of a frame, and of the last one


def bordered(image: np.ndarray) -> np.ndarray:
    """The image in a red border: it belongs to a conditioning video."""
    framed = image.copy()
    for edge in (np.s_[:BORDER], np.s_[-BORDER:], np.s_[:, :BORDER], np.s_[:, -BORDER:]):
        framed[edge] = RED
    return framed


def encode(views: list[Tile]) -> bytes:
    """Return the views as a looping WebP of at most `LIMIT` bytes."""
    chosen = [views[i] for i in evenly_spaced(len(views), min(FRAMES, len(views)))]
    images = [
        Image.fromarray(view.image if view.outline is None else bordered(view.image))
        for view in chosen
    ]
    images = [image.resize((SIDE, SIDE), Image.Resampling.LANCZOS) for image in images]
    durations = [DURATION] * (len(images) - 1) + [LAST]
    for quality in range(70, 0, -10):
        buffer = BytesIO()
        images[0].save(
            buffer,
            "WEBP",
            save_all=True,
            append_images=images[1:],
            duration=durations,
            loop=0,
            quality=quality,
            method=6,
        )
        if buffer.tell() <= LIMIT:
            return buffer.getvalue()
    raise ValueError(f"{len(images)} frames do not fit into {LIMIT} bytes at any quality.")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("tasks", nargs="*", help="tasks to render, by default all")
    parser.add_argument("--output", type=Path, default=FOLDER)
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    for spec in choose_episodes(options.tasks or "all", [2], "test"):
        path = options.output / f"{spec.task}.webp"
        if path.is_file():
            continue
        env, views = demonstrated(spec)
        env.close()
        with write_atomically(path) as draft:
            draft.write_bytes(encode(views))
        print(f"{path}: {path.stat().st_size:,} bytes", flush=True)


if __name__ == "__main__":
    main()
