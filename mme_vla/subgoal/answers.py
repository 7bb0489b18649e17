"""Rules of the fine-tuned predictors: past subgoals, how long a subgoal is kept, and keyframes."""

from collections.abc import Sequence
from dataclasses import dataclass, field

from mme_vla.subgoal.text import Point

HOLD = {"ButtonUnmask": 90, "PickHighlight": 90}
_HOLD_BY_SUBGOAL = {
    "ButtonUnmaskSwap": {"press the first button": 100, "press the second button": 250}
}


@dataclass
class SubgoalHistory:
    """The subgoals so far; a repetition of the last one is left out.

    Texts decide, not points. Of equal texts the first one's points are kept.

    entries: texts, points as `<bbox>`.
    points: of all entries in order, (row, column).
    """

    entries: list[str] = field(default_factory=list)
    points: list[Point] = field(default_factory=list)

    def add(self, entry: str, points: Sequence[Point] = ()) -> None:
        """Add a subgoal unless it repeats the last one."""
        if not self.entries or self.entries[-1] != entry:
            self.entries.append(entry)
            self.points.extend(points)


def hold_until(task: str, last: str | None) -> int:
    """Return the step up to which the last subgoal is kept without asking again; 0 for none.

    These are released rules, for tasks whose first presses must not be cut short.

    Args:
        task: its name, such as `ButtonUnmask`.
        last: text of the last subgoal.
    """
    if last is not None:
        for words, step in _HOLD_BY_SUBGOAL.get(task, {}).items():
            if words in last.lower():
                return step
    return HOLD.get(task, 0)


def merge_keyframes(frames: Sequence[int], distance: int = 8) -> list[int]:
    """Thin out keyframes: of a run with gaps of at most `distance` frames the middle one stays.

    Of an even number it is the later one of the two in the middle.
    """
    groups: list[list[int]] = []
    for frame in sorted(set(frames)):
        if groups and frame - groups[-1][-1] <= distance:
            groups[-1].append(frame)
        else:
            groups.append([frame])
    return [group[len(group) // 2] for group in groups]


def recent_frames(newest: int, queried_before: bool, count: int = 8, stride: int = 2) -> list[int]:
    """Return the numbers of MemER's recent frames, the newest one alone for the first question.

    They are `count` frames, `stride` apart. Early in an episode the list is shorter, not padded.
    """
    if not queried_before:
        return [newest]
    first = newest - (count - 1) * stride
    return [frame for frame in range(first, newest + 1, stride) if frame >= 0]
