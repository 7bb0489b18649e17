"""Seconds that opening a dataset takes, with everything that is compared on the way.

    python benchmarks/opening.py [--episodes 1600] [--frames 480]

The embedded sample, then a dataset of that many episodes with two cameras, ten episodes a video
file. Each is opened three times: the first time its tables are copied into the cache folder.
"""

import argparse
import json
import tempfile
import time
from pathlib import Path

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from timing import machine

FPS, SIDE, TASKS = 20, 32, 16
CAMERAS = ("image", "wrist_image")
IN_TABLE, IN_VIDEO = 400, 10  # episodes of a file


def write_video(path: Path, frames: int) -> None:
    """A video of grey images."""
    import av

    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=FPS, options={"preset": "ultrafast"})
        stream.height = stream.width = SIDE
        stream.pix_fmt = "yuv420p"
        for i in range(frames):
            image = np.full((SIDE, SIDE, 3), i % 256, np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode())


def write(root: Path, episodes: int, frames: int) -> None:
    """Write a dataset of RoboMME's columns, every episode as long as the others."""
    rng = np.random.default_rng(0)
    for folder in ("meta/episodes/chunk-000", "data/chunk-000"):
        (root / folder).mkdir(parents=True)
    for number, first in enumerate(range(0, episodes, IN_TABLE)):
        episode = np.repeat(np.arange(first, min(first + IN_TABLE, episodes)), frames)
        frame = np.tile(np.arange(frames), len(episode) // frames)
        values = {}
        for name in ("state", "actions"):
            numbers = rng.normal(size=(len(episode), 8)).astype(np.float32)
            values[name] = pa.FixedSizeListArray.from_arrays(pa.array(numbers.ravel()), 8)
        columns = {
            **values,
            "is_demo": np.zeros(len(episode), bool),
            "timestamp": (frame / FPS).astype(np.float32),
            "frame_index": frame,
            "episode_index": episode,
            "index": episode * frames + frame,
            "task_index": episode % TASKS,
        }
        pq.write_table(pa.table(columns), root / f"data/chunk-000/file-{number:03d}.parquet")
    number = np.arange(episodes)
    tasks = [f"do thing {i}" for i in range(TASKS)]
    about = {
        "episode_index": number,
        "length": np.full(episodes, frames),
        "dataset_from_index": number * frames,
        "dataset_to_index": (number + 1) * frames,
        "tasks": [[tasks[i % TASKS]] for i in number],
    }
    for camera in CAMERAS:
        begin = number % IN_VIDEO * frames / FPS
        about |= {f"videos/{camera}/chunk_index": np.zeros(episodes, int)}
        about |= {f"videos/{camera}/file_index": number // IN_VIDEO}
        about |= {
            f"videos/{camera}/from_timestamp": begin,
            f"videos/{camera}/to_timestamp": begin + frames / FPS,
        }
        folder = root / "videos" / camera / "chunk-000"
        folder.mkdir(parents=True)
        write_video(folder / "file-000.mp4", IN_VIDEO * frames)
        content = (folder / "file-000.mp4").read_bytes()
        for file in range(1, -(-episodes // IN_VIDEO)):
            (folder / f"file-{file:03d}.mp4").write_bytes(content)
    pq.write_table(pa.table(about), root / "meta/episodes/chunk-000/file-000.parquet")
    table = pd.DataFrame({"task_index": range(TASKS)}, index=pd.Index(tasks, name="task"))
    table.to_parquet(root / "meta/tasks.parquet")
    shapes = {
        **dict.fromkeys(CAMERAS, ("video", [SIDE, SIDE, 3])),
        **dict.fromkeys(("state", "actions"), ("float32", [8])),
        "is_demo": ("bool", [1]),
        "timestamp": ("float32", [1]),
        **dict.fromkeys(("frame_index", "episode_index", "index", "task_index"), ("int64", [1])),
    }
    features = {
        name: {"dtype": kind, "shape": shape, "names": None}
        for name, (kind, shape) in shapes.items()
    }
    info = {"codebase_version": "v3.0", "fps": FPS, "features": features}
    (root / "meta/info.json").write_text(json.dumps(info))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--episodes", type=int, default=1600, help="a multiple of ten")
    parser.add_argument("--frames", type=int, default=480, help="of an episode")
    args = parser.parse_args()
    from mme_vla.data.episodes import EpisodeSource

    print(machine())
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "synthetic"
        write(root, args.episodes, args.frames)
        for name in ("sample", str(root)):
            for opening in ("first", "second", "third"):
                begin, cpu = time.perf_counter(), time.process_time()
                source = EpisodeSource(name)
                seconds, busy = time.perf_counter() - begin, time.process_time() - cpu
                print(
                    f"{source.name}, {len(source)} episodes, {opening} opening: {seconds:.2f} s"
                    f" ({busy:.2f} s CPU)"
                )


if __name__ == "__main__":
    main()
