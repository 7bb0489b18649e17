"""State that predictors keep of an episode: past subgoals, keyframes, and how long a subgoal is
held.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

from mme_vla.subgoal.text import Point

HOLD = {"ButtonUnmask": 90, "PickHighlight": 90}
_HOLD_BY_SUBGOAL = {
    "ButtonUnmaskSwap": {"press the first button": 100, "press the second button": 250}
}


@dataclass
class SubgoalHistory:
    """The subgoals so far, each once until another one comes.

    Replies with equal texts are the same, whatever their points; the first one's points are kept.
    """

    entries: list[str] = field(default_factory=list)
    points: list[Point] = field(default_factory=list)

    def add(self, entry: str, points: Sequence[Point] = ()) -> bool:
        """Note an answer (points as `<bbox>`) unless it repeats the last one; return whether it was
        noted.
        """
        if self.entries and self.entries[-1] == entry:
            return False
        self.entries.append(entry)
        self.points.extend(points)
        return True


def hold_until(task: str, last: str | None) -> int:
    """The last step up to which the last subgoal is kept without asking again; 0 for always asking.

    Released rules of the fine-tuned predictor for tasks whose first presses must not be cut short.

    Args:
        task: its name, such as `ButtonUnmask`. last: text of the last subgoal.
    """
    for words, step in _HOLD_BY_SUBGOAL.get(task, {}).items():
        if last is not None and words in last.lower():
            return step
    return HOLD.get(task, 0)


def merge_keyframes(frames: Sequence[int], distance: int = 8) -> list[int]:
    """Thin out keyframes: of each run with gaps of at most `distance`, the middle one (the later of
    two) stays.
    """
    groups: list[list[int]] = []
    for frame in sorted(set(frames)):
        if groups and frame - groups[-1][-1] <= distance:
            groups[-1].append(frame)
        else:
            groups.append([frame])
    return [group[len(group) // 2] for group in groups]


def recent_frames(newest: int, queried_before: bool, count: int = 8, stride: int = 2) -> list[int]:
    """Indices of MemER's recent frames: `count` of them, `stride` apart, ending at `newest`; one at
    the first call.

    Before the episode is long enough the list is shorter, never padded.
    """
    if not queried_before:
        return [newest]
    return [i for i in range(newest - (count - 1) * stride, newest + 1, stride) if i >= 0]
