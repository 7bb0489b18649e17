"""From official HDF5 demonstrations to one LeRobot v3.0 dataset.

Every episode first becomes a complete small dataset of its own in `<output>.partial`, which is
renamed when it is whole; at the end all of them are merged and the result is moved to `<output>` in
one step. LeRobot's own writer keeps files open across episodes, so a killed run would leave files
that cannot be read: here it leaves finished episodes, and the next run continues with the missing
ones.
"""

import json
import shutil
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from mme_vla.data.console import progress, quiet_libraries
from mme_vla.data.hdf5 import (
    POSE_STATE,
    SUBGOALS,
    EpisodeRef,
    RawEpisode,
    open_episode,
    recorded_options,
)
from mme_vla.data.lerobot_files import NAMES, RENDERED_SUFFIX, SIDE_FILE, parquet_files
from mme_vla.data.waypoints import CHOICE_ACTIONS, CHOICE_NUMBERS
from mme_vla.embodiment.robomme import ARM_JOINTS, CAMERAS, POSE
from mme_vla.errors import UserError, did_you_mean, require
from mme_vla.registry import SIDE_FILES
from mme_vla.utils import (
    FolderLock,
    claim_plan,
    drop_plan,
    file_sum,
    is_vacant,
    read_json,
    write_sums,
)
from mme_vla.utils.media import RED, Tile, contact_sheet, evenly_spaced, video_frame, write_video


def _episodes_without_statistics(root: Path) -> dict[str, list[Any]]:
    """The list of a dataset's episodes at once, and without their statistics.

    LeRobot asks the `datasets` library, whose time grows with the square of the number of columns:
    of a dozen features that are two hundred, nearly all of them statistics, and a fifth of a second
    for every episode that is merged.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    tables = []
    for file in parquet_files(root, "meta/episodes"):
        names = [name for name in pq.read_schema(file).names if not name.startswith("stats/")]
        tables.append(pq.read_table(file, columns=names))
    columns: dict[str, list[Any]] = pa.concat_tables(tables).to_pydict()
    return columns


TILES, COLUMNS, SIDE = 12, 6, 192


def write_previews(file: Path, index: int, task: str, folder: Path) -> tuple[Path, Path]:
    """Write `<task>-<index>.png` and `.mp4` of a recorded episode; return their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    sheet = folder / f"{task}-{index:04d}.png"
    video = folder / f"{task}-{index:04d}.mp4"
    with open_episode(EpisodeRef(file, index, task)) as episode:
        frames = list(episode)
        goal = episode.goals[0]
    # Front views spread evenly over the episode, each with its step and sub-task.
    tiles = []
    for step in evenly_spaced(len(frames), TILES):
        frame = frames[step]
        outline = RED if frame.is_demo else None
        text = f"{step} {frame.subgoals['simple_subgoal_online']}"
        tiles.append(Tile(frame.front, text, outline))
    contact_sheet(tiles, COLUMNS, f"{task} {index}: {goal}", side=SIDE).save(sheet)
    images = (
        video_frame((f.front, f.wrist), f.subgoals["simple_subgoal_online"], f.is_demo)
        for f in frames
    )
    write_video(images, video)
    return sheet, video


_PARTS = "episodes"
_MERGED = "merged"
_WRITING = "writing"
_KEYFRAMES = "keyframes.npz"
_WORK = (f"{_PARTS}/[0-9][0-9][0-9][0-9][0-9][0-9]-*-*", _MERGED, _WRITING)
"""What a conversion writes into its work folder."""


@dataclass(frozen=True)
class ConvertOptions:
    """How images are stored.

    images: `video`, or `png` for lossless images inside the tables (about ten times larger).
    names: of the columns: `robomme`, as in the released datasets, or `lerobot`, as LeRobot's own
        policies ask for (`lerobot_files.NAMES`). Readers here take either.
    fps: frames per second; 20 is the simulator's control rate.
    codec, crf, pix_fmt, gop: of the videos. The default (H.264 at crf 0, full chroma) is lossless
        but for the rounding between RGB and YUV, so a patch in which nothing moves stays exactly
        the same: TokenDrop relies on that.
    poses: columns of the tool's poses (`hdf5.POSE_ACTIONS`); `convert` takes those that all
        episodes have.
    tool_pose: a column of where the tool was; `convert` keeps it where all episodes have it.
    choices: a column of what was chosen among a task's options, and these options beside the
        tables; `convert` keeps them where all episodes have them.
    keyframes: keep the keyframes' depth and camera poses beside the tables too (`SIDE_FILES`).
    partly: say in two more columns which frames were rendered; `convert` does where an episode was
        recorded at a choice of frames. The images of the others repeat an earlier one, and readers
        refuse them.
    """

    images: str = "video"
    fps: int = 20
    codec: str = "h264"
    crf: int = 0
    pix_fmt: str = "yuv444p"
    gop: int = 8
    poses: tuple[str, ...] = ()
    tool_pose: bool = False
    choices: bool = False
    keyframes: bool = False
    partly: bool = False
    names: str = "robomme"

    def __post_init__(self) -> None:
        require(
            self.images in ("video", "png"), f"images={self.images!r}: expected 'video' or 'png'."
        )
        require(
            self.names in NAMES,
            f"names={self.names!r} is no spelling of columns."
            f" {did_you_mean(str(self.names), NAMES)}",
        )
        require(
            self.fps >= 1 and self.gop >= 1,
            f"fps={self.fps} and video.gop={self.gop} must be positive.",
        )


def features(shape: tuple[int, int, int], options: ConvertOptions) -> dict[str, dict[str, Any]]:
    """The dataset's columns, spelt as `options.names` says."""
    joints = [*(f"joint{i}" for i in range(1, ARM_JOINTS + 1)), "gripper"]
    kind = "video" if options.images == "video" else "image"
    view = {"dtype": kind, "shape": shape, "names": ["height", "width", "channel"]}
    columns = {
        "image": view,
        "wrist_image": dict(view),
        "state": _vector(joints),
        "actions": _vector(joints),
    }
    for name in options.poses:
        columns[name] = _vector([*POSE, "gripper"])
    if options.tool_pose:
        columns[POSE_STATE] = _vector(list(POSE))
    if options.choices:
        columns[CHOICE_ACTIONS] = _vector(CHOICE_NUMBERS)
    scalars = {"is_demo": "bool", "exec_start_idx": "int32", "step_idx": "int32"}
    scalars |= dict.fromkeys(SUBGOALS, "string")
    if options.partly:
        scalars |= {f"{camera}{RENDERED_SUFFIX}": "bool" for camera in CAMERAS}
    for name, dtype in scalars.items():
        columns[name] = {"dtype": dtype, "shape": (1,), "names": None}
    return _spelt(columns, options)


def _vector(names: list[str]) -> dict[str, Any]:
    return {"dtype": "float32", "shape": (len(names),), "names": names}


def _spelt(columns: dict[str, Any], options: ConvertOptions) -> dict[str, Any]:
    spelling = NAMES[options.names]
    return {spelling.get(name, name): value for name, value in columns.items()}


def convert(
    episodes: Sequence[EpisodeRef], output: Path, options: ConvertOptions | None = None
) -> int:
    """Convert these episodes, in this order, into a dataset at `output`; return how many were newly
    written.

    A run that was interrupted is continued by calling again with the same arguments. The files are
    told by their content, so one that has changed since is noticed.
    """
    require(episodes, "There is no episode to convert.")
    options = replace(options or ConvertOptions(), **recorded_options(episodes))
    plan = _plan(episodes, options)
    partial = _work_folder(output)
    if _finished(output, plan) and not partial.exists():
        return 0
    with FolderLock(partial, "conversion"):
        if _finished(output, plan):  # asked again: another process may have finished it meanwhile
            drop_plan(partial, *_WORK)
            return 0
        return _convert(episodes, output, partial, plan, options)


def drop_work(output: Path) -> None:
    """Remove what a conversion left beside `output` that was killed after it had moved its result
    there.
    """
    partial = _work_folder(output)
    if partial.exists():
        with FolderLock(partial, "conversion"):
            drop_plan(partial, *_WORK)


def _work_folder(output: Path) -> Path:
    return output.with_name(output.name + ".partial")


def planned_options(options: ConvertOptions) -> dict[str, Any]:
    """The options that stand among the options of a plan; those that add content stand beside
    them, and `names` is left out where it is the default.
    """
    planned = asdict(options)
    for key in ("poses", "tool_pose", "choices", "partly", "keyframes"):
        del planned[key]
    if options.names == "robomme":
        del planned["names"]
    return planned


def _plan(episodes: Sequence[EpisodeRef], options: ConvertOptions) -> dict[str, Any]:
    """What decides the result. Reading whole files takes a small part of what converting them
    takes.
    """
    files = list(dict.fromkeys(ref.file for ref in episodes))
    with progress("read", sum(file.stat().st_size for file in files), unit="bytes") as advance:
        sums = {}
        for file in files:
            sums[file] = file_sum(file)
            advance(file.stat().st_size)
    origins = []
    first: dict[tuple[str, int], EpisodeRef] = {}
    for ref in episodes:
        same = first.setdefault((sums[ref.file], ref.index), ref)
        require(
            same is ref,
            f"{same.file} and {ref.file} are copies of one file: {ref.group} would be in the"
            " dataset twice. Name one of them.",
        )
        size = ref.file.stat().st_size
        origins.append(
            {"file": ref.file.name, "bytes": size, "sha256": sums[ref.file], "episode": ref.index}
        )
    plan: dict[str, Any] = {"options": planned_options(options), "episodes": origins}
    if options.poses:
        plan["poses"] = list(options.poses)
    for key in ("tool_pose", "choices", "keyframes"):
        if getattr(options, key):
            plan[key] = True
    return plan


def _convert(
    episodes: Sequence[EpisodeRef],
    output: Path,
    partial: Path,
    plan: dict[str, Any],
    options: ConvertOptions,
) -> int:
    require(
        claim_plan(partial, plan),
        f"{partial} belongs to another conversion (other inputs, other content of an input, or"
        " options). Repeat that one to finish it, choose another output, or remove that folder"
        " yourself.",
    )
    for leftover in (partial / _WRITING, partial / _MERGED):
        shutil.rmtree(leftover, ignore_errors=True)  # our own half-written work
    (partial / _PARTS).mkdir(exist_ok=True)
    parts = []
    missing = []
    for i, ref in enumerate(episodes):
        part = partial / _PARTS / f"{i:06d}-{ref.task}-{ref.group}"
        parts.append(part)
        if not part.is_dir():
            missing.append(i)
    with progress("convert", len(parts), len(parts) - len(missing), "episodes") as advance:
        for i in missing:
            with quiet_libraries():
                _write_part(episodes[i], parts[i], options)
            advance(1)
    with quiet_libraries():
        _merge(parts, partial / _MERGED, plan)
    (partial / _MERGED).rename(output)
    drop_plan(partial, *_WORK)
    return len(missing)


def _finished(output: Path, plan: dict[str, Any]) -> bool:
    if is_vacant(output):
        return False
    side = output / SIDE_FILE
    about = "the facts of a converted dataset"
    if side.is_file() and read_json(side, about).get("plan") == plan:
        return True
    raise UserError(
        f"{output} exists and is not the result of this conversion (other files, other content of a"
        " file, other episodes or options). Choose another output, or remove that folder yourself."
    )


def _write_part(ref: EpisodeRef, part: Path, options: ConvertOptions) -> None:
    """Write one episode as a dataset of its own; `part` appears only when it is whole."""
    draft = part.parent.parent / _WRITING
    shutil.rmtree(draft, ignore_errors=True)
    with open_episode(ref) as episode:
        _write_dataset(episode, draft, options)
        if options.keyframes:
            SIDE_FILES["keyframes"].write(episode, draft / _KEYFRAMES)
        side = {
            "task": ref.task,
            "source_file": ref.file.name,
            "source_episode": ref.index,
            "seed": episode.seed,
            "difficulty": episode.difficulty,
            "goals": episode.goals,
            "length": episode.length,
            "exec_start_idx": episode.exec_start,
        }
        if options.choices:
            side["options"] = episode.options
        if episode.frames is not None:
            side["frames"] = episode.frames
    (draft / SIDE_FILE).write_text(json.dumps(side), encoding="utf-8")
    draft.rename(part)


def _write_dataset(episode: RawEpisode, root: Path, options: ConvertOptions) -> None:
    import av
    from lerobot.configs import RGBEncoderConfig
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    goal = episode.goals[0]
    tool = {name: episode.pose_actions(name) for name in options.poses}
    if options.tool_pose:
        tool[POSE_STATE] = episode.tool_poses()
    if options.choices:
        tool[CHOICE_ACTIONS] = episode.choice_actions()
    frames = iter(episode)
    first = next(frames)  # an episode has at least one
    video = options.images == "video"
    encoder = RGBEncoderConfig(
        vcodec=options.codec, crf=options.crf, pix_fmt=options.pix_fmt, g=options.gop
    )
    dataset = LeRobotDataset.create(
        repo_id=f"local/{episode.ref.task}",
        fps=options.fps,
        features=features(first.front.shape, options),
        root=root,
        robot_type="panda",
        use_videos=video,
        video_backend="pyav",
        rgb_encoder=encoder if video else None,
        streaming_encoding=video,
        # LeRobot drops frames when this queue is full, as a live recorder must: never let it be.
        encoder_queue_maxsize=episode.length + 1,
    )
    for step, frame in enumerate(chain([first], frames)):
        row: dict[str, Any] = {
            "image": frame.front,
            "wrist_image": frame.wrist,
            "state": frame.state,
            "actions": frame.action.astype(np.float32),
            "is_demo": np.array([frame.is_demo]),
            "exec_start_idx": np.array([episode.exec_start], np.int32),
            "step_idx": np.array([step], np.int32),
            "task": goal,
        }
        row |= frame.subgoals
        row |= {name: rows[step] for name, rows in tool.items()}
        if options.partly:
            for camera in CAMERAS:
                row[f"{camera}{RENDERED_SUFFIX}"] = np.array([camera in frame.rendered])
        dataset.add_frame(_spelt(row, options))
    dataset.save_episode(parallel_encoding=False)
    dataset.finalize()
    for path in root.glob("videos/**/*.mp4"):
        with av.open(str(path)) as container:
            count = sum(packet.size > 0 for packet in container.demux(video=0))  # without decoding
        if count != episode.length:
            raise RuntimeError(f"{path} holds {count} frames instead of {episode.length}.")


def _merge(parts: Sequence[Path], merged: Path, plan: dict[str, Any]) -> None:
    from lerobot.datasets import dataset_metadata
    from lerobot.datasets.aggregate import aggregate_datasets

    original = dataset_metadata.load_episodes
    dataset_metadata.load_episodes = _episodes_without_statistics
    try:
        aggregate_datasets([part.name for part in parts], "local/robomme", list(parts), merged)
    finally:
        dataset_metadata.load_episodes = original
    for video in merged.glob("videos/**/*.mp4"):
        video.chmod(0o644)  # LeRobot joins videos in private temporary files
    # LeRobot writes its keys in the order of a set, another in each process
    stats = merged / "meta" / "stats.json"
    stats.write_text(
        json.dumps(json.loads(stats.read_text(encoding="utf-8")), indent=4, sort_keys=True),
        encoding="utf-8",
    )
    episodes = []
    for i, part in enumerate(parts):
        facts = read_json(part / SIDE_FILE, "the facts of a converted episode")
        episodes.append({"episode_index": i, **facts})
        if (part / _KEYFRAMES).is_file():
            side_file = SIDE_FILES["keyframes"].file_of(merged, i)
            side_file.parent.mkdir(exist_ok=True)
            shutil.copy(part / _KEYFRAMES, side_file)
    (merged / SIDE_FILE).write_text(
        json.dumps({"plan": plan, "episodes": episodes}, indent=1), encoding="utf-8"
    )
    write_sums(merged)  # LeRobot's format has none: damage would be read as data
