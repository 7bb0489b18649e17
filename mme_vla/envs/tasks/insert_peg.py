"""InsertPeg (Imitation): the video grasps one end of a peg and inserts it from one side; do the same with that peg."""

import math
from typing import TYPE_CHECKING

import numpy as np
import sapien

from mme_vla.envs.base import MemoryTask
from mme_vla.envs.choices import Choice
from mme_vla.envs.draws import Draws
from mme_vla.envs.motions import Highlight, Mark, build_mark
from mme_vla.envs.objects import Peg, build_aperture_box, build_highlight, build_peg
from mme_vla.envs.objects.shapes import at
from mme_vla.envs.objects.solids import APERTURE_COLOUR, APERTURE_Z
from mme_vla.envs.placement import SceneError
from mme_vla.envs.predicates import StaticFor, reset_reached
from mme_vla.envs.subtasks import NO_RECORD, SubTask
from mme_vla.envs.tasks import register_task
from mme_vla.envs.things import Thing

if TYPE_CHECKING:
    from mme_vla.envs.demonstrator import Demonstrator

PEGS, PEG_LENGTH, PEG_RADIUS = 3, 0.05, 0.01
FROM_BOX, FROM_PEG = 0.06, 0.075
TRIES = 256
LIFTED_Z = 0.1
INSERTED = 0.05
SUCCESS_DELAY = 3  # steps from the insertion to success
SHOWN_STEPS = 20  # how long the box shows an insertion
HOLD_STEPS = 100
MARK = (0.015, 0.055)  # radius and half length of the disc on the box


@register_task
class InsertPeg(MemoryTask):
    """The first peg is the one; places are drawn per episode and the difficulty changes nothing."""

    shared_draws = True

    def build(self, draws: Draws) -> None:
        for _ in range(2):
            draws.uniform()  # part of the official stream, without effect
        head = tuple(draws.uniforms(3).tolist())
        tail = tuple(1 - c for c in head)
        draws.integer(0, 3)
        self.box = self.add(build_aperture_box(self, (0, 0), math.pi / 2))
        self.pegs = [
            self.add(build_peg(self, f"peg_{i}", PEG_LENGTH, PEG_RADIUS, head, tail, (0.2, 0.2 * (i - 1)), 0))
            for i in range(PEGS)
        ]
        self.peg = self.pegs[0]
        self._disc = build_highlight(self, "disc", *MARK, APERTURE_COLOUR)
        self._red_disc = build_mark(self, "disc_red", MARK[0] * 1.003, MARK[1] * 1.003)

    def start_episode(self, draws: Draws) -> None:
        x, y = (-0.1 + 0.2 * draws.uniform() for _ in range(2))
        self.box.set_home(at((x, y), APERTURE_Z, math.radians(90 - 20 + 40 * draws.uniform())))
        places: list[tuple[float, float]] = []
        for peg in self.pegs:
            places.append(self._draw_place(draws, (x, y), places))
            peg.set_home(at(places[-1], 0, math.radians(-45 + 90 * draws.uniform())))
        self.end = ("head", "tail")[draws.integer(0, 2)]
        self.side = (-1, 1)[draws.integer(0, 2)]
        below = self.box.position - [0, 0, Highlight.DEPTH]
        self._disc.move_to(sapien.Pose(below, self._disc.pose.q))
        self.mark = Mark(self._red_disc, below, SHOWN_STEPS)
        self._inserted_at: int | None = None
        self._restored = False

    def _draw_place(self, draws: Draws, box: tuple[float, float], others: list) -> tuple[float, float]:
        for _ in range(TRIES):
            place = (-0.2 + 0.4 * draws.uniform(), -0.3 + 0.6 * draws.uniform())
            if math.dist(place, box) > FROM_BOX and all(math.dist(place, other) > FROM_PEG for other in others):
                return place
        raise SceneError(f"InsertPeg, seed {self.seed}: a peg finds no place.")

    def after_step(self, k: int) -> None:
        self.mark.update(k, touched=False)
        if self.reset_in_progress and not self._restored:
            self._restored = True
            for peg in self.pegs:
                peg.restore()

    # Predicates ---------------------------------------------------------------------------------------------------

    def ends(self, end: str) -> tuple[Thing, Thing]:
        """The grasped end of the peg and the one that is inserted."""
        return (self.peg.head, self.peg.tail) if end == "head" else (self.peg.tail, self.peg.head)

    def _lifted(self, end: str) -> bool:
        grasped, other = self.ends(end)
        tcp = self.tcp_pose.p
        nearer = np.linalg.norm(grasped.position - tcp) < np.linalg.norm(other.position - tcp)
        return bool(grasped.position[2] > LIFTED_Z and nearer)

    def _inside(self, thing: Thing) -> bool:
        return float(np.linalg.norm(thing.position - self.box.position)) <= INSERTED

    def _inserted(self, end: str, side: int) -> bool:
        """The free end is in the box, the gripper on the given side of it."""
        grasped, free = self.ends(end)
        box = self.box.position
        nearer = np.linalg.norm(free.position - box) < np.linalg.norm(grasped.position - box)
        return self._inside(free) and bool(nearer) and (self.tcp_pose.p[1] - box[1]) * side < 0

    def _shown_inserted(self) -> bool:
        """The video's insertion has happened; the box shows it."""
        if not self._inserted(self.end, self.side):
            return False
        self.mark.update(self.steps_done, touched=True)
        return True

    def _inserted_for_good(self) -> bool:
        """The execution's insertion counts a few steps later."""
        if self._inserted_at is None and self._shown_inserted():
            self._inserted_at = self.steps_done
        return self._inserted_at is not None and self.steps_done >= self._inserted_at + SUCCESS_DELAY

    # Sub-tasks ----------------------------------------------------------------------------------------------------

    def subtasks(self) -> list[SubTask]:
        between = [
            SubTask(
                NO_RECORD,
                done=lambda: self.after_video and reset_reached(self, self.reset_action[:-1]),
                run=lambda demo: demo.hard_reset(),
                video=True,
            ),
            SubTask(NO_RECORD, StaticFor(self, HOLD_STEPS), lambda demo: demo.hold(HOLD_STEPS), video=True),
        ]
        return [*self._both(video=True), *between, *self._both(video=False)]

    def _both(self, video: bool) -> list[SubTask]:
        grasped, free = self.ends(self.end)
        side = "right" if self.side == 1 else "left"
        word = "near" if grasped.position[0] < free.position[0] else "far"  # from the robot's base
        wrong_end = "tail" if self.end == "head" else "head"
        of_box = " of the box" if video else ""
        others = self.pegs[1:]

        def wrong_grasp() -> bool:
            return self._lifted(wrong_end) or any(self._up(peg) for peg in others)

        def wrong_insertion() -> bool:
            wrong = self._inserted(wrong_end, 1) or self._inserted(wrong_end, -1)
            return wrong or self._inserted(self.end, -self.side)

        stop = None if video else lambda: self.progress.succeeded
        return [
            SubTask(
                f"Pick up the peg by grasping the {word} end",
                done=lambda: self._lifted(self.end),
                run=lambda demo: demo.grasp_peg(self.peg, self.end),
                grounded=f"Pick up the peg by grasping the {word} end at <>",
                failed=None if video else wrong_grasp,
                targets=[grasped],
                choice="a",
                video=video,
            ),
            SubTask(
                f"Insert the peg from the {side} side{of_box}",
                done=self._shown_inserted if video else self._inserted_for_good,
                run=lambda demo: demo.insert_peg(self.peg, self.end, self.side, self.box, until=stop),
                grounded=f"Insert the peg from the {side} side{of_box} at <>",
                failed=None if video else wrong_insertion,
                targets=[self.box],
                choice="b" if self.side == 1 else "c",
                video=video,
            ),
        ]

    @staticmethod
    def _up(peg: Peg) -> bool:
        return max(peg.head.position[2], peg.tail.position[2]) > LIFTED_Z

    # Choices ------------------------------------------------------------------------------------------------------

    def choices(self) -> list[Choice]:
        def every_end() -> list[Thing]:
            return [end for peg in self.pegs for end in (peg.head, peg.tail)]

        return [
            Choice("a", "pick up the peg by grasping one end", self._grasp, every_end),
            Choice("b", "insert the peg from the right side", lambda demo, _: self._insert(demo, 1)),
            Choice("c", "insert the peg from the left side", lambda demo, _: self._insert(demo, -1)),
        ]

    def _grasp(self, demo: "Demonstrator", thing: Thing | None) -> None:
        peg = next(peg for peg in self.pegs if thing in (peg.head, peg.tail))
        demo.grasp_peg(peg, "head" if thing is peg.head else "tail")

    def _insert(self, demo: "Demonstrator", side: int) -> None:
        """Insert whichever peg the gripper is at, by whichever end it holds."""
        tcp = self.tcp_pose.p
        ends = [(peg, end) for peg in self.pegs for end in ("head", "tail")]
        peg, end = min(ends, key=lambda e: float(np.linalg.norm(getattr(*e).position - tcp)))
        demo.insert_peg(peg, end, side, self.box, until=lambda: self.progress.succeeded)

    def goals(self) -> list[str]:
        goal = "watch the video carefully, then grasp the same"
        return [
            f"{goal} end of the same peg you've picked before and insert it into the same side of the box",
            f"{goal} peg at the same end and insert it into the same side of the box as in the video",
        ]
