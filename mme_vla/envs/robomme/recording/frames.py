"""Which frames of a demonstration are rendered: those of decisions, and those that a memory reads
there.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

import mme_vla.memory  # noqa: F401  (registers what ships)
from mme_vla.data.waypoints import (
    CHOICE_NUMBERS,
    Motions,
    find_motions,
    known_poses,
    row_of,
)
from mme_vla.embodiment.robomme import CAMERAS, LETTERS
from mme_vla.envs.episodes import spans
from mme_vla.envs.observations import RenderRequest
from mme_vla.errors import require
from mme_vla.registry import MEMORIES

if TYPE_CHECKING:
    from mme_vla.envs.robomme.recording.recorder import RecordedStep
    from mme_vla.memory.base import Memory

DECISIONS = "decisions"
CHOICES = "choices"
GRAMMAR = (
    "decisions, choices, a number n for every n-th frame of the execution, or numbers and ranges"
    " such as [0-9,40]"
)
MEMORY_CAMERA = "front"
_SOME_WIDTH = 64  # which frames a memory reads does not depend on the width of its tokens


@dataclass(frozen=True)
class FrameChoice:
    """The rendered frames of every demonstration; all other steps have no images.

    at: the frames that both cameras show. `decisions`: the last frame before each planned motion of
        the execution, where a waypoint policy acts; `choices`: the last frame before each part of
        it, where one acts that chooses among options; n: the execution's first frame and every n-th
        after it; or numbers and ranges, counted from the episode's first stored frame.
    memory: a section of a memory; the front camera also shows what this memory may read at those
        frames, and so does the other where the memory gives a backbone past views.
    every: stride over the decisions, for a policy that executes several motions of a chunk.
    """

    at: str | int | Sequence[int | str]
    memory: Mapping[str, Any] | None = None
    every: int = 1

    def __post_init__(self) -> None:
        is_choice = not isinstance(self.at, bool) and (not isinstance(self.at, int) or self.at >= 1)
        require(is_choice, f"frames={self.at!r} is not understood; write all, {GRAMMAR}.")
        if self.at not in (DECISIONS, CHOICES) and not isinstance(self.at, int):
            spans(self.at, "frames", f"all, {GRAMMAR}")
        if self.memory is not None:
            _build(self.memory)

    def render_request(self, steps: Sequence["RecordedStep"]) -> RenderRequest:
        """The request for a demonstration whose steps are known from a recording without images."""
        video = _video(steps)
        numbers = self._frame_numbers(steps, video)
        frames = {camera: frozenset(numbers) for camera in CAMERAS}
        if self.memory is not None:
            read = self.read(np.array(numbers, np.int64), video)
            reads_all_views = _build(self.memory).past_view_spec is not None
            for camera in CAMERAS:
                if camera == MEMORY_CAMERA or reads_all_views:
                    frames[camera] |= read
        return RenderRequest(frames, now=())

    def read(self, frames: np.ndarray, exec_start: int) -> frozenset[int]:
        """What the memory may read at these frames [n]; the execution begins at `exec_start`."""
        if self.memory is None:
            return frozenset()
        return frozenset(_build(self.memory).frames_read(frames, exec_start).tolist())

    def to_dict(self) -> dict[str, Any]:
        """Plain values, fit for JSON."""
        return {
            "at": self.at if isinstance(self.at, str | int) else list(self.at),
            "memory": self.memory,
        }

    def _frame_numbers(self, steps: Sequence["RecordedStep"], video: int) -> list[int]:
        numbers: list[int] = []
        if isinstance(self.at, int):
            numbers += range(video, len(steps), self.at)
        elif self.at == DECISIONS:
            numbers += motions_of(steps).decisions[:: self.every].tolist()
        elif self.at == CHOICES:
            numbers += choices_of(steps).decisions.tolist()
        else:
            for span in spans(self.at, "frames", GRAMMAR):
                numbers += [number for number in span if number < len(steps)]
        return numbers


def motions_of(steps: Sequence["RecordedStep"]) -> Motions:
    """The planned motions of a demonstration's execution."""
    video = _video(steps)
    noted = np.stack([step.action["waypoint_action"] for step in steps])
    poses = known_poses(noted, video, lambda k: steps[k].action["eef_action"])
    return find_motions(poses[video:], video)


def choices_of(steps: Sequence["RecordedStep"]) -> Motions:
    """The choices among the task's options that a demonstration's execution is made of."""
    video = _video(steps)
    rows = np.zeros((len(steps), len(CHOICE_NUMBERS)), np.float32)
    for k, step in enumerate(steps):
        begins = step.info["is_subgoal_boundary"] and not step.info["is_completed"]
        if begins or k == video:
            row = row_of(step.action["choice_action"])
            if row is not None:
                rows[k] = row
    return find_motions(rows[video:], video, range(len(LETTERS)))


def _video(steps: Sequence["RecordedStep"]) -> int:
    return sum(step.info["is_video_demo"] for step in steps)


def _build(section: Mapping[str, Any]) -> "Memory":
    memory: Memory = MEMORIES.build(section, d_vision=_SOME_WIDTH, width=_SOME_WIDTH)
    return memory
