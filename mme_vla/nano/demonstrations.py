"""Demonstrations drawn only where somebody looks: at the decisions, and at the frames that memories remember there.

An episode of planned motions has a handful of decisions, known when it is over. Where everything stood is kept of every
frame; then the frames that are wanted are put back and drawn. That takes a second where drawing all takes ten.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mme_vla.data.waypoints import Motions, find_motions
from mme_vla.embodiment.robomme import benchmark_state
from mme_vla.envs.make import make_task
from mme_vla.files import parse_json, write_atomically
from mme_vla.nano.snapshots import Snapshots
from mme_vla.subgoal.oracle import online_subgoal

if TYPE_CHECKING:
    from mme_vla.envs.recording.recorder import RecordedStep
    from mme_vla.envs.task import Task

Looks = Callable[[int, int], Sequence[int]]
"""`looks(step, exec_start)`: the frames up to `step` that a memory remembers there."""
SUBGOALS = ("simple", "grounded")
CAMERAS = {"front": "base_camera", "wrist": "hand_camera"}


@dataclass(frozen=True)
class Demonstration:
    """One episode of a task, with pictures of some frames.

    length: frames. exec_start: the first execution frame. states: [length, 8] float32. motions: its decisions.
    subgoals: `simple` and `grounded` → what the simulator says at each decision, as it says it at test
    time. pictures: camera → frame → [256, 256, 3] uint8.
    """

    task: str
    seed: int
    difficulty: str
    goal: str
    length: int
    exec_start: int
    states: np.ndarray
    motions: Motions
    pictures: dict[str, dict[int, np.ndarray]]
    subgoals: dict[str, list[str]] = field(default_factory=dict)

    def save(self, path: Path) -> None:
        """Write it as one file, which appears whole or not at all."""
        names = ("task", "seed", "difficulty", "goal", "length", "exec_start", "subgoals")
        about = {name: getattr(self, name) for name in names}
        arrays = {"states": self.states, "decisions": self.motions.decisions, "targets": self.motions.targets}
        for camera, taken in self.pictures.items():
            arrays[f"{camera}_frames"] = np.array(list(taken), np.int64)
            arrays[f"{camera}_pictures"] = np.stack(list(taken.values()))
        with write_atomically(path) as draft, draft.open("wb") as file:
            np.savez_compressed(file, about=np.array(json.dumps(about)), **arrays)  # type: ignore[arg-type]

    @classmethod
    def load(cls, path: Path) -> "Demonstration":
        """Read what `save` wrote."""
        with np.load(path) as file:
            pictures = {
                camera: dict(zip(file[f"{camera}_frames"].tolist(), file[f"{camera}_pictures"], strict=True))
                for camera in CAMERAS
                if f"{camera}_frames" in file
            }
            motions = Motions(file["decisions"], file["targets"])
            about = parse_json(str(file["about"]), str(path))
            return cls(**about, states=file["states"], motions=motions, pictures=pictures)


def record(
    task: str,
    seed: int,
    difficulty: str,
    looks: Sequence[Looks],
    cameras: Sequence[str] = ("front", "wrist"),
    execute: int = 1,
) -> Demonstration | None:
    """Demonstrate an episode; None where the demonstrator does not succeed.

    Args:
        looks: of the memories that will train on it; the front camera is drawn at these frames, and all at decisions.
        execute: motions of a chunk that are executed: only every so many decisions is a policy asked, and drawn.
    """
    from mme_vla.envs.drawing import Drawing
    from mme_vla.envs.recording.recorder import Recorder
    from mme_vla.envs.scene.placement import SceneError

    try:
        env = make_task(task, render=True, seed=seed, difficulty=difficulty)
    except SceneError:
        return None
    states: list[np.ndarray] = []
    waypoints: list[np.ndarray] = []
    scenes = Snapshots(env)
    texts: list[dict[str, Any]] = []

    def take(step: "RecordedStep") -> None:
        states.append(benchmark_state(step.obs["joint_state"], step.obs["gripper_state"]))
        waypoints.append(step.action["waypoint_action"])
        scenes.take()
        texts.append(step.info)

    try:
        result = Recorder(env, on_step=take, drawing=Drawing(now=())).record()
        if not result.success:
            return None
        motions = find_motions(np.stack(waypoints)[result.video :].astype(np.float32), result.video)
        decisions = [int(frame) for frame in motions.decisions]
        asked = decisions[::execute]
        front = {int(frame) for look in looks for step in asked for frame in look(step, result.video)}
        wanted = {camera: set(asked) | (front if camera == "front" else set()) for camera in cameras}
        pictures: dict[str, dict[int, np.ndarray]] = {camera: {} for camera in cameras}
        for frame in sorted(set().union(*wanted.values())):
            scenes.put_back(frame)
            for camera, picture in draw(env, [camera for camera in cameras if frame in wanted[camera]]):
                pictures[camera][frame] = picture
        return Demonstration(
            type(env).__name__, seed, difficulty, env.goals()[0].lower(), len(states), result.video, np.stack(states),
            motions, pictures, {kind: _shown(texts, kind, decisions) for kind in SUBGOALS},
        )  # fmt: skip
    finally:
        env.close()


def _shown(texts: Sequence[Mapping[str, Any]], kind: str, decisions: Sequence[int]) -> list[str]:
    """The subgoal at each decision; where the simulator names none, the last one stays."""
    found: list[str] = []
    for frame in decisions:
        found.append(online_subgoal(texts[frame], kind) or (found[-1] if found else ""))
    return found


def draw(env: "Task", cameras: Sequence[str]) -> list[tuple[str, Any]]:
    """The current picture of each of these cameras."""
    if not cameras:
        return []
    env.scene.update_render(update_sensors=True, update_human_render_cameras=False)
    taken = []
    for camera in cameras:
        sensor = env.scene.sensors[CAMERAS[camera]]
        sensor.capture()
        images = sensor.get_obs(rgb=True, depth=False, position=False, segmentation=False)
        taken.append((camera, np.ascontiguousarray(images["rgb"][0].cpu().numpy())))
    return taken
