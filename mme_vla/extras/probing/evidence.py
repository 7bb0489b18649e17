"""Demonstrations with the frames that show what their outcome depends on, as the simulator knows
them.

A task names the facts that a frame shows (`Task.evidence`): cubes that lie open, a swap, a
highlight, a visit that is counted, a key pose of the video.
"""

from collections.abc import Container, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from mme_vla.embodiment.robomme import benchmark_state
from mme_vla.envs.make import make_task
from mme_vla.envs.metadata import EpisodeSpec
from mme_vla.envs.observations import RenderRequest

if TYPE_CHECKING:
    from mme_vla.envs.robomme.recording.recorder import RecordedStep

KEY_POSE = 16
"""Frames after the end of a sub-task in which its result is visible, before the arm has left."""


@dataclass(frozen=True)
class EvidenceEpisode:
    """One demonstrated episode.

    length: frames. exec_start: the first execution frame. facts: name → frames that show it,
    ascending. boundaries: frames at which a sub-task begins. states: [length, 8] float32. images:
    frame → [256, 256, 3] uint8 of the front camera, for frames that were rendered.
    """

    task: str
    episode: int
    length: int
    exec_start: int
    facts: Mapping[str, np.ndarray]
    boundaries: np.ndarray
    states: np.ndarray
    images: Mapping[int, np.ndarray]


def record_evidence(
    spec: EpisodeSpec, rendered: Container[int] = frozenset()
) -> EvidenceEpisode | None:
    """Demonstrate an episode of a split; None where the scene cannot be built or the demonstrator
    does not succeed.

    rendered: frames whose image is wanted. Without any an episode takes about a second.
    """
    from mme_vla.envs.robomme.recording.recorder import Recorder
    from mme_vla.envs.robomme.scene.placement import SceneError

    render = rendered != frozenset()
    env = make_task(spec.task, render=render, **spec.options)
    ended: dict[int, int] = {}  # number of a sub-task → the first frame after its end
    facts: dict[str, list[int]] = {}
    boundaries: list[int] = []
    states: list[np.ndarray] = []
    images: dict[int, np.ndarray] = {}
    video = 0

    def take(step: "RecordedStep") -> None:
        nonlocal video
        frame, subtasks = len(states), env.progress.subtasks
        for i in range(len(ended), env.progress.index):
            ended[i] = frame
        in_video = step.info["is_video_demo"]  # the arm is elsewhere once the execution begins
        recent = {
            i: subtasks[i]
            for i, at in ended.items()
            if frame - at < KEY_POSE and subtasks[i].video <= in_video
        }
        for fact in env.evidence(recent):
            facts.setdefault(fact, []).append(frame)
        if step.info["is_subgoal_boundary"]:
            boundaries.append(frame)
        states.append(benchmark_state(step.obs["joint_state"], step.obs["gripper_state"]))
        if "front_rgb" in step.obs:
            images[frame] = step.obs["front_rgb"]
        video += in_video

    try:
        request = RenderRequest({"front": rendered}, now=(), grounded=False)
        result = Recorder(env, render, on_step=take, render_request=request).record()
    except SceneError:
        return None
    finally:
        env.close()
    if not result.success:
        return None
    named = {name: np.array(frames, np.int64) for name, frames in facts.items()}
    stacked = np.stack(states)
    return EvidenceEpisode(
        spec.task,
        spec.episode,
        len(states),
        video,
        named,
        np.array(boundaries, np.int64),
        stacked,
        images,
    )
