"""Is this folder a dataset we can read? Checked before LeRobot is asked, which would otherwise look on the hub."""

import json
from collections.abc import Sequence
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

from mme_vla.errors import UserError

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
    version = str(read_info(path).get("codebase_version", "unknown"))
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
    """Return `meta/info.json`.

    Raises:
        UserError: it is not JSON.
    """
    try:
        return json.loads((root / "meta" / "info.json").read_text())
    except json.JSONDecodeError as error:
        raise UserError(f"{root / 'meta' / 'info.json'} is damaged: {error}.") from None


def read_exec_starts(file: Path, episodes: int) -> np.ndarray:
    """Read a side file of first execution frames, JSON {"0": 66, …} or parquet (episode_index, exec_start_idx).

    Returns:
        int64 [episodes].

    Raises:
        UserError: the file is absent, of another form, or does not cover every episode.
    """
    if not file.is_file():
        raise UserError(f"exec_starts={file} does not exist.")
    try:
        if file.suffix == ".json":
            table = {int(key): int(value) for key, value in json.loads(file.read_text()).items()}
        else:
            import pyarrow.parquet as pq

            columns = pq.read_table(file, columns=["episode_index", "exec_start_idx"]).to_pydict()
            table = dict(zip(columns["episode_index"], columns["exec_start_idx"], strict=True))
    except (ValueError, AttributeError, OSError) as error:
        raise UserError(
            f'{file} cannot be read ({error}): expected JSON {{"<episode_index>": <exec_start_idx>, …}} or a parquet '
            "table with the columns episode_index and exec_start_idx."
        ) from None
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
            size = file.stat().st_size
            digest.update(f"{file.relative_to(root).as_posix()} {size}\n".encode())
            with file.open("rb") as handle:
                for offset in (0, size // 2, max(size - 65536, 0)):
                    handle.seek(offset)
                    digest.update(handle.read(65536))
    return digest.hexdigest()[:16]
