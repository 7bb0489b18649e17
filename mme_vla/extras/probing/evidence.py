"""Demonstrations with the frames that show what their outcome depends on, as the simulator knows
them.

Facts (`mme_vla.envs.facts`) are cubes that lie open, a swap, a highlight, a visit that is counted,
a key pose of the video.
"""

from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from mme_vla.embodiment import Embodiment
from mme_vla.embodiment.robomme import benchmark_state
from mme_vla.envs.base import Environment, environment
from mme_vla.envs.facts import Fact
from mme_vla.envs.make import make_task
from mme_vla.envs.metadata import EpisodeSpec
from mme_vla.envs.observations import RenderRequest
from mme_vla.errors import SceneError, require

if TYPE_CHECKING:
    from mme_vla.envs.robomme.recording.recorder import RecordedStep


@dataclass(frozen=True)
class EvidenceEpisode:
    """One demonstrated episode.

    length: frames.
    exec_start: the first execution frame.
    facts: what frames show.
    boundaries: frames at which a sub-task begins; of an environment that is not RoboMME, the
        execution.
    states: [length, s] float32.
    images: frame → [H, W, 3] uint8 of the camera that memories see, for frames that were rendered.
    """

    task: str
    episode: int
    length: int
    exec_start: int
    facts: Sequence[Fact]
    boundaries: np.ndarray
    states: np.ndarray
    images: Mapping[int, np.ndarray]

    @property
    def evidence(self) -> dict[str, np.ndarray]:
        """Name of each fact → the frames that show it, ascending."""
        frames: dict[str, np.ndarray] = {}
        for fact in self.facts:
            first, last = fact.frames
            span = np.arange(first, last + 1, dtype=np.int64)
            frames[fact.name] = np.union1d(frames.get(fact.name, span), span)
        return frames


def record_evidence(
    spec: EpisodeSpec, rendered: Container[int] = frozenset(), env: str = "mme_vla"
) -> EvidenceEpisode | None:
    """Demonstrate an episode of a split; None where the scene cannot be built or the demonstrator
    does not succeed.

    Args:
        rendered: frames whose image is wanted. Without any an episode takes about a second.
        env: the environment that has the episode.
    """
    if env == "mme_vla":
        return _record_robomme(spec, rendered)
    return _record_demonstration(environment(env), spec, rendered)


def _record_demonstration(
    source: Environment, spec: EpisodeSpec, rendered: Container[int]
) -> EvidenceEpisode | None:
    """An episode that the `demonstrate` of its environment acts out."""
    require(
        source.embodiment is not None,
        f"{type(source).__name__} names no embodiment, which says what camera memories see.",
    )
    camera = Embodiment.from_dict(source.embodiment).memory_camera
    render = rendered != frozenset()
    env = source.open(spec.task, spec.split, spec.episode, render=render)
    env.render_request = RenderRequest({camera: rendered}, now=(), grounded=False)
    states: list[np.ndarray] = []
    images: dict[int, np.ndarray] = {}
    video = 0
    try:
        for frame, _, in_video in env.demonstration():
            if len(states) in rendered:  # without any, the environment may give no images at all
                images[len(states)] = frame[camera]
            states.append(np.asarray(frame["state"], np.float32))
            video += in_video
        all_facts = env.facts
        success = env.success
    finally:
        env.close()
    if not success:
        return None

    # No policy sees the frame after the last action.
    length = len(states)
    facts = []
    for fact in all_facts:
        first, last = fact.frames
        needed = tuple(frame for frame in fact.needed if frame < length)
        if first < length:
            facts.append(replace(fact, frames=(first, min(last, length - 1)), needed=needed))
    boundaries = np.array([video], np.int64)
    return EvidenceEpisode(
        spec.task, spec.episode, length, video, facts, boundaries, np.stack(states), images
    )


def _record_robomme(spec: EpisodeSpec, rendered: Container[int]) -> EvidenceEpisode | None:
    """An episode of RoboMME, by the script of its task."""
    from mme_vla.envs.robomme.recording.recorder import Recorder

    render = rendered != frozenset()
    env = make_task(spec.task, render=render, **spec.options)
    boundaries: list[int] = []
    states: list[np.ndarray] = []
    images: dict[int, np.ndarray] = {}
    video = 0

    def take(step: "RecordedStep") -> None:
        nonlocal video
        frame = len(states)
        if step.info["is_subgoal_boundary"]:
            boundaries.append(frame)
        states.append(benchmark_state(step.obs["joint_state"], step.obs["gripper_state"]))
        if "front_rgb" in step.obs:
            images[frame] = step.obs["front_rgb"]
        video += step.info["is_video_demo"]

    try:
        request = RenderRequest({"front": rendered}, now=(), grounded=False)
        result = Recorder(env, render, on_step=take, render_request=request).record()
    except SceneError:
        return None
    finally:
        env.close()
    if not result.success:
        return None
    stacked = np.stack(states)
    return EvidenceEpisode(
        spec.task,
        spec.episode,
        len(states),
        video,
        result.facts,
        np.array(boundaries, np.int64),
        stacked,
        images,
    )
