"""Demonstrations of an environment of the user's own, as a LeRobot v3.0 dataset."""

import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mme_vla.data.console import progress, quiet_libraries
from mme_vla.envs.base import Environment
from mme_vla.envs.facts import FACTS, Fact, write_facts
from mme_vla.envs.metadata import EpisodeSpec
from mme_vla.errors import UserError, counted
from mme_vla.utils import parse_json, write_atomically

STATE = "observation.state"
ACTION = "action"
IMAGES = "observation.images."
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
    the frames of a conditioning video. `meta/facts.csv` has the facts. `output` appears when it is
    whole.

    Args:
        work: folder that keeps each episode until then; those in it are not demonstrated again.

    Returns:
        Frames, and the episodes that did not succeed.
    """
    draft = work / DRAFT
    episodes = {work / episode_file(spec): spec for spec in specs}
    shutil.rmtree(draft, ignore_errors=True)
    dataset: Any = None
    failures = []
    frames = 0
    with quiet_libraries(), progress("record", len(specs), unit="episodes") as advance:
        for path, spec in episodes.items():
            if not path.is_file():
                columns = _demonstrated(environment, spec)
                if columns is None:
                    failures.append(spec)
                else:
                    with write_atomically(path) as temporary, temporary.open("wb") as file:
                        np.savez_compressed(file, **columns)  # type: ignore[arg-type]
            advance(1)
        tables: list[tuple[int, str, list[Fact]]] = []
        for path in filter(Path.is_file, episodes):
            with np.load(path) as loaded:
                columns = dict(loaded)
            goal = str(columns.pop("task"))
            # An earlier version kept no facts.
            facts = parse_json(str(columns.pop("facts", "[]")), str(path), list)
            task = episodes[path].task
            tables.append((len(tables), task, [Fact.from_dict(fact) for fact in facts]))
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
    draft.rename(output)
    return frames, failures


def _demonstrated(environment: Environment, spec: EpisodeSpec) -> dict[str, np.ndarray] | None:
    """The columns of an episode [frames, …] and its `task`; None where it did not succeed."""
    env = environment.open(spec.task, spec.split, spec.episode)
    try:
        rows: list[dict[str, np.ndarray]] = []
        for observation, action, visible in env.demonstration():
            row = {}
            for name, value in observation.items():
                if name != "state":
                    row[f"{IMAGES}{name}"] = np.asarray(value)
            row[STATE] = np.asarray(observation["state"], np.float32)
            row[ACTION] = np.asarray(action, np.float32)
            row["is_demo"] = np.array([visible])
            rows.append(row)
        if not env.success:
            return None
        facts = json.dumps([fact.to_dict() for fact in env.facts])
        columns = {"task": np.array(env.goal), "facts": np.array(facts)}
        for name in rows[0]:
            columns[name] = np.stack([row[name] for row in rows])
        return columns
    finally:
        env.close()


def _create(
    row: dict[str, Any], root: Path, fps: int, action_names: Sequence[str] | None = None
) -> Any:
    """A new dataset with the columns of a row.

    action_names: what the robot calls the numbers of its action, if it does.
    """
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    features: dict[str, Any] = {"is_demo": {"dtype": "bool", "shape": (1,), "names": None}}
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
