"""Which steps of a demonstration become training rows of the subgoal predictors, and which frames
are keyframes.

Everything here is arithmetic on an episode's labels and joint angles; images are not looked at
(paper, appendix: VLM subgoal prediction, and the released builders).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

STRIDE = 16  # steps a row means, as often as a policy asks
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
    """What is known of a demonstration without its images.

    task, number: its name and number; goal: in words, lower-case.
    exec_start: first execution frame. simple, grounded: [t] the planner's subgoals, lower-case.
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
        for texts in (self.simple, self.grounded):
            for t, text in enumerate(texts):  # "complete" is no subgoal: the one before it stays
                if t and text.strip().lower() == "complete":
                    texts[t] = texts[t - 1]

    @property
    def length(self) -> int:
        """Frames, video included."""
        return len(self.simple)

    @property
    def last(self) -> int:
        return self.length - 1

    def texts(self, kind: str) -> list[str]:
        """The subgoals of a kind, `simple` or `grounded`."""
        return {"simple": self.simple, "grounded": self.grounded}[kind]


def changes(labels: Labels) -> list[int]:
    """Execution frames at which the simple subgoal changes, the first included."""
    steps = range(labels.exec_start, labels.length)
    return [t for t in steps if t == labels.exec_start or labels.simple[t] != labels.simple[t - 1]]


def transitions(labels: Labels) -> list[int]:
    """Where one segment of rows ends and the next begins; the last frame closes the last one."""
    fixed = _FIXED.get(labels.task)
    starts = (
        changes(labels) if fixed is None else list(range(labels.exec_start, labels.length, fixed))
    )
    return sorted({*starts, labels.last})


def selected_steps(
    labels: Labels, short_segments: bool = False
) -> tuple[list[int], dict[int, int]]:
    """Steps that become rows of the simple and grounded predictors.

    Args:
        short_segments: give a segment shorter than the stride one row, at its start. As released it
            has none, and its subgoal is also missing from the histories.

    Returns:
        The steps in order, and how often the row at a change of subgoal is repeated on top: once
        less than the segment before it has rows, so that changes weigh as much as what lies between
        them.
    """
    stride, bounds = _STRIDE.get(labels.task, STRIDE), transitions(labels)
    steps, repeats = {labels.last}, {}
    for start, stop in pairwise(bounds):
        count = (stop - start) // stride
        steps.update(
            np.linspace(start, stop, count or int(short_segments), endpoint=False)
            .astype(int)
            .tolist()
        )
        if stop != labels.last:
            repeats[stop] = max(count - 1, 0)
    return sorted(steps), repeats


def keyframes(labels: Labels, substring_match: bool = False) -> list[int]:
    """Frames MemER is taught to remember.

    Args:
        substring_match: as released, where the rule of ButtonUnmaskSwap also takes in ButtonUnmask.
    """
    starts = changes(labels)
    frames = [t for t in starts if t != labels.last]
    bounds = sorted({*starts, labels.last})
    task = (
        "ButtonUnmaskSwap" if substring_match and labels.task in "ButtonUnmaskSwap" else labels.task
    )
    for segment, count in enumerate(_MIDPOINTS.get(task, ())):
        if segment + 1 < len(bounds):
            frames += (
                np.linspace(bounds[segment], bounds[segment + 1], count + 2)[1:-1]
                .astype(int)
                .tolist()
            )
    if labels.task in _STILL:
        merged: list[int] = []
        for frame in sorted(
            [*frames, *resting_frames(labels)]
        ):  # the running midpoint of those closer than 10
            if merged and frame - merged[-1] < _MERGE:
                merged[-1] = (merged[-1] + frame) // 2
            else:
                merged.append(frame)
        return merged
    return sorted(set(frames))


def resting_frames(labels: Labels) -> list[int]:
    """Execution frames at which the arm has reached its targets: minima of the distance, at least 5
    frames apart.
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
    """One row of MemER: keyframes before it, the frames since the row before, and which of these
    are keyframes.
    """

    past: list[int]
    frames: list[int]
    positions: list[int]  # from 1


def windows(labels: Labels, targets: Sequence[int], one_a_window: bool = False) -> list[Window]:
    """Cut an episode into MemER's rows.

    A keyframe is found at the first looked-at frame within one step of it, and joins the past after
    its window.

    Args:
        targets: the keyframes.
        one_a_window: as released, where a second keyframe in one window is missed, and with it all
            that follow.
    """
    query_steps = range(labels.exec_start, labels.length, FRAME_STEP)
    rows: list[Window] = []
    waiting, past = list(targets), list[int]()
    frames, matches = list[int](), list[int]()
    for i, t in enumerate(query_steps):
        frames.append(t)
        if waiting and abs(t - waiting[0]) <= 1 and not (one_a_window and matches):
            matches.append(t)
            waiting.pop(0)
        if i % WINDOW == 0 or t >= labels.last - 1:
            rows.append(Window(list(past), frames, [frames.index(f) + 1 for f in matches]))
            past, frames, matches = past + matches, [], []
    return rows
