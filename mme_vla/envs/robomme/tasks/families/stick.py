"""What the two tasks with a stick share: the video moves it from disc to disc, and the execution
does the same again.
"""

from abc import abstractmethod
from collections.abc import Sequence
from typing import ClassVar

from mme_vla.envs.facts import Candidates
from mme_vla.envs.robomme.scene.motions import Mark, Trace, build_mark
from mme_vla.envs.robomme.scene.objects import Disc
from mme_vla.envs.robomme.scene.placement import Draws
from mme_vla.envs.robomme.scene.predicates import over, reset_reached
from mme_vla.envs.robomme.scene.stage import RESET_QPOS
from mme_vla.envs.subtasks import NO_RECORD, SubTask
from mme_vla.envs.task import Task, candidates_among

MARK_RADIUS, MARK_STEPS = 0.02004, 40


class StickTask(Task):
    """The tip visits the discs of a path, in the video and then again."""

    stick = True
    visit: ClassVar[tuple[float, float]] = (0.01, 0.1)
    """A disc is visited by a tip that is not farther than the first distance from its middle, and
    lower than the second; metres.
    """
    home_steps: ClassVar[int] = 30
    """How long the arm is driven home after the video."""
    discs: list[Disc]
    """Those that can be visited."""
    path: list[Disc]
    """Those of the path, in order."""

    def add_marks(self) -> None:
        """Build what shows the visits and the way of the tip; after all other objects."""
        self._marks = [
            build_mark(self, f"mark_{i}", MARK_RADIUS, MARK_RADIUS) for i in range(len(self.discs))
        ]
        self._trace = Trace(self)

    @abstractmethod
    def moves(self, video: bool) -> list[SubTask]:
        """The sub-tasks from disc to disc along the path."""

    @abstractmethod
    def beside(self, here: Disc) -> Sequence[Disc]:
        """The discs to which a move can lead from one of them."""

    def visited_now(self, disc: Disc) -> bool:
        """Whether the tip is at a disc."""
        return over(self.tcp_pose.p, disc, *self.visit)

    def start_episode(self, draws: Draws) -> None:
        self.marks = [
            Mark(m, d.position, MARK_STEPS) for m, d in zip(self._marks, self.discs, strict=True)
        ]
        self._trace.restart()

    def after_step(self, k: int) -> None:
        for mark, disc in zip(self.marks, self.discs, strict=True):
            mark.update(k, self.visited_now(disc))
        self._trace.update(k)

    def candidates(self) -> Candidates | None:
        """The discs beside the one that the next move starts from."""
        subtask = self.progress.current
        if subtask is None or subtask.video:
            return None
        remaining = len(self.progress.to_come)  # the last sub-tasks are the execution's moves
        here, goal = self.path[-remaining - 1], self.path[-remaining]
        return candidates_among(self.beside(here), [goal])

    def subtasks(self) -> list[SubTask]:
        first = self.path[0]
        approach = SubTask(
            NO_RECORD,
            done=lambda: over(self.tcp_pose.p, first),
            run=lambda demo: demo.stick_to(first, store=True),
            video=True,
        )
        home = SubTask(
            NO_RECORD,
            done=lambda: self.after_video and reset_reached(self, RESET_QPOS),
            run=lambda demo: demo.hard_reset(self.home_steps),
            video=True,
        )
        back = SubTask(  # to where the approach ended
            NO_RECORD,
            done=lambda: self.stored_qpos is not None and reset_reached(self, self.stored_qpos),
            run=lambda demo: demo.hard_reset(qpos=self.stored_qpos),
            video=True,
        )
        return [approach, *self.moves(video=True), home, back, *self.moves(video=False)]
