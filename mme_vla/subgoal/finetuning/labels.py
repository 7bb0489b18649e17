"""Selects the steps of a demonstration that become training rows, and its keyframes.

The rules read an episode's labels and joint angles, and no images. They are those of the paper
(appendix: VLM subgoal prediction) and of the released builders.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

STRIDE = 16  # steps between two rows, as between two questions of a policy
_STRIDE = {"StopCube": 32}
_FIXED = {"PatternLock": 32}  # tasks whose rows follow the clock, not the changes of subgoal
_STILL = ("PatternLock", "RouteStick")  # tasks in which the arm comes to rest at what matters
_MIDPOINTS = {
    "PickHighlight": (1,),
    "ButtonUnmaskSwap": (2, 2),
}  # extra keyframes in the first segments
_AT_REST = 1e-3  # rad: distance of joints to their targets
_APART, _MERGE = 5, 10  # frames
FRAME_STEP, WINDOW = 2, 8  # MemER: every second frame, eight a row


@dataclass(frozen=True)
class Labels:
    """A demonstration without its images.

    task, number: its name and number.
    goal: in words, lower-case.
    exec_start: first execution frame.
    simple, grounded: [t] the planner's subgoals, lower-case.
    joints, targets: [t, 7] joint angles and the joint targets of the action of the same step.
    """

    task: str
    number: int
    goal: str
    exec_start: int
    simple: list[str]
    grounded: list[str]
    joints: np.ndarray
    targets: np.ndarray

    def __post_init__(self) -> None:
        # "complete" is no subgoal: the one before it stays.
        for texts in (self.simple, self.grounded):
            for t in range(1, len(texts)):
                if texts[t].strip().lower() == "complete":
                    texts[t] = texts[t - 1]

    @property
    def length(self) -> int:
        """Frames, video included."""
        return len(self.simple)

    @property
    def last(self) -> int:
        return self.length - 1

    def texts(self, kind: str) -> list[str]:
        """Return the subgoals of a kind, `simple` or `grounded`."""
        return {"simple": self.simple, "grounded": self.grounded}[kind]


def changes(labels: Labels) -> list[int]:
    """Return the execution frames at which the simple subgoal changes, the first included."""
    first = labels.exec_start
    later = range(first + 1, labels.length)
    return [first, *(t for t in later if labels.simple[t] != labels.simple[t - 1])]


def transitions(labels: Labels) -> list[int]:
    """Return the frames where segments of rows begin, and the last frame, which ends the last."""
    if labels.task in _FIXED:
        starts = list(range(labels.exec_start, labels.length, _FIXED[labels.task]))
    else:
        starts = changes(labels)
    return sorted({*starts, labels.last})


def selected_steps(
    labels: Labels, short_segments: bool = False
) -> tuple[list[int], dict[int, int]]:
    """Select the steps that become rows of the simple and grounded predictors.

    Args:
        short_segments: give a segment shorter than the stride one row, at its start. As released it
            has none, and its subgoal is also missing from the histories.

    Returns:
        The steps in order, and how often the row at a change of subgoal is repeated on top: once
        less than the segment before it has rows, so that changes weigh as much as what lies between
        them.
    """
    stride = _STRIDE.get(labels.task, STRIDE)
    steps = {labels.last}
    repeats = {}
    for start, stop in pairwise(transitions(labels)):
        count = (stop - start) // stride
        n_rows = max(count, 1) if short_segments else count
        steps.update(np.linspace(start, stop, n_rows, endpoint=False).astype(int).tolist())
        if stop != labels.last:
            repeats[stop] = max(count - 1, 0)
    return sorted(steps), repeats


def keyframes(labels: Labels, substring_match: bool = False) -> list[int]:
    """Return the keyframes that MemER learns to name.

    Args:
        substring_match: as released, where the rule of ButtonUnmaskSwap holds for ButtonUnmask too.
    """
    starts = changes(labels)
    frames = [t for t in starts if t != labels.last]

    # Frames inside the first segments of some tasks.
    task = labels.task
    if substring_match and task in "ButtonUnmaskSwap":
        task = "ButtonUnmaskSwap"
    segments = pairwise(sorted({*starts, labels.last}))
    for (start, stop), count in zip(segments, _MIDPOINTS.get(task, ()), strict=False):
        inside = np.linspace(start, stop, count + 2)[1:-1]
        frames += inside.astype(int).tolist()

    if labels.task not in _STILL:
        return sorted(set(frames))
    # Frames at which the arm rests. Those close together become their running midpoint.
    merged: list[int] = []
    for frame in sorted([*frames, *resting_frames(labels)]):
        if merged and frame - merged[-1] < _MERGE:
            merged[-1] = (merged[-1] + frame) // 2
        else:
            merged.append(frame)
    return merged


def resting_frames(labels: Labels) -> list[int]:
    """Return the execution frames at which the arm has reached its targets.

    They are minima of the distance of the joints to their targets, at least 5 frames apart.
    """
    distance = np.linalg.norm(labels.targets - labels.joints, axis=1)
    frames: list[int] = []
    for t in range(max(labels.exec_start, 1), labels.last):
        is_minimum = (
            distance[t] < _AT_REST
            and distance[t] < distance[t - 1]
            and distance[t] < distance[t + 1]
        )
        if is_minimum and (not frames or t - frames[-1] >= _APART):
            frames.append(t)
    return frames


@dataclass(frozen=True)
class Window:
    """One row of MemER.

    past: keyframes before it.
    frames: those since the row before.
    positions: of the keyframes in `frames`, from 1.
    """

    past: list[int]
    frames: list[int]
    positions: list[int]


def windows(labels: Labels, targets: Sequence[int], one_a_window: bool = False) -> list[Window]:
    """Cut an episode into MemER's rows.

    Every second frame is shown. A keyframe is matched by the first of them within one step of it,
    and belongs to the past after its window.

    Args:
        targets: the keyframes.
        one_a_window: as released, where a second keyframe in one window is missed, and with it all
            that follow.
    """
    rows: list[Window] = []
    waiting = list(targets)
    past: list[int] = []
    frames: list[int] = []
    positions: list[int] = []
    for i, t in enumerate(range(labels.exec_start, labels.length, FRAME_STEP)):
        frames.append(t)
        may_match = not positions or not one_a_window
        if may_match and waiting and abs(t - waiting[0]) <= 1:
            positions.append(len(frames))
            waiting.pop(0)
        if i % WINDOW == 0 or t >= labels.last - 1:
            rows.append(Window(past, frames, positions))
            past = [*past, *(frames[position - 1] for position in positions)]
            frames = []
            positions = []
    return rows
