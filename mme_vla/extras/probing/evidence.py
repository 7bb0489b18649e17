"""Demonstrations with the frames that show what their outcome depends on, as the simulator knows
them.

Facts (`mme_vla.envs.facts`) are cubes that lie open, a swap, a highlight, a visit that is counted,
a key pose of the video.
"""

from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from mme_vla.embodiment.robomme import benchmark_state
from mme_vla.envs.facts import Fact, evidence_of
from mme_vla.envs.make import make_task
from mme_vla.envs.metadata import EpisodeSpec
from mme_vla.envs.observations import RenderRequest
from mme_vla.errors import SceneError

if TYPE_CHECKING:
    from mme_vla.envs.robomme.recording.recorder import RecordedStep


@dataclass(frozen=True)
class EvidenceEpisode:
    """One demonstrated episode.

    length: frames. exec_start: the first execution frame. facts: what frames show. boundaries:
    frames at which a sub-task begins. states: [length, 8] float32. images: frame →
    [256, 256, 3] uint8 of the front camera, for frames that were rendered.
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
        return evidence_of(self.facts)


def record_evidence(
    spec: EpisodeSpec, rendered: Container[int] = frozenset()
) -> EvidenceEpisode | None:
    """Demonstrate an episode of a split; None where the scene cannot be built or the demonstrator
    does not succeed.

    rendered: frames whose image is wanted. Without any an episode takes about a second.
    """
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
