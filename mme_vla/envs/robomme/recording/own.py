"""Demonstrations of an environment of the user's own, as a LeRobot v3.0 dataset."""

import json
import shutil
import sys
from collections.abc import Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from mme_vla.data.console import progress, quiet_libraries
from mme_vla.data.lerobot_files import FACTS, SIDE_FILE
from mme_vla.embodiment import Embodiment
from mme_vla.embodiment.robomme import choice_action
from mme_vla.envs.base import CHOICES, OPTIONS, Environment, EpisodeEnv
from mme_vla.envs.facts import Fact, read_facts, write_facts
from mme_vla.envs.metadata import EpisodeSpec
from mme_vla.envs.observations import RenderRequest
from mme_vla.errors import UserError, counted, require
from mme_vla.utils import parse_json, write_atomically, write_json

STATE = "observation.state"
ACTION = "action"
IMAGES = "observation.images."
IS_DEMO = "is_demo"
DRAFT = "dataset"


def episode_file(spec: EpisodeSpec) -> str:
    """The name, in the work folder, of the file that keeps a demonstrated episode."""
    return f"{spec.task}-{spec.episode}.npz"


def record_own(
    environment: Environment,
    specs: Sequence[EpisodeSpec],
    output: Path,
    work: Path,
    fps: int = 20,
) -> tuple[int, list[EpisodeSpec]]:
    """Demonstrate episodes into a new dataset; those that do not succeed are left out.

    The columns are `observation.images.<camera>`, `observation.state`, `action`, and `is_demo` for
    the frames of a conditioning video. `meta/facts.csv` has the facts, and the side file the
    options of an environment whose robot acts by choices. `output` appears when it is whole.

    Args:
        work: folder that keeps each episode until then; those in it are not demonstrated again.

    Returns:
        Frames, and the episodes that did not succeed.
    """
    draft = work / DRAFT
    shutil.rmtree(draft, ignore_errors=True)
    dataset: Any = None
    shapes: dict[str, list[int]] = {}  # of a frame's columns, the same in all episodes
    tables: list[tuple[int, str, list[Fact]]] = []
    records: list[dict[str, Any]] = []
    failures = []
    frames = 0
    with quiet_libraries(), progress("record", len(specs), unit="episodes") as advance:
        for spec in specs:
            path = work / episode_file(spec)
            is_recorded = path.is_file()
            columns: dict[str, np.ndarray] | None
            if is_recorded:
                with np.load(path) as loaded:
                    columns = dict(loaded)
            else:
                columns = _demonstrated(environment, spec)
            advance(1)
            if columns is None:
                failures.append(spec)
                continue
            of_frame = _shapes(columns)
            shapes = shapes or of_frame
            require(
                of_frame == shapes,
                f"{spec.task}, episode {spec.episode}: a frame has {_in_words(of_frame)}; expected"
                f" {_in_words(shapes)}, as in the episodes before. Give the same cameras and sizes"
                " in every episode.",
            )
            if not is_recorded:
                with write_atomically(path) as temporary, temporary.open("wb") as file:
                    np.savez_compressed(file, **columns)  # type: ignore[arg-type]
            goal = str(columns.pop("task"))
            # An earlier version kept no facts.
            facts = parse_json(str(columns.pop("facts", "[]")), str(path), list)
            options = parse_json(str(columns.pop("options", "[]")), str(path), list)
            # Of every episode, also of one without options: a reader counts them.
            records.append({"episode_index": len(tables), "task": spec.task, "options": options})
            tables.append((len(tables), spec.task, read_facts(facts, str(path))))
            length = len(columns[STATE])
            for frame in range(length):
                row = {name: column[frame] for name, column in columns.items()}
                if dataset is None:
                    robot = environment.embodiment or {}
                    names = robot.get("action", {}).get("names")
                    dataset = _create(row, draft, fps, names)
                dataset.add_frame({**row, "task": goal})
            dataset.save_episode()
            frames += length
        if dataset is None:
            raise UserError(
                f"None of {counted(len(specs), 'demonstration')} ended with info['success']:"
                " nothing was written."
            )
        dataset.finalize()
    write_facts(draft / FACTS, tables)
    if any(record["options"] for record in records):
        write_json(draft / SIDE_FILE, {"episodes": records}, indent=None)
    draft.rename(output)
    return frames, failures


def _shapes(columns: Mapping[str, np.ndarray]) -> dict[str, list[int]]:
    """What one frame has of each column: the sizes of its array."""
    return {name: list(column.shape[1:]) for name, column in columns.items() if column.ndim}


def _in_words(shapes: Mapping[str, Sequence[int]]) -> str:
    return ", ".join(f"{name} {shape}" for name, shape in sorted(shapes.items()))


def _demonstrated(environment: Environment, spec: EpisodeSpec) -> dict[str, np.ndarray] | None:
    """The columns of an episode [frames, …], its `task`, `facts` and `options`; None where it did
    not succeed.
    """
    robot = None
    space = None
    if environment.embodiment is not None:
        robot = Embodiment.from_dict(environment.embodiment)
        space = robot.action.space
    with closing(environment.open(spec.task, spec.split, spec.episode, action_space=space)) as env:
        options: list[dict[str, Any]] = []
        if robot is not None and space == CHOICES:
            columns, options, success = _by_choices(env, robot)
        else:
            columns = _by_motions(env)
            success = env.success
        if robot is not None:
            cameras = {f"{IMAGES}{camera}" for camera in robot.camera_names}
            widths = (columns[STATE].shape[-1], columns[ACTION].shape[-1])
            require(
                cameras <= set(columns) and widths == (robot.state.width, robot.action.width),
                f"{spec.task}: a frame has {_in_words(_shapes(columns))}, and embodiment names the"
                f" cameras {', '.join(robot.camera_names)}, {robot.state.width} numbers of state"
                f" and {robot.action.width} of an action. Correct one of the two.",
            )
        if not success:
            return None
        columns["task"] = np.array(env.goal)
        columns["facts"] = np.array(json.dumps([fact.to_dict() for fact in env.facts]))
        columns["options"] = np.array(json.dumps(options))
        return columns


def _by_motions(env: EpisodeEnv) -> dict[str, np.ndarray]:
    """The columns of a demonstration, an action for each frame."""
    rows: list[dict[str, np.ndarray]] = []
    for observation, action, visible in env.demonstration():
        row = {}
        for name, value in observation.items():
            if name != "state":
                row[f"{IMAGES}{name}"] = np.asarray(value)
        row[STATE] = np.asarray(observation["state"], np.float32)
        row[ACTION] = np.asarray(action, np.float32)
        row[IS_DEMO] = np.array([visible])
        rows.append(row)
    return {name: _stack(env, name, [row[name] for row in rows]) for name in rows[0]}


def _stack(env: EpisodeEnv, name: str, values: Sequence[np.ndarray]) -> np.ndarray:
    """The column of an episode, from its frames' values."""
    n_axes = 3 if name.startswith(IMAGES) else 1
    is_image = values[0].dtype == np.uint8 and values[0].shape[2:] == (3,)
    forms = sorted({f"{value.dtype} {list(value.shape)}" for value in values})
    require(
        len(forms) == 1 and values[0].ndim == n_axes and (n_axes == 1 or is_image),
        f"{env.spec.task}, episode {env.spec.episode}: {name} is {' and '.join(forms)}; expected an"
        " image as uint8 [H, W, 3], or other numbers as [n], in every frame the same.",
    )
    column = np.stack(values)
    is_finite = np.isfinite(column).reshape(len(column), -1).all(1)
    require(
        is_finite.all(),
        f"{env.spec.task}, episode {env.spec.episode}: {name} has numbers that are not finite,"
        f" first in frame {is_finite.argmin()}.",
    )
    return column


def _by_choices(
    env: EpisodeEnv, robot: Embodiment
) -> tuple[dict[str, np.ndarray], list[dict[str, Any]], bool]:
    """The columns of what the environment's oracle chooses, the options, and whether it succeeds.

    A choice is in the column of actions at the first frame that follows its decision, the first one
    at the frame of the decision itself; all other rows are 0 (`find_motions`).
    """
    every_frame = dict.fromkeys(robot.camera_names, range(sys.maxsize))
    env.render_request = RenderRequest(every_frame, now=())
    received, report = env.reset()
    options: list[dict[str, Any]] = report.get(OPTIONS, [])
    parts = [received]
    video = length = len(received["state_list"])
    choices: dict[int, np.ndarray] = {}  # by frame
    while report["status"] == "ongoing":
        choice = env.oracle()
        if choice is None:
            raise UserError(f"{env.spec.task}: the oracle has no choice.")
        choices[length if choices else length - 1] = choice_action(robot.action, choice)
        received, *_, report = env.step(choice)
        parts.append(received)
        length += len(received["state_list"])

    columns = {}
    for name in robot.camera_names:
        if f"{name}_rgb_list" in received:
            images = [image for part in parts for image in part[f"{name}_rgb_list"]]
            columns[f"{IMAGES}{name}"] = _stack(env, f"{IMAGES}{name}", images)
    states = [state for part in parts for state in part["state_list"]]
    columns[STATE] = _stack(env, STATE, states)
    columns[ACTION] = np.zeros((length, robot.action.width), np.float32)
    for frame, action in choices.items():
        columns[ACTION][frame] = action
    columns[IS_DEMO] = np.arange(length)[:, None] < video - 1
    return columns, options, report["status"] == "success"


def _create(
    row: dict[str, Any], root: Path, fps: int, action_names: Sequence[str] | None = None
) -> Any:
    """A new dataset with the columns of a row.

    action_names: what the robot calls the numbers of its action, if it does.
    """
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    features: dict[str, Any] = {IS_DEMO: {"dtype": "bool", "shape": (1,), "names": None}}
    for name, value in row.items():
        if name.startswith(IMAGES):
            features[name] = {
                "dtype": "image",
                "shape": value.shape,
                "names": ["height", "width", "channel"],
            }
        elif name in (STATE, ACTION):
            names = [f"{name.rpartition('.')[2]} {i}" for i in range(len(value))]
            if name == ACTION and action_names:
                names = list(action_names)
            features[name] = {"dtype": "float32", "shape": value.shape, "names": names}
    return LeRobotDataset.create(
        f"local/{root.name}",
        fps=fps,
        features=features,
        root=root,
        use_videos=False,
        # LeRobot would try torchcodec, and print why it does not load where FFmpeg is missing.
        video_backend="pyav",
    )
