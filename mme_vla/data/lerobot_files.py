"""A LeRobot v3.0 dataset's files: description, columns, tables. All of them are checked when they
are opened.

Places, fallbacks and meanings are those of LeRobot's own classes; tests compare the two on every
layout. The classes themselves are not used: they download a file from the hub that they cannot open
here, read the table of episodes through a cache whose key is the files' paths and time stamps, and
take several seconds to import.
"""

import logging
import re
import shlex
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from hashlib import sha256
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, Field

from mme_vla.data.hdf5 import SUBGOALS
from mme_vla.embodiment import Embodiment
from mme_vla.embodiment.action_space import POSE_WIDTH
from mme_vla.errors import UserError, brief, listed, require
from mme_vla.utils import decoding, inside, read_json, require_file
from mme_vla.utils.validation import validated

log = logging.getLogger(__name__)
SIDE_FILE = "meta/robomme_episodes.json"
"""What LeRobot's columns have no place for: task, seed, difficulty, options of a choice."""
FACTS = "meta/facts.csv"
"""The table of what its frames show, a row a fact: `record` writes it (`envs/facts.py`)."""
RENDERED_SUFFIX = "_drawn"
"""After a camera's name: the column that says which frames it was rendered at, where not at all."""
NAMES: Mapping[str, Mapping[str, str]] = {
    "robomme": {},
    "lerobot": {
        "image": "observation.images.image",
        "wrist_image": "observation.images.wrist_image",
        "state": "observation.state",
        "actions": "action",
    },
}
"""Spellings of a dataset's columns, each by how it differs from the released datasets'."""
_ACTION = ("action", "actions")
REMEDY = "Copy, download or convert the dataset again."
TASKS = "meta/tasks.parquet"
VIDEO_PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
"""Where LeRobot keeps videos unless info.json says otherwise."""


class Feature(BaseModel):
    """A column by `meta/info.json`.

    info, video_info: what is said of a camera's images, today and by older writers.
    """

    dtype: str
    shape: tuple[Annotated[int, Field(strict=True, gt=0, lt=2**20)], ...]
    names: Any = None
    info: Any = None
    video_info: Any = None

    @property
    def width(self) -> int:
        """How many numbers a row holds; 0 for what is no vector."""
        return self.shape[0] if len(self.shape) == 1 else 0

    @property
    def number_names(self) -> tuple[str, ...]:
        """The names of a row's numbers; empty unless each has one.

        LeRobot writes a list, or a list under one key such as `motors`.
        """
        names = self.names
        if isinstance(names, Mapping) and len(names) == 1:
            names = next(iter(names.values()))
        if not isinstance(names, list | tuple) or len(names) != self.width:
            return ()
        return tuple(map(str, names))

    @property
    def about_images(self) -> dict[str, Any]:
        """What is said of a camera's images beside their shape; empty where nothing is."""
        for about in (self.info, self.video_info):
            if isinstance(about, dict) and about:
                return about
        return {}

    @property
    def lossy_coding(self) -> str | None:
        """The lossy codec of a video, such as `av1 at crf 30`; None for a lossless one, or without
        information.

        LeRobot's default before it wrote the quality was AV1 at crf 30.
        """
        codec = self.about_images.get("video.codec")
        crf = self.about_images.get("video.crf")
        if not isinstance(codec, str) or crf == 0:
            return None
        name = brief(codec, quote=False)
        if crf is None:
            return name if codec == "av1" else None
        return f"{name} at crf {brief(crf)}"


class Info(BaseModel):
    """`meta/info.json`, as far as it is read."""

    features: dict[str, Feature]
    fps: Annotated[float, Field(strict=True, gt=0, le=1000)]
    codebase_version: Any = "unknown"
    video_path: Any = VIDEO_PATH
    total_episodes: Any = None
    total_frames: Any = None


@dataclass(frozen=True)
class Columns:
    """Where things are: a column for every camera, and those whose numbers, joined, are the state
    and the action.

    pose: the same of the tool's pose, where actions are differences to it.
    tables: the columns that are read frame by frame; images are among them only where they are
        stored in the tables.
    """

    cameras: Mapping[str, str]
    state: tuple[str, ...]
    action: tuple[str, ...]
    pose: tuple[str, ...]
    tables: tuple[str, ...]


def _near_column(name: str, features: Iterable[str]) -> str | None:
    """The column that a name is most like: with the same end, or spelt almost alike."""
    known = list(features)
    end = name.rpartition(".")[2]
    for column in known:
        if column.rpartition(".")[2] == end:
            return column
    ends = {column.rpartition(".")[2]: column for column in known}
    near = get_close_matches(name, known, 1, 0.8) or get_close_matches(end, list(ends), 1, 0.8)
    if not near:
        return None
    return ends.get(near[0], near[0])


def find_columns(root: Path, features: Mapping[str, Feature], robot: Embodiment) -> Columns:
    """Match a robot with a dataset.

    Raises:
        UserError: a column is missing, or holds something else than the robot has.
    """
    columns: dict[str, str] = {}
    missing = []
    for name, candidates in _spellings(robot).items():
        present = [candidate for candidate in candidates if candidate in features]
        if present:
            columns[name] = present[0]
        else:
            missing.append(candidates[0])
    if missing:
        has_cameras = all(name in columns for name in robot.camera_names)
        raise UserError(_missing_columns(root, features, robot, missing, has_cameras))

    cameras = {name: columns[name] for name in robot.camera_names}
    for name, column in cameras.items():
        kind = features[column].dtype
        require(
            kind in ("image", "video"),
            f"{root}: {column} holds {brief(kind)}, no images: it cannot be"
            f" the camera {name!r} of the robot {robot.name!r} (embodiment.cameras.{name}.key).",
        )
    state = tuple(columns[key] for key in robot.state.key or ("state",))
    action = tuple(columns[key] for key in robot.action.key or ("action",))
    pose = tuple(columns[key] for key in robot.action.pose_key)
    vectors = [("state", state, robot.state.width), ("action", action, robot.action.width)]
    counts = Counter([*cameras.values(), *state, *action])
    repeated = [column for column, count in counts.items() if count > 1]
    if repeated:
        log.warning(
            "%s: the robot %s reads %s more than once, as cameras, state or action (keys in the"
            " section embodiment).",
            root,
            robot.name,
            listed(repeated),
        )
    if pose:
        vectors.append(("tool's pose", pose, POSE_WIDTH))
    for what, names, width in vectors:
        widths = [features[name].width for name in names]
        if sum(widths) != width or not all(widths):
            shapes = [f"{name} has shape {list(features[name].shape)}" for name in names]
            raise UserError(
                f"{root}: {', '.join(shapes)}; expected [{width}], the {what} of the robot"
                f" {robot.name!r}."
            )

    tables = [*state, *action, *pose]
    tables += [name for name in SUBGOALS if name in features]
    tables += [column for column in cameras.values() if features[column].dtype == "image"]
    return Columns(cameras, state, action, pose, tuple(dict.fromkeys(tables)))


def _spellings(robot: Embodiment) -> dict[str, list[str]]:
    """By name of a camera or key of a vector: the columns that may hold it, the first one first."""
    spellings: dict[str, list[str]] = {}
    for camera in robot.cameras:
        spellings[camera.name] = []
        for name in (camera.key or camera.name, camera.name):
            spellings[camera.name] += [name, f"observation.images.{name}"]
    for key in (*robot.state.key, *robot.action.pose_key):
        spellings[key] = [key, f"observation.{key}"]
    for key in robot.action.key:
        spellings[key] = [key]
        if key in _ACTION:
            spellings[key] += _ACTION
    if not robot.state.key:
        spellings["state"] = ["observation.state", "state"]
    if not robot.action.key:
        spellings["action"] = [*_ACTION]
    return spellings


def _missing_columns(
    root: Path,
    features: Mapping[str, Feature],
    robot: Embodiment,
    missing: Sequence[str],
    has_cameras: bool,
) -> str:
    """The message for columns that a dataset lacks; with all cameras there, it is of another action
    space.
    """
    plural = "" if len(missing) == 1 else "s"
    message = f"{root} lacks the feature{plural} {', '.join(missing)}; it has {listed(features)}."
    if robot.action.space is not None and has_cameras:
        return (
            f"{message} The robot {robot.name!r} acts in another space than this dataset's"
            " actions are of. Take a dataset that `mme-vla record` or `mme-vla convert` wrote,"
            " which has poses and waypoints too, or another robot: embodiment=robomme_joint, or"
            " a checkpoint that was trained in joint angles."
        )
    message += (
        f" These are the names of the robot {robot.name!r}: take a dataset of this robot (a"
        " checkpoint keeps its own), choose embodiment=<the robot this dataset is of>, or name its"
        " columns in a configs/embodiment file of your own."
    )
    for name in missing:
        near = _near_column(name, features)
        if near is not None:
            message += f" Did you mean `key: {near}` for {name}?"
    return (
        f"{message} `mme-vla inspect {shlex.quote(f'dataset={root}')}` drafts that file, and"
        " docs/extend/your-robot.md explains it."
    )


def names_of(features: Sequence[Feature]) -> tuple[str, ...]:
    """What a dataset calls the numbers of some features, joined; empty unless each has a name."""
    names: list[str] = []
    for feature in features:
        if not feature.number_names:
            return ()
        names += feature.number_names
    return tuple(names)


SAMPLE = Path(__file__).resolve().parent.parent / "assets" / "sample"


def resolve_root(root: str | Path) -> Path:
    """Return the dataset folder; `sample` names the one in the package."""
    path = SAMPLE if str(root) == "sample" else Path(root).expanduser()
    info = path / "meta" / "info.json"
    require(
        info.is_file(),
        f"No LeRobot dataset at {str(root)!r} (there is no {info}). Give its local folder, or"
        " 'sample'. From the hub: `hf download <owner>/<dataset> --repo-type dataset --local-dir"
        " <folder>`; from HDF5 files: `mme-vla convert input=<files> output=<folder>`.",
    )
    version = brief(read_info(path).codebase_version, quote=False)
    require(
        version.startswith("v3."),
        f"{path} is a LeRobot {version} dataset; v3.0 is needed. Convert it with LeRobot's own"
        " command: `python -m lerobot.scripts.convert_dataset_v21_to_v30"
        f" --repo-id={shlex.quote(path.name)} --root={shlex.quote(str(path))}"
        " --push-to-hub=false`.",
    )
    missing = []
    if not (path / TASKS).exists():
        missing.append(TASKS)
    for part in ("meta/episodes", "data"):
        if not parquet_files(path, part):
            missing.append(f"{part}/*/*.parquet")
    require(
        not missing,
        f"{path} has no {listed(missing)}: the dataset is incomplete. Copy, download or convert it"
        " again.",
    )
    return path


def read_info(root: Path) -> Info:
    """Read and check `meta/info.json`."""
    path = root / "meta" / "info.json"
    values = read_json(path, "a dataset's description")
    try:
        return validated(Info, values, "The description")
    except UserError as error:
        raise UserError(f"{path}: {error} {REMEDY}") from None


def read_records(root: Path) -> list[dict[str, Any]]:
    """Read the side file: what is known of each episode beside the columns; empty without one."""
    path = root / SIDE_FILE
    if not path.exists() and not path.is_symlink():
        return []
    records = read_json(path, "what is known of a dataset's episodes").get("episodes")
    if not isinstance(records, list) or not all(isinstance(record, dict) for record in records):
        raise UserError(f"{path} holds no list of episodes. {REMEDY}")
    return records


def read_exec_starts(file: Path, episodes: int) -> np.ndarray:
    """Read a side file of first execution frames, JSON {"0": 66, …} or parquet (episode_index,
    exec_start_idx).

    Returns:
        int64 [episodes].
    """
    expected = (
        'Expected JSON {"<episode_index>": <exec_start_idx>, …} or a parquet table with the columns'
        " episode_index and exec_start_idx, all whole numbers from 0."
    )
    require_file(file, "exec_starts, first execution frames")
    rows: list[tuple[Any, Any]] = []
    if file.suffix == ".json":
        for key, value in read_json(file, "first execution frames").items():
            if key.isdecimal() and len(key) < 10:
                rows.append((int(key), value))
            else:
                rows.append((key, value))
    else:
        import pyarrow.parquet as pq

        with decoding(file, "a parquet table", expected), pq.ParquetFile(file) as opened:
            columns = opened.read(columns=["episode_index", "exec_start_idx"]).to_pydict()
            rows += zip(columns["episode_index"], columns["exec_start_idx"], strict=True)
    for episode, start in rows:
        if not all(type(number) is int and 0 <= number < 2**40 for number in (episode, start)):
            raise UserError(f"{file} says {brief(start)} of episode {brief(episode)}. {expected}")
    table: dict[int, int] = {}
    for episode, start in rows:
        require(
            table.get(episode, start) == start,
            f"{file} gives episode {episode} two first execution frames, {table.get(episode)} and"
            f" {start}. Keep the right one.",
        )
        table[episode] = start
    missing = [episode for episode in range(episodes) if episode not in table]
    require(
        not missing,
        f"{file} covers no episode {listed(missing, 5)}; it must name all {episodes}.",
    )
    return np.array([table[episode] for episode in range(episodes)], np.int64)


def content_fingerprint(
    root: Path, parts: Sequence[str] = ("data", "videos", "meta/episodes")
) -> str:
    """Hash what the dataset holds: names, sizes and 64 KB from the start, middle and end of every
    file in `parts`.

    Independent of the folder's place and of time stamps; reading whole videos would take minutes. A
    change that leaves a file's size and these three places alone is not noticed: a cache of images
    is then taken for that of the changed ones. Only checksums notice it (`EpisodeSource.verify`).
    Numbers are never read by this hash: see `open_table`.

    Args:
        root: the dataset's folder.
        parts: folders in it, or single files.
    """
    digest = sha256()
    for part in parts:
        place = root / part
        files = [place] if place.is_file() else sorted(place.rglob("*"))
        for file in files:
            if file != place and file.suffix not in (".parquet", ".mp4"):
                continue
            if file.name.startswith(_HIDDEN):
                continue
            name = file.relative_to(root).as_posix()
            size = require_file(inside(root, name), "a part of a dataset").stat().st_size
            digest.update(f"{name} {size}\n".encode())
            with file.open("rb") as handle:
                for offset in (0, size // 2, max(size - 65536, 0)):
                    handle.seek(offset)
                    digest.update(handle.read(65536))
    return digest.hexdigest()[:16]


_HIDDEN = "."
"""Begins the names of files that are not the dataset's: macOS leaves `._<name>` beside what it
copies to other disks.
"""


def parquet_files(root: Path, folder: str) -> list[Path]:
    """The parquet files of `folder`, two levels down as in LeRobot v3.0, in the order of their
    numbers.
    """

    def in_order(path: Path) -> list[str | int]:
        # file-1000 comes after file-999, where texts would put it after file-100
        parts: list[str | int] = []
        for part in re.split(r"(\d+)", f"{path.parent.name}/{path.name}"):
            parts.append(int(part) if part.isdecimal() else part)
        return parts

    files = []
    for path in (root / folder).glob("*/*.parquet"):
        if not path.name.startswith(_HIDDEN):
            files.append(require_file(path, "a parquet table"))
    return sorted(files, key=in_order)


def read_tasks(root: Path) -> list[str]:
    """The texts of `meta/tasks.parquet` by `task_index`.

    Raises:
        UserError: the file holds no texts, or its column `task_index` does not count its rows,
            which LeRobot goes by.
    """
    import pandas as pd

    path = root / TASKS
    expected = (
        "Expected the task's text as the index (or a column `task`), and a column `task_index`: 0,"
        " 1, 2, …"
    )
    with decoding(require_file(path, "a table of tasks"), "a table of tasks", expected):
        table = pd.read_parquet(path)
        texts = list(table.index)
        if "task" in table.columns:
            texts = list(table["task"])
        numbers = list(range(len(texts)))
        if "task_index" in table.columns:
            numbers = list(table["task_index"])
    wrong = [text for text in texts if not isinstance(text, str)]
    require(
        not wrong, f"{path} holds {brief(wrong[:1])} where the text of a task belongs. {expected}"
    )
    for row, (number, text) in enumerate(zip(numbers, texts, strict=True)):
        if number != row:
            raise UserError(
                f"{path}: row {row}, {brief(text)}, has task_index {brief(number)}. LeRobot takes a"
                f" task by its row, so the row and task_index must be the same. {expected}"
            )
    return texts
