"""Datasets of LeRobot's version v3.0 written table by table, so that a test can make them
contradict themselves.
"""

import io
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from PIL import Image

from mme_vla.embodiment import Embodiment

CAMERA = "observation.images.top"
ROWS = "data/chunk-000/file-000.parquet"
EPISODES = "meta/episodes/chunk-000/file-000.parquet"
VIDEO = f"videos/{CAMERA}/chunk-000/file-000.mp4"
FPS = 10
SHADE = 20  # frame i of the dataset is grey of SHADE · i


def custom_robot(**action: Any) -> Embodiment:
    """A robot of one's own with three numbers and one camera."""
    return Embodiment.from_dict(
        {
            "name": "desk arm",
            "cameras": {"top": {}},
            "conditioning_video": False,
            "state": {"width": 3},
            "action": {"width": 3, "horizon": 4, "execute": 2, **action},
        }
    )


def grey_image(shade: int) -> np.ndarray:
    return np.full((32, 32, 3), shade % 256, np.uint8)


def cell(image: np.ndarray, kind: str = "png") -> dict[str, Any]:
    """A picture as a table holds it."""
    content = io.BytesIO()
    Image.fromarray(image).save(content, kind)
    return {"bytes": content.getvalue(), "path": None}


def write_video(
    path: Path,
    images: Sequence[np.ndarray],
    rate: float = FPS,
    pixel_format: str = "yuv420p",
    coder: str = "libx264",
) -> None:
    """A lossless video of these images at an even rate."""
    from fractions import Fraction

    import av

    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream(coder, rate=Fraction(rate).limit_denominator(1001))
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt = pixel_format
        kind = "rgb24" if images[0].ndim == 3 else "gray16le"
        for image in images:
            frame = av.VideoFrame.from_ndarray(image, format=kind)
            container.mux(stream.encode(frame.reformat(format=pixel_format)))
        container.mux(stream.encode())


def write_dataset(
    root: Path,
    lengths: Sequence[int] = (5, 4),
    tasks: Sequence[str] = ("open the drawer", "close the drawer"),
    video: bool = False,
    states: np.ndarray | None = None,
    actions: np.ndarray | None = None,
    names: Any = None,
    fps: float = FPS,
) -> Path:
    """A dataset without any fault; episode e has the e-th task."""
    ends = np.cumsum(lengths)
    total = int(ends[-1])
    frames = np.concatenate([np.arange(length) for length in lengths])
    episode = np.repeat(np.arange(len(lengths)), lengths)
    drawn = np.random.default_rng(5).normal(size=(total, 3))
    states = drawn if states is None else states
    vectors = {"observation.state": states, "action": states + 0.1 if actions is None else actions}
    rows: dict[str, Any] = {name: pa.array(np.float32(values).tolist(), pa.list_(pa.float32(), 3))
                            for name, values in vectors.items()}  # fmt: skip
    rows |= {"timestamp": np.float32(frames / fps), "frame_index": frames, "episode_index": episode}
    rows |= {"index": np.arange(total), "task_index": episode}
    images = [grey_image(SHADE * i) for i in range(total)]
    if not video:
        rows[CAMERA] = pa.array([cell(image) for image in images])
    table(root / ROWS, rows)
    about: dict[str, Any] = {"episode_index": np.arange(len(lengths)), "length": np.array(lengths)}
    about |= {
        "dataset_from_index": ends - lengths,
        "dataset_to_index": ends,
        "tasks": [[task] for task in tasks],
    }
    if video:
        write_video(root / VIDEO, images, fps)
        about |= {
            f"videos/{CAMERA}/{key}": np.zeros(len(lengths), int)
            for key in ("chunk_index", "file_index")
        }
        about |= {f"videos/{CAMERA}/from_timestamp": (ends - lengths) / fps}
        about |= {f"videos/{CAMERA}/to_timestamp": ends / fps}
    table(root / EPISODES, about)
    index = pd.Index(list(tasks), name="task")
    pd.DataFrame({"task_index": range(len(tasks))}, index=index).to_parquet(
        root / "meta" / "tasks.parquet"
    )
    features = {name: {"dtype": "float32", "shape": [3], "names": names} for name in vectors}
    features[CAMERA] = {"dtype": "video" if video else "image", "shape": [32, 32, 3], "names": None}
    features |= {
        name: {"dtype": "float32" if name == "timestamp" else "int64", "shape": [1], "names": None}
        for name in ("timestamp", "frame_index", "episode_index", "index", "task_index")
    }
    info = {
        "codebase_version": "v3.0",
        "fps": fps,
        "features": features,
        "total_episodes": len(lengths),
        "total_frames": total,
        "total_tasks": len(tasks),
        "chunks_size": 1000,
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
    }
    (root / "meta" / "info.json").write_text(json.dumps(info))
    return root


def table(path: Path, columns: dict[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    pq.write_table(pa.table(columns), path)


def change(root: Path, file: str, name: str, values: Any) -> None:
    """Replace a column of a table, add it, or with None take it out."""
    path = root / file
    read = pq.ParquetFile(path).read()
    if name in read.column_names:
        read = read.drop_columns([name])
    if values is not None:
        read = read.append_column(
            name, values if isinstance(values, pa.Array) else pa.array(values)
        )
    pq.write_table(read, path)


def change_info(root: Path, edit: Callable[[dict[str, Any]], object]) -> None:
    path = root / "meta" / "info.json"
    info = json.loads(path.read_text())
    edit(info)
    path.write_text(json.dumps(info))
