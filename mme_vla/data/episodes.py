"""`EpisodeSource`: one LeRobot v3.0 dataset, read episode by episode from a local folder.

Tables are memory-mapped and videos opened on demand, so what stays in memory does not grow with the
data except for a few numbers an episode.
"""

import io
import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from mme_vla.data.consistency import (
    check_consistency,
    compare_stats,
    compare_units,
    have_other_units,
)
from mme_vla.data.episode_table import read_description
from mme_vla.data.frame_tables import check_vectors, flat, open_table, read_index_columns
from mme_vla.data.hdf5 import SUBGOALS
from mme_vla.data.image_consistency import check_mode
from mme_vla.data.lerobot_files import (
    REMEDY,
    RENDERED_SUFFIX,
    SAMPLE,
    SIDE_FILE,
    TASKS,
    content_fingerprint,
    find_columns,
    names_of,
    read_exec_starts,
    read_info,
    read_records,
    resolve_root,
)
from mme_vla.data.video import VideoReader, video_file
from mme_vla.data.waypoints import Motions, find_motions
from mme_vla.embodiment import ROBOMME_JOINT, Embodiment, Option
from mme_vla.embodiment.action_space import compare_names, read_options
from mme_vla.errors import UserError, brief, counted, did_you_mean, listed, require
from mme_vla.utils import Sums, decoding

log = logging.getLogger(__name__)


class EpisodeSource:
    """The episodes of one dataset.

    name: short name (the folder's, or `sample`).
    fps: frames per second.
    robot: whose columns are read.
    columns: the dataset's column of each camera.
    state_names, action_names: what the dataset calls the numbers of the state and of the action;
        may be empty.
    tasks: which task each frame has.
    starts: [e] int64, rows of the tables at which episodes begin.
    lengths: [e] int64, frames of each episode.
    exec_starts: [e] int64, its first execution frame (0 without a video).
    """

    def __init__(
        self,
        root: str | Path,
        exec_starts: str | Path | None = None,
        name: str | None = None,
        robot: Embodiment = ROBOMME_JOINT,
    ) -> None:
        """Open a dataset and compare it with itself (`consistency`); nothing is downloaded.

        Args:
            root: folder of a LeRobot v3.0 dataset, or `sample`.
            exec_starts: side file with each episode's first execution frame (JSON or parquet), for
                datasets that do not mark their conditioning video.
            name: short name, which the validation split and the cache folder use; by default the
                folder's.
            robot: says which columns hold its images, states and actions.

        Raises:
            UserError: a file is missing or damaged, the dataset does not fit the robot or
                contradicts itself.
        """
        self.root = resolve_root(root)
        self.name = name or ("sample" if self.root == SAMPLE else self.root.resolve().name)
        info = read_info(self.root)
        self.fps = info.fps
        if robot.fps is not None and robot.fps != self.fps:
            log.warning(
                "%s has %g frames per second; the robot %s has %g.",
                self.name,
                self.fps,
                robot.name,
                robot.fps,
            )

        # Columns, and the names of their numbers.
        features = info.features
        matches = find_columns(self.root, features, robot)
        columns = list(matches.tables)
        self.columns = matches.cameras
        self.state_names = names_of([features[column] for column in matches.state])
        self.action_names = names_of([features[column] for column in matches.action])
        self._compare_names(robot)
        self.robot = replace(robot, action=robot.action.with_names(self.action_names))
        vectors = {"state": matches.state, "action": matches.action, "pose": matches.pose}
        self._vectors_of: dict[str, dict[str, int]] = {}
        for kind, names in vectors.items():
            self._vectors_of[kind] = {name: features[name].width for name in names}
        self.subgoal_names = tuple(column for column in SUBGOALS if column in columns)
        is_video = {name: features[name].dtype == "video" for name in self.columns.values()}
        videos = tuple(column for column, is_one in is_video.items() if is_one)
        images = tuple(column for column, is_one in is_video.items() if not is_one)
        self.video_cameras = tuple(name for name in self.columns if self.columns[name] in videos)
        self.lossy = {
            camera: coding
            for camera in self.video_cameras
            if (coding := features[self.columns[camera]].lossy_coding) is not None
        }
        """Of cameras whose videos lost something when they were made: how they were coded."""

        # Checksums of what every opening reads anyway; tables that hold images are left to
        # `verify`.
        sums = Sums(self.root, remedy=REMEDY.removesuffix("."))
        opened = ("meta/",) if images else ("meta/", "data/")
        sums.check(*(name for name in sums.table if name.startswith(opened)))

        # Episodes and rows.
        self._description = read_description(self.root, info, videos, images)
        self.starts = self._description.starts
        self.lengths = self._description.lengths
        self._reader = VideoReader()
        self._motions: dict[int, Motions] = {}
        rendered = {camera: f"{camera}{RENDERED_SUFFIX}" for camera in self.columns}
        flags = ["is_demo", "exec_start_idx", *rendered.values()]
        rows = read_index_columns(self.root, features, flags)
        self._table = open_table(self.root, columns, features)
        self.tasks, in_tables = check_consistency(self._description, rows, self._table)
        side_file = None if exec_starts is None else Path(exec_starts)
        self.exec_starts = self._read_exec_starts(rows, in_tables, side_file)
        self._rendered = {
            camera: rows[column].astype(bool)
            for camera, column in rendered.items()
            if column in rows
        }

        self._check_vectors()

    def _check_vectors(self) -> None:
        """Compare all vectors with their statistics, and the sizes of their numbers with the units
        and with each other.
        """
        scales: dict[str, np.ndarray] = {}
        for kind, vectors in self._vectors_of.items():
            sizes = []
            for column, width in vectors.items():
                least, greatest = check_vectors(self.root, self._table, column, width)
                compare_stats(self.root, column, least, greatest)
                sizes.append(np.maximum(np.abs(least), np.abs(greatest)))
            scales[kind] = np.concatenate([np.zeros(0), *sizes])
        action = self.robot.action
        compare_units(self.root, action.names, action.units, scales["action"])
        places = list(action.relative)
        sizes = [scales[kind][places] for kind in ("state", "action")]
        require(
            not have_other_units(*sizes),
            f"{self.root}: numbers {listed(place + 1 for place in places)} reach"
            f" {brief(sizes[0].tolist())} in the state and {brief(sizes[1].tolist())} in the"
            " action, which is predicted relative to the state: both need one unit (degrees and"
            " radians differ by 57), and the action has to be a position, no difference."
            " Convert one of them, or set embodiment.action.relative=[].",
        )

    def __len__(self) -> int:
        return len(self.lengths)

    def __repr__(self) -> str:
        frames = counted(int(self.lengths.sum()), "frame")
        return f"EpisodeSource({self.name!r}, {counted(len(self), 'episode')}, {frames})"

    @cached_property
    def fingerprint(self) -> str:
        """Hash of the dataset's content, the same wherever the folder lies.

        The table of tasks counts where meta/episodes does not name the one task of every episode.
        """
        parts = ["data", "videos", "meta/episodes"]
        if any(len(texts) != 1 for texts in self._description.tasks):
            parts.append(TASKS)
        return content_fingerprint(self.root, parts)

    @cached_property
    def records(self) -> list[dict[str, Any]]:
        """What the converter knows of each episode beside the columns: task, seed, difficulty, …;
        may be empty.
        """
        return read_records(self.root)

    def locate(self, row: int) -> tuple[int, int]:
        """The episode and the frame in it of a row of the tables; LeRobot calls the row `index`."""
        if not 0 <= row < int(self.lengths.sum()):
            raise IndexError(f"row {row} of {int(self.lengths.sum())}")
        episode = int(np.searchsorted(self.starts, row, side="right")) - 1
        return episode, row - int(self.starts[episode])

    def task(self, episode: int) -> str:
        """Name of the episode's task (`VideoUnmask`), empty if the dataset does not tell."""
        task = self.records[episode].get("task", "") if episode < len(self.records) else ""
        require(
            isinstance(task, str),
            f"{self.root / SIDE_FILE}: the task of episode {episode} is {brief(task)}. {REMEDY}",
        )
        return task

    def verify(self) -> int:
        """Compare every file with the checksums beside them, if there are any; reads the whole
        dataset.

        Returns:
            The number of files compared, 0 for a dataset that was written without checksums.
        """
        sums = Sums(self.root, remedy=REMEDY.removesuffix("."))
        sums.check(*sums.table)
        return len(sums.table)

    def goal(self, episode: int, frame: int | None = None) -> str:
        """The goal of a frame in words, lower-case; without a frame, of an episode whose frames all
        have the same.

        Raises:
            UserError: no frame is given, and the episode has several tasks; they are named.
        """
        if frame is not None:
            return self.tasks.at(int(self.starts[episode]) + frame)
        goals = self.goals(episode)
        require(
            len(goals) == 1,
            f"{self.name}: the frames of episode {episode} have {len(goals)} tasks:"
            f" {listed(map(repr, goals))}. What was asked for needs an episode of one task: choose"
            " another, or split it at the change of task_index.",
        )
        return goals[0]

    def goals(self, episode: int) -> tuple[str, ...]:
        """The different goals of an episode's frames, lower-case, in the order in
        which they begin.
        """
        start = int(self.starts[episode])
        return self.tasks.within(start, start + int(self.lengths[episode]))

    def options(self, episode: int) -> tuple[Option, ...]:
        """What the robot could choose among in an episode; none where it does not choose."""
        letters = len(self.robot.action.choice)
        if not letters:
            return ()
        require(
            episode < len(self.records) and "options" in self.records[episode],
            f"{self.root / SIDE_FILE} does not say which options episode {episode} offered, and the"
            f" robot {self.robot.name!r} chooses among them. Convert or record the dataset again.",
        )
        return read_options(self.records[episode]["options"], letters)

    def states(self, episode: int, start: int = 0, stop: int | None = None) -> np.ndarray:
        """What the robot felt, [stop − start, s] float32."""
        return self._vectors("state", episode, start, stop)

    def actions(self, episode: int, start: int = 0, stop: int | None = None) -> np.ndarray:
        """The action recorded with each frame, [stop − start, w] float32: absolute, or a difference
        to its own pose.
        """
        recorded = self._vectors("action", episode, start, stop)
        if not self.robot.action.of_pose:
            return recorded
        return self.robot.action.from_poses(recorded, self._vectors("pose", episode, start, stop))

    def decisions(self, episode: int) -> Sequence[int] | np.ndarray:
        """The frames at which the robot decides on actions: all of the execution, or those before a
        motion begins.

        Of a recording that was rendered at a choice of frames, those of them that every camera
        shows.
        """
        first, length = int(self.exec_starts[episode]), int(self.lengths[episode])
        decided: Sequence[int] | np.ndarray = range(first, length)
        if self.robot.action.frames is None:
            decided = self._motions_of(episode).decisions
        if not self._rendered:
            return decided
        rendered = np.logical_and.reduce([self.rendered(episode, name) for name in self.columns])
        decided = np.asarray(decided)
        return decided[rendered[decided]]

    def rendered(self, episode: int, camera: str | None = None) -> np.ndarray:
        """Which frames of an episode show what was seen, bool [t]; by default of the camera that
        feeds memory.

        All, unless the dataset was recorded at a choice of frames; the images of others are
        placeholders.
        """
        camera = self.robot.memory_camera if camera is None else camera
        start, length = int(self.starts[episode]), int(self.lengths[episode])
        if camera not in self._rendered:
            return np.ones(length, bool)
        return self._rendered[camera][start : start + length]

    def action_chunk(
        self, episode: int, start: int | np.ndarray, horizon: int, offset: int = 0
    ) -> tuple[np.ndarray, np.ndarray]:
        """The chunk decided at frame `start`, the last action repeated past the episode's end
        (differences are 0).

        Where an action takes a frame these are actions start + offset … start + offset + horizon −
        1.

        Args:
            start: a frame, or frames [n].

        Returns:
            actions [horizon, w] float32, and [horizon] bool that is False on repeated ones; of
            frames [n, horizon, w] and [n, horizon].
        """
        if self.robot.action.frames is None:
            return self._motions_of(episode).chunk(start, horizon)
        steps = np.asarray(start)[..., None] + offset + np.arange(horizon)
        length = int(self.lengths[episode])
        known = steps < length
        steps = np.minimum(steps, length - 1)
        first = int(steps.min())
        chunk = self.actions(episode, first, int(steps.max()) + 1)[steps - first]
        for place in self.robot.action.of_pose:
            chunk[~known, place] = 0
        return chunk, known

    def past_actions(self, episode: int, start: int, most: int, offset: int = 0) -> np.ndarray:
        """The robot's own actions right before the chunk of `start`, oldest first, [n, w]; as many
        as there are.
        """
        if self.robot.action.frames is None:
            return self._motions_of(episode).before(start, most)
        stop = start + offset
        first = max(int(self.exec_starts[episode]) + offset, stop - most)
        if first >= stop:
            return np.zeros((0, self.robot.action.width), np.float32)
        return self.actions(episode, first, stop)

    def robot_motion(
        self, episode: int, frames: np.ndarray, offset: int = 0
    ) -> tuple[np.ndarray, ...]:
        """What the robot felt and did at frames [n] of an episode.

        Returns:
            states [n, s]; the actions [n, w] that led to these frames, as `past_actions` pairs
            them; and bool [n], whether there is one: not at frames of the video, nor at the first
            of the execution, and nowhere where an action is a motion of many frames.
        """
        stop = int(np.max(frames, initial=0)) + 1
        is_known = frames > self.exec_starts[episode]
        if self.robot.action.frames is None:
            is_known = np.zeros_like(is_known)
        before = np.clip(frames - 1 + offset, 0, stop - 1)
        states = self.states(episode, 0, stop)[frames]
        return states, self.actions(episode, 0, stop)[before], is_known

    def _motions_of(self, episode: int) -> Motions:
        if episode not in self._motions:
            first = int(self.exec_starts[episode])
            letters = self.robot.action.choice
            self._motions[episode] = find_motions(self.actions(episode, first), first, letters)
        return self._motions[episode]

    def subgoals(self, episode: int, step: int) -> dict[str, str]:
        """The subgoal texts of one step, lower-case, under the names in `subgoal_names`."""
        row = self._rows(episode, step, step + 1)
        texts = {}
        for name in self.subgoal_names:
            text = flat(row[name])[0].as_py()
            require(
                text is not None,
                f"{self.root}: {name} of frame {step} of episode {episode} has no value. {REMEDY}",
            )
            texts[name] = str(text).lower()
        return texts

    def frames(
        self, episode: int, indices: Sequence[int] | np.ndarray, camera: str | None = None
    ) -> np.ndarray:
        """Decode images [n, H, W, 3] uint8 of a camera at these frames; by default of the one that
        feeds memory.
        """
        indices = np.asarray(indices, np.int64)
        length = int(self.lengths[episode])
        if not len(indices) or indices.min() < 0 or indices.max() >= length:
            raise UserError(
                f"{self.name}, episode {episode}: frames {indices.tolist()[:5]} asked of {length}."
            )
        camera = self.robot.memory_camera if camera is None else camera
        require(
            camera in self.columns,
            f"{self.name} has no camera {camera!r}. {did_you_mean(camera, self.columns)}",
        )
        rendered = self.rendered(episode, camera)[indices]
        if not rendered.all():
            raise UserError(
                f"{self.name}, episode {episode}: {camera} was not rendered at frames"
                f" {indices[~rendered].tolist()[:5]}. It was recorded at a choice of frames: record"
                " it again with frames=… that holds these, or frames=all."
            )
        column = self.columns[camera]
        if camera in self.video_cameras:
            spans = self._description.videos[column]
            chunk, file = int(spans.chunk[episode]), int(spans.file[episode])
            template = self._description.info.video_path
            path = video_file(self.root, template, column, chunk, file)
            timestamps = float(spans.begin[episode]) + indices / self.fps
            return self._reader.read(path, timestamps, self.fps)
        from PIL import Image

        pixels = []
        with decoding(f"{self.root}, episode {episode}, {column}", "pictures", REMEDY):
            for row in (int(self.starts[episode]) + indices).tolist():
                cell = self._table[row : row + 1][column][0].as_py()
                picture = Image.open(io.BytesIO(cell["bytes"]))
                check_mode(self.root, column, picture)
                pixels.append(np.asarray(picture.convert("RGB")))
            return np.stack(pixels)

    def _rows(self, episode: int, start: int, stop: int | None) -> Any:
        length = int(self.lengths[episode])
        stop = length if stop is None else stop
        if not 0 <= start < stop <= length:
            raise UserError(
                f"{self.name}, episode {episode}: steps {start}…{stop - 1} asked of {length}."
            )
        offset = int(self.starts[episode])
        return self._table[offset + start : offset + stop]

    def _vectors(self, kind: str, episode: int, start: int, stop: int | None) -> np.ndarray:
        rows = self._rows(episode, start, stop)
        parts = []
        for name, width in self._vectors_of[kind].items():
            numbers = flat(rows[name]).to_numpy(zero_copy_only=False)
            parts.append(numbers.astype(np.float32).reshape(-1, width))
        return np.concatenate(parts, axis=1)

    def _compare_names(self, robot: Embodiment) -> None:
        """Compare the names of numbers: the dataset's with the robot's, and of states with actions
        relative to them.
        """
        compare_names(
            self.action_names,
            robot.action.names,
            "action",
            f"the dataset {self.name}",
            f"the robot {robot.name}",
            "Order embodiment.action.names as the dataset's column is, or choose the robot that"
            " recorded it.",
        )
        named = min(len(self.state_names), len(self.action_names))
        relative = [place for place in robot.action.relative if place < named]
        compare_names(
            [self.state_names[i] for i in relative],
            [self.action_names[i] for i in relative],
            f"state and action of {self.name}, subtracted from each other",
            "state",
            "action",
            "A number is predicted relative to the state's number at the same place: record both in"
            " one order, or set embodiment.action.relative=[].",
        )

    def _read_exec_starts(
        self,
        rows: Mapping[str, np.ndarray],
        in_tables: np.ndarray | None,
        side_file: Path | None,
    ) -> np.ndarray:
        if side_file is not None:
            starts = read_exec_starts(side_file, len(self))
            if in_tables is not None and not np.array_equal(starts, in_tables):
                episode = int(np.flatnonzero(starts != in_tables)[0])
                raise UserError(
                    f"{side_file}: episode {episode} starts execution at frame {starts[episode]},"
                    f" but by the tables of {self.root} at {in_tables[episode]}. Correct the one"
                    " that is wrong; a dataset that marks its conditioning videos needs no side"
                    " file."
                )
        elif in_tables is not None:
            starts = in_tables
            if "is_demo" not in rows:
                log.warning(
                    "%s has no is_demo; its exec_start_idx says where the conditioning video ends.",
                    self.root,
                )
        elif not self.robot.conditioning_video:
            starts = np.zeros(len(self), np.int64)
        else:
            raise UserError(
                f"{self.root} does not mark its conditioning videos: it has neither is_demo nor"
                " exec_start_idx. Without them video frames would be trained on as if the robot"
                ' had acted. Give a side file: exec_starts=<file>.json with {"<episode_index>":'
                " <first execution frame>, …}, or a parquet table with the columns episode_index"
                " and exec_start_idx (0 for an episode without video). A robot whose episodes"
                " never begin with a video has embodiment.conditioning_video=false."
            )
        outside = np.flatnonzero((starts < 0) | (starts >= self.lengths))
        if len(outside):
            episode = int(outside[0])
            raise UserError(
                f"{side_file or self.root}: episode {episode} starts execution at frame"
                f" {starts[episode]}, but has {self.lengths[episode]} frames."
            )
        return starts


def check_episode(source: EpisodeSource, episode: Any) -> None:
    """Refuse an episode that a dataset does not have."""
    require(
        isinstance(episode, int) and 0 <= episode < len(source),
        f"episode={episode}: {source.name} has episodes 0 … {len(source) - 1}.",
    )
