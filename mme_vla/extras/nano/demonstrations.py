"""Demonstrations rendered only at their decisions, and at the frames that memories read there.

An episode of planned motions has a handful of decisions, known when it is over. The poses of every
frame are kept; then the required frames are restored and rendered. That takes a second where
rendering all takes ten.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mme_vla.data.waypoints import Motions
from mme_vla.embodiment.action_space import read_options
from mme_vla.embodiment.robomme import CAMERAS, benchmark_action, benchmark_state
from mme_vla.envs.facts import Fact, read_facts
from mme_vla.envs.make import make_task
from mme_vla.envs.observations import RenderRequest, capture, read_images
from mme_vla.envs.robomme.recording.frames import FrameChoice, choices_of, motions_of
from mme_vla.errors import SceneError, require
from mme_vla.subgoal.oracle import online_subgoal
from mme_vla.utils import parse_json, write_atomically

if TYPE_CHECKING:
    from mme_vla.embodiment.action_space import ActionSpace
    from mme_vla.envs.robomme.recording.recorder import RecordedStep
    from mme_vla.envs.task import Task


SUBGOALS = ("simple", "grounded")


@dataclass(frozen=True)
class Demonstration:
    """One episode of a task, with images of some frames.

    length: frames.
    exec_start: the first execution frame.
    states: [length, 8] float32.
    motions: its decisions.
    images: camera → frame → [256, 256, 3] uint8.
    boundaries: frames at which a sub-task begins, of the video too.
    subgoals: `simple` and `grounded` → what the simulator says at each decision, as it says it at
        test time.
    carried_out: whether its motions were carried out one by one, see `record`.
    facts: what its frames show; None in files of earlier versions.
    """

    task: str
    seed: int
    difficulty: str
    goal: str
    length: int
    exec_start: int
    states: np.ndarray
    motions: Motions
    images: dict[str, dict[int, np.ndarray]]
    boundaries: np.ndarray
    subgoals: dict[str, list[str]] = field(default_factory=dict)
    carried_out: bool = False
    facts: Sequence[Fact] | None = None

    def save(self, path: Path) -> None:
        """Write it as one file, which appears whole or not at all."""
        names = (
            "task",
            "seed",
            "difficulty",
            "goal",
            "length",
            "exec_start",
            "subgoals",
            "carried_out",
        )
        about = {name: getattr(self, name) for name in names}
        if self.facts is not None:
            about["facts"] = [fact.to_dict() for fact in self.facts]
        arrays = {
            "states": self.states,
            "decisions": self.motions.decisions,
            "targets": self.motions.targets,
            "boundaries": self.boundaries,
        }
        for camera, taken in self.images.items():
            arrays[f"{camera}_frames"] = np.array(list(taken), np.int64)
            arrays[f"{camera}_pictures"] = np.stack(list(taken.values()))
        with write_atomically(path) as draft, draft.open("wb") as file:
            np.savez_compressed(file, about=np.array(json.dumps(about)), **arrays)  # type: ignore[arg-type]

    @classmethod
    def load(cls, path: Path, images: bool = True) -> "Demonstration":
        """Read what `save` wrote, or what of it is no image.

        Raises:
            UserError: an earlier version wrote it.
        """
        with np.load(path) as file:
            about = _about(path, file)
            loaded_images: dict[str, dict[int, np.ndarray]] = {}
            for camera in CAMERAS:
                if images and f"{camera}_frames" in file:
                    frames = file[f"{camera}_frames"].tolist()
                    of_camera = file[f"{camera}_pictures"]
                    loaded_images[camera] = dict(zip(frames, of_camera, strict=True))
            return cls(
                **about,
                states=file["states"],
                motions=Motions(file["decisions"], file["targets"]),
                images=loaded_images,
                boundaries=file["boundaries"],
            )


def _about(path: Path, file: Any) -> dict[str, Any]:
    """The content of an open file of a demonstration beside its arrays."""
    about: dict[str, Any] = parse_json(str(file["about"]), str(path))
    require(
        "carried_out" in about and "boundaries" in file,
        f"{path} is of an earlier version: remove it and record it again.",
    )
    if "facts" in about:
        about["facts"] = read_facts(about["facts"], str(path))
    return about


@dataclass(frozen=True)
class Scene:
    """A scene to demonstrate, and the folder of what comes of it.

    cameras: those that render.
    choices: at which frames, for each memory that will train on it.
    carried_out, acts: see `record`.
    """

    task: str
    seed: int
    difficulty: str
    folder: Path
    cameras: tuple[str, ...]
    choices: tuple[FrameChoice, ...]
    carried_out: bool = False
    acts: "ActionSpace | None" = None

    @property
    def path(self) -> Path:
        """The demonstration's file."""
        return self.folder / f"{self.difficulty}-{self.seed}.npz"

    @property
    def failed(self) -> Path:
        """A file that is there where the demonstrator did not succeed."""
        return self.path.with_suffix(".failed")

    @property
    def made(self) -> bool:
        """Whether its demonstration is there; one that failed later, for other frames, does not
        count.
        """
        return self.path.is_file() and not self.failed.is_file()

    @property
    def tried(self) -> bool:
        """Whether there is nothing left to do: it failed, or is there with every required frame.

        Raises:
            UserError: its file is of other actions, or of motions that were not carried out alike.
        """
        if not self.made:
            return self.failed.is_file()
        with np.load(self.path) as file:
            about = _about(self.path, file)
            carried_out = about["carried_out"]
            width = file["targets"].shape[1]
            required = width if self.acts is None else self.acts.width
            require(
                (carried_out, width) == (self.carried_out, required),
                f"{self.path} holds actions of {width} numbers with carried_out={carried_out}, and"
                f" this command records {required} with carried_out={self.carried_out}: choose"
                " another output.",
            )
            required_frames = frames_required(
                file["decisions"], about["exec_start"], self.choices, self.cameras
            )
            for camera, frames in required_frames.items():
                rendered = file.get(f"{camera}_frames", np.zeros(0, np.int64))
                if not frames <= set(rendered.tolist()):
                    return False
            return True


def frames_required(
    decisions: np.ndarray,
    exec_start: int,
    choices: Sequence[FrameChoice],
    cameras: Sequence[str],
) -> dict[str, set[int]]:
    """Camera → the frames to render: those of the decisions, and at the front all that the memories
    read there.

    decisions: frames [m] at which a motion begins.
    exec_start: number of frames of the video.
    choices: what the memories read; without one all decisions count.
    """
    decided: set[int] = set()
    read: set[int] = set()
    for choice in choices:
        frames = decisions[:: choice.every]
        decided.update(frames.tolist())
        read.update(choice.read(frames, exec_start))
    if not choices:
        decided.update(decisions.tolist())
    required = dict.fromkeys(cameras, decided)
    if "front" in required:
        required["front"] = decided | read
    return required


def demonstrated(scene: Scene) -> bool:
    """Demonstrate a scene into its file; whether the demonstrator succeeded."""
    made = record(
        scene.task,
        scene.seed,
        scene.difficulty,
        scene.choices,
        scene.cameras,
        scene.carried_out,
        scene.acts,
    )
    if made is None:
        scene.failed.touch()
        return False
    made.save(scene.path)
    return True


def record(
    task: str,
    seed: int,
    difficulty: str,
    choices: Sequence[FrameChoice],
    cameras: Sequence[str] = ("front", "wrist"),
    carried_out: bool = False,
    acts: "ActionSpace | None" = None,
) -> Demonstration | None:
    """Demonstrate an episode; None where the demonstrator does not succeed.

    Args:
        choices: what the memories that will train on it read; these cameras render the frames of
            all of them.
        carried_out: render the frames while the demonstration's motions are carried out one by one,
            as a policy's are; None too where that does not succeed. The demonstrator makes more
            steps between some of its motions.
        acts: of the robot that will learn from it. Where it chooses among options, the choices
            stand in place of motions, and the options behind the goal; None: motions.
    """
    try:
        env = make_task(task, render=True, seed=seed, difficulty=difficulty)
    except SceneError:
        return None
    taken = _Taken(env)
    try:
        chooser = acts if acts is not None and acts.choice else None
        motions = _demonstrate(taken, choosing=chooser is not None)
        if carried_out and motions is not None:
            env.close()
            env = make_task(task, render=True, seed=seed, difficulty=difficulty)
            taken = _Taken(env)
            motions = _carry_out(taken, motions.targets, chooser)
        if motions is None:
            return None
        required = frames_required(motions.decisions, taken.video, choices, cameras)
        images: dict[str, dict[int, np.ndarray]] = {camera: {} for camera in cameras}
        for frame in sorted(set().union(*required.values())):
            taken.put_back(frame)
            rendered = [camera for camera in cameras if frame in required[camera]]
            capture(env, rendered)
            for camera in rendered:
                images[camera][frame] = read_images(env, camera, rgb=True)["rgb"]
        goal = env.goals()[0].lower()
        if chooser is not None:
            options = [choice.option.to_dict() for choice in env.choices()]
            goal = chooser.worded(goal, read_options(options, len(chooser.choice)))
        subgoals = {kind: _subgoal_texts(taken.texts, motions.decisions, kind) for kind in SUBGOALS}
        return Demonstration(
            type(env).__name__,
            seed,
            difficulty,
            goal,
            len(taken.states),
            taken.video,
            np.stack(taken.states),
            motions,
            images,
            _boundaries(taken.texts),
            subgoals,
            carried_out,
            taken.facts,
        )
    finally:
        env.close()


class _Taken:
    """What is noted of every frame of an episode; `video` of them come before its execution.

    A snapshot of the scene is read from the simulator's own objects, without velocities: that takes
    a tenth of what `get_state_dict` takes, and brings back marks and traces, which belong to no
    thing of the task.
    """

    def __init__(self, env: "Task") -> None:
        self.env = env
        self.video = 0
        self.facts: Sequence[Fact] = ()
        self.states: list[np.ndarray] = []
        self.texts: list[Mapping[str, Any]] = []
        self._snapshots: list[tuple[list[Any], list[float], list[tuple[Any, Any]]]] = []

    def add(self, observed: Mapping[str, Any], info: Mapping[str, Any], in_video: bool) -> None:
        if not self._snapshots:
            from sapien.render import RenderBodyComponent

            # The objects of the scene as its episode begins
            scene = self.env.scene
            self._entities = []
            self._bodies = []
            for actor in scene.actors.values():
                if actor.px_body_type == "static":
                    continue
                entity = actor._objs[0]
                self._entities.append(entity)
                body = entity.find_component_by_type(RenderBodyComponent)
                if body is not None:
                    self._bodies.append(body)
            self._articulations = [each._objs[0] for each in scene.articulations.values()]
        self.texts.append(info)
        self.states.append(benchmark_state(observed["joint_state"], observed["gripper_state"]))
        self.video += in_video
        poses = [entity.pose for entity in self._entities]
        visibilities = [body.visibility for body in self._bodies]
        joints = [(each.root_pose, each.qpos) for each in self._articulations]
        self._snapshots.append((poses, visibilities, joints))

    def put_back(self, frame: int) -> None:
        """Make the scene stand as it did in a frame."""
        poses, visibilities, joints = self._snapshots[frame]
        for entity, pose in zip(self._entities, poses, strict=True):
            entity.pose = pose
        for body, visibility in zip(self._bodies, visibilities, strict=True):
            body.visibility = visibility
        for each, (root, qpos) in zip(self._articulations, joints, strict=True):
            each.root_pose = root
            each.qpos = qpos


def _demonstrate(taken: _Taken, choosing: bool) -> Motions | None:
    """The motions of a demonstration, or its choices, if it succeeds."""
    from mme_vla.envs.robomme.recording.recorder import Recorder

    steps: list[RecordedStep] = []

    def take(step: "RecordedStep") -> None:
        steps.append(step)
        taken.add(step.obs, step.info, step.info["is_video_demo"])

    result = Recorder(taken.env, on_step=take, render_request=RenderRequest(now=())).record()
    if not result.success:
        return None
    taken.facts = result.facts
    return choices_of(steps) if choosing else motions_of(steps)


def _carry_out(taken: _Taken, targets: np.ndarray, chooser: "ActionSpace | None") -> Motions | None:
    """Carry out motions [m, 7], or choices [m, 10], from the start to success; those it took, None
    if it fails.
    """
    from mme_vla.envs.interface import RoboMMEEnv

    action_space = "waypoint" if chooser is None else "multi_choice"
    env = RoboMMEEnv(taken.env, action_space)
    env.render_request = RenderRequest(now=())
    env.on_frame = taken.add
    env.reset()
    decisions = []
    for number, target in enumerate(targets, 1):
        decisions.append(len(taken.states) - 1)
        action = target if chooser is None else benchmark_action(chooser, target)
        _, _, ended, _, info = env.step(action)
        if not ended:
            continue
        if info["status"] != "success":
            return None
        taken.facts = env.facts
        return Motions(np.array(decisions, np.int64), targets[:number])
    return None


def _subgoal_texts(
    texts: Sequence[Mapping[str, Any]], decisions: np.ndarray, kind: str
) -> list[str]:
    """The subgoal at each decision; where the simulator names none, the last one stays.

    At the frame that ends a video the simulator may name none yet. The next one stands there, which
    an environment reports after its reset.
    """
    named = [online_subgoal(text, kind) for text in texts]
    result: list[str] = []
    for frame in decisions:
        if named[frame]:
            result.append(named[frame])
        elif result:
            result.append(result[-1])
        else:
            result.append(next(filter(None, named[frame:]), ""))
    return result


def _boundaries(texts: Sequence[Mapping[str, Any]]) -> np.ndarray:
    """Frames at which a sub-task begins: where the recorded subgoal changes, as in
    `data.columns`.
    """
    subgoals = [text.get("simple_subgoal", text.get("simple_subgoal_online")) for text in texts]
    frames = [0]
    for frame in range(1, len(subgoals)):
        if subgoals[frame] != subgoals[frame - 1]:
            frames.append(frame)
    return np.array(frames, np.int64)
