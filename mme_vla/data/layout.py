"""Is this folder a dataset we can read? Checked before LeRobot is asked, which would otherwise look on the hub."""

import math
from collections.abc import Sequence
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

from mme_vla.errors import UserError, brief
from mme_vla.files import decoding, inside, read_json, require_file

SAMPLE = Path(__file__).resolve().parent.parent / "assets" / "sample"


def resolve_root(root: str | Path) -> Path:
    """Return the dataset folder; `sample` names the one in the package.

    Raises:
        UserError: there is no such folder, or it is no LeRobot v3.0 dataset.
    """
    path = SAMPLE if str(root) == "sample" else Path(root).expanduser()
    info = path / "meta" / "info.json"
    if not info.is_file():
        raise UserError(
            f"No LeRobot dataset at {str(root)!r} (there is no {info}). Give its local folder, or 'sample'. From the "
            "hub: `hf download <owner>/<dataset> --repo-type dataset --local-dir <folder>`; from HDF5 files: "
            "`python -m mme_vla.data.convert input=<files> output=<folder>`."
        )
    version = brief(read_info(path).get("codebase_version", "unknown"), quote=False)
    if not version.startswith("v3."):
        raise UserError(
            f"{path} is a LeRobot {version} dataset; v3.0 is needed. Convert it with LeRobot's own command: "
            f"`python -m lerobot.scripts.convert_dataset_v21_to_v30 --repo-id={path.name} --root={path} "
            "--push-to-hub=false`."
        )
    for pattern in ("meta/tasks.parquet", "meta/episodes/*/*.parquet", "data/*/*.parquet"):
        if not any(path.glob(pattern)):
            raise UserError(f"{path} has no {pattern}: the dataset is incomplete. Copy, download or convert it again.")
    return path


def read_info(root: Path) -> dict[str, Any]:
    """Return `meta/info.json`: features with a `dtype` and a `shape` of whole numbers, frames per second, and others.

    Raises:
        UserError: it is not JSON, or does not describe features.
    """
    path = root / "meta" / "info.json"
    info = read_json(path, "a dataset's description")
    features = info.get("features")
    if not isinstance(features, dict) or not all(_is_feature(feature) for feature in features.values()):
        raise UserError(f"{path} does not describe its features by dtype and shape. Copy or download it again.")
    fps = info.get("fps")
    if isinstance(fps, bool) or not isinstance(fps, int | float) or not 0 < fps <= 1000 or not math.isfinite(fps):
        raise UserError(f"{path}: fps is {brief(fps)}; expected frames per second, above 0 and at most 1000.")
    return {**info, "features": {name: {**f, "shape": tuple(f["shape"])} for name, f in features.items()}}


def lossy_coding(feature: dict[str, Any]) -> str | None:
    """How a film was coded if something was lost by it, such as `av1 at crf 30`; None where not, or where nothing says.

    LeRobot writes what is known under `info`; its default before it wrote the quality was AV1 at crf 30.
    """
    about = feature.get("info")
    about = about if isinstance(about, dict) else {}
    codec, crf = about.get("video.codec"), about.get("video.crf")
    if not isinstance(codec, str) or crf == 0 or (crf is None and codec != "av1"):
        return None
    return brief(codec, quote=False) + ("" if crf is None else f" at crf {brief(crf)}")


def _is_feature(feature: object) -> bool:
    if not isinstance(feature, dict) or not isinstance(feature.get("dtype"), str):
        return False
    shape = feature.get("shape")
    return isinstance(shape, list) and all(type(side) is int and 0 < side < 2**20 for side in shape)


def read_exec_starts(file: Path, episodes: int) -> np.ndarray:
    """Read a side file of first execution frames, JSON {"0": 66, …} or parquet (episode_index, exec_start_idx).

    Returns:
        int64 [episodes].

    Raises:
        UserError: the file is absent, of another form, or does not cover every episode.
    """
    expected = (
        'Expected JSON {"<episode_index>": <exec_start_idx>, …} or a parquet table with the columns episode_index and '
        "exec_start_idx, all whole numbers from 0."
    )
    require_file(file, "exec_starts, first execution frames")
    if file.suffix == ".json":
        found = list(read_json(file, "first execution frames").items())
        pairs = [(int(key) if key.isdecimal() and len(key) < 10 else key, value) for key, value in found]
    else:
        import pyarrow.parquet as pq

        with decoding(file, "a parquet table", expected), pq.ParquetFile(file) as opened:
            columns = opened.read(columns=["episode_index", "exec_start_idx"]).to_pydict()
            pairs = list(zip(columns["episode_index"], columns["exec_start_idx"], strict=True))
    for pair in pairs:
        if not all(type(number) is int and 0 <= number < 2**40 for number in pair):
            raise UserError(f"{file} says {brief(pair[1])} of episode {brief(pair[0])}. {expected}")
    table = dict(pairs)
    lost = [episode for episode in range(episodes) if episode not in table]
    if lost:
        raise UserError(
            f"{file} covers no episode {lost[:5]}{'…' if len(lost) > 5 else ''}; it must name all {episodes}."
        )
    return np.array([table[episode] for episode in range(episodes)], np.int64)


def content_fingerprint(root: Path, parts: Sequence[str] = ("data", "videos", "meta/episodes")) -> str:
    """Hash what the dataset holds: names, sizes and 64 KB from the start, middle and end of every file in `parts`.

    Independent of the folder's place and of time stamps; reading whole videos would take minutes.
    """
    digest = sha256()
    for part in parts:
        for file in sorted((root / part).rglob("*")):
            if file.suffix not in (".parquet", ".mp4"):
                continue
            size = require_file(inside(root, file.relative_to(root).as_posix()), "a part of a dataset").stat().st_size
            digest.update(f"{file.relative_to(root).as_posix()} {size}\n".encode())
            with file.open("rb") as handle:
                for offset in (0, size // 2, max(size - 65536, 0)):
                    handle.seek(offset)
                    digest.update(handle.read(65536))
    return digest.hexdigest()[:16]
