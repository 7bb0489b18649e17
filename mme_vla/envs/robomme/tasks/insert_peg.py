"""InsertPeg (Imitation): the video grasps one end of a peg and inserts it from one side; do the
same with that peg.
"""

import math
from collections.abc import Callable
from contextlib import suppress
from typing import TYPE_CHECKING

import numpy as np
import sapien

from mme_vla.envs.robomme.robot.control import PlanningError
from mme_vla.envs.robomme.robot.demonstrator import PegEnd
from mme_vla.envs.robomme.robot.robots import ROBOT_BASE
from mme_vla.envs.robomme.scene.articulated import build_peg
from mme_vla.envs.robomme.scene.motions import Cue, Highlight, Mark, build_mark, on_table
from mme_vla.envs.robomme.scene.objects import (
    APERTURE_COLOUR,
    APERTURE_Z,
    at,
    build_aperture_box,
    build_highlight,
)
from mme_vla.envs.robomme.scene.placement import Draws, SceneError
from mme_vla.envs.robomme.scene.predicates import StaticFor, any_picked_up
from mme_vla.envs.robomme.scene.things import Thing, distance_xy
from mme_vla.envs.robomme.tasks import register_task
from mme_vla.envs.robomme.tasks.families.stages import end_video
from mme_vla.envs.subtasks import NO_RECORD, Choice, SubTask
from mme_vla.envs.task import Task

if TYPE_CHECKING:
    from mme_vla.envs.robomme.robot.demonstrator import Demonstrator

PEGS, PEG_LENGTH, PEG_RADIUS = 3, 0.05, 0.01
FROM_BOX, FROM_PEG = 0.06, 0.075
TRIES = 256
ENDS: tuple[PegEnd, PegEnd] = ("head", "tail")
LIFTED_Z = 0.1
INSERTED = 0.05
DISPLAY_STEPS = 20  # how long the box shows an insertion
HOLD_STEPS = 100
OPEN_FROM_BOX, OPEN_FROM_PEG = 0.18, 0.13
"""Free distance that the hand needs around a peg: to the box, to other pegs; metres."""
# cosine between the way from a near box and the way a peg may be pulled: a little past sideways
SIDEWAYS = -0.4
WORKSPACE = (0.4, 0.72)  # nearest and farthest from the robot's base that a peg is moved to, metres
FLUNG = 0.05  # from its place in one step, metres
MARK = (0.015, 0.055)  # radius and half length of the disc on the box


@register_task
class InsertPeg(Task):
    """The first peg is the target; positions are sampled per episode, and the difficulty has no
    effect.
    """

    shared_draws = True

    def build(self, draws: Draws) -> None:
        for _ in range(2):
            draws.uniform()  # part of the official stream, without effect
        head = self.values.colour("objects.head_rgb", lambda: draws.uniforms(3).tolist())
        tail = (1 - head[0], 1 - head[1], 1 - head[2])
        draws.integer(0, 3)
        self.box = self.add(build_aperture_box(self, (0, 0), math.pi / 2))
        self.pegs = [
            self.add(
                build_peg(
                    self, f"peg_{i}", PEG_LENGTH, PEG_RADIUS, head, tail, (0.2, 0.2 * (i - 1)), 0
                )
            )
            for i in range(
                self.values.count("initializations.pegs") if self.values.specified else PEGS
            )
        ]
        if not self.pegs:
            raise self.values.error("initializations.pegs", "is missing or empty")
        self.peg = self.pegs[0]
        self._disc = build_highlight(self, "disc", *MARK, APERTURE_COLOUR)
        self._red_disc = build_mark(self, "disc_red", MARK[0] * 1.003, MARK[1] * 1.003)

    def start_episode(self, draws: Draws) -> None:
        values = self.values
        x, y = values.place(
            "initializations.box_jitter", lambda: [-0.1 + 0.2 * draws.uniform() for _ in range(2)]
        )
        yaw = values.number(
            "initializations.box_yaw", lambda: math.radians(90 - 20 + 40 * draws.uniform())
        )
        self.box.set_home(at((x, y), APERTURE_Z, yaw))
        for peg, (place, rotation) in zip(
            self.pegs, self._read_pegs() or self._draw_pegs(draws, (x, y)), strict=True
        ):
            peg.set_home(at(place, 0, rotation))
        self.end: PegEnd = ENDS[
            values.integer("initializations.obj_sample", lambda: draws.integer(0, 2), most=1)
        ]
        self.side = (-1, 1)[
            values.integer("initializations.dir_sample", lambda: draws.integer(0, 2), most=1)
        ]
        below = self.box.position - [0, 0, Highlight.DEPTH]
        self._disc.move_to(sapien.Pose(below, self._disc.pose.q))
        self.mark = Mark(self._red_disc, self.box.position, DISPLAY_STEPS)
        self._helpful, self._restoring = 0, False

    def _read_pegs(self) -> list[tuple[list[float], float]]:
        """Place and yaw of each peg of the row; empty where there is none."""
        values = self.values
        pegs: list[tuple[list[float], float]] = []
        for i in range(len(self.pegs) if values.specified else 0):
            entry, name = values.find("initializations.pegs")[i], f"initializations.pegs.{i}"
            if not isinstance(entry, list) or len(entry) != 2:
                raise values.error(name, f"is {entry!r}; expected [[x, y], yaw]")
            place = values.check_place(
                name, [*entry[0], entry[1]] if isinstance(entry[0], list) else entry, 3
            )
            if any(math.dist(place[:2], other) < PEG_RADIUS for other, _ in pegs):
                raise values.error(name, "overlaps another peg")
            pegs.append((place[:2], place[2]))
        return pegs

    def _draw_pegs(
        self, draws: Draws, box: tuple[float, float]
    ) -> list[tuple[tuple[float, float], float]]:
        places: list[tuple[float, float]] = []
        yaws = []
        for _ in self.pegs:
            places.append(self._draw_place(draws, box, places))
            yaws.append(math.radians(-45 + 90 * draws.uniform()))
        pegs = list(zip(places, yaws, strict=True))
        self.values.note("initializations.pegs", pegs)
        return pegs

    def _draw_place(
        self, draws: Draws, box: tuple[float, float], others: list
    ) -> tuple[float, float]:
        for _ in range(TRIES):
            place = (-0.2 + 0.4 * draws.uniform(), -0.3 + 0.6 * draws.uniform())
            if math.dist(place, box) > FROM_BOX and all(
                math.dist(place, other) > FROM_PEG for other in others
            ):
                return place
        raise SceneError(f"InsertPeg, seed {self.seed}: a peg finds no place.")

    def cues(self) -> list[Cue]:
        return [Cue("white", lambda: on_table(self.ends(self.end)[0].position))]

    def after_step(self, k: int) -> None:
        self.mark.update(k, touched=self._inserted(self.end, self.side))
        if self.reset_in_progress:
            for peg in self.pegs:
                peg.displace(peg.initial_pose)
        elif self._restoring and self.second_tries and self._flung():
            self.peg.restore()
        self._restoring = self.reset_in_progress

    def _flung(self) -> bool:
        """Whether the peg left at once where it was put back: it keeps what speed the hand or the
        box gave it.

        No official episode shows that, since its demonstrator could not continue from there; the
        peg is laid down at rest.
        """
        return float(np.linalg.norm(self.peg.position - self.peg.initial_pose.p)) > FLUNG

    # Predicates -----------------------------------------------------------------------------------

    def ends(self, end: str) -> tuple[Thing, Thing]:
        """The grasped end of the peg and the one that is inserted."""
        return (self.peg.head, self.peg.tail) if end == "head" else (self.peg.tail, self.peg.head)

    def _lifted(self, end: str) -> bool:
        grasped, other = self.ends(end)
        tcp = self.tcp_pose.p
        nearer = np.linalg.norm(grasped.position - tcp) < np.linalg.norm(other.position - tcp)
        return bool(grasped.position[2] > LIFTED_Z and nearer)

    def _is_near(self, grasped: Thing, free: Thing) -> bool:
        """Whether the grasped end is the nearer one: along x, or in rows of RoboMME-OOD by the
        distance.
        """
        if not self.tier:
            return bool(grasped.position[0] < free.position[0])
        near = [distance_xy(thing.position, np.array(ROBOT_BASE)) for thing in (grasped, free)]
        return near[0] < near[1] or (near[0] == near[1] and self.end == "head")

    def _inside(self, thing: Thing) -> bool:
        return float(np.linalg.norm(thing.position - self.box.position)) <= INSERTED

    def _inserted(self, end: str, side: int) -> bool:
        """The free end is in the box, the gripper on the given side of it."""
        grasped, free = self.ends(end)
        box = self.box.position
        nearer = np.linalg.norm(free.position - box) < np.linalg.norm(grasped.position - box)
        return self._inside(free) and bool(nearer) and (self.tcp_pose.p[1] - box[1]) * side < 0

    # Sub-tasks ------------------------------------------------------------------------------------

    def subtasks(self) -> list[SubTask]:
        between = [
            end_video(self),
            SubTask(
                NO_RECORD,
                StaticFor(self, HOLD_STEPS),
                lambda demo: demo.hold(HOLD_STEPS),
                video=True,
            ),
        ]
        return [*self._both(video=True), *between, *self._both(video=False)]

    def _both(self, video: bool) -> list[SubTask]:
        grasped, free = self.ends(self.end)
        side = "right" if self.side == 1 else "left"
        word = "near" if self._is_near(grasped, free) else "far"  # from the robot's base
        wrong_end = "tail" if self.end == "head" else "head"
        of_box = " of the box" if video else ""
        others = [end for peg in self.pegs[1:] for end in (peg.head, peg.tail)]

        def wrong_grasp() -> bool:
            return self._lifted(wrong_end) or any_picked_up(self, others)

        def wrong_insertion() -> bool:
            wrong = self._inserted(wrong_end, 1) or self._inserted(wrong_end, -1)
            return wrong or self._inserted(self.end, -self.side) or any_picked_up(self, others)

        return [
            SubTask(
                f"Pick up the peg by grasping the {word} end",
                done=lambda: self._lifted(self.end),
                run=self._demonstrate_grasp,
                grounded=f"Pick up the peg by grasping the {word} end at <>",
                failed=None if video else wrong_grasp,
                targets=[grasped],
                choice="a",
                video=video,
                operation="which",
            ),
            SubTask(
                f"Insert the peg from the {side} side{of_box}",
                done=lambda: self._inserted(self.end, self.side),
                run=self._demonstrate_insertion,
                grounded=f"Insert the peg from the {side} side{of_box} at <>",
                failed=None if video else wrong_insertion,
                targets=[self.box],
                choice="b" if self.side == 1 else "c",
                video=video,
                operation=lambda: "which" if any_picked_up(self, others) else "how",
            ),
        ]

    # Demonstration --------------------------------------------------------------------------------

    # Where the benchmark's demonstrator fails, other motions follow; where it does not, there are
    # none.

    def _demonstrate_grasp(self, demo: "Demonstrator") -> None:
        """Grasp as the benchmark does; where the box is in the hand's way, move the peg by its
        other end first.
        """
        other: PegEnd = "tail" if self.end == "head" else "head"
        plans: list[tuple[PegEnd, bool] | None] = [
            None,
            (other, False),
            (other, True),
            (self.end, True),
        ]
        if not self.second_tries:
            return demo.grasp_peg(self.peg, self.end)
        # What helped in the video is likely to help again.
        for drag in plans[self._helpful :]:
            if drag is not None:
                with suppress(PlanningError):
                    demo.drag_peg(self.peg, drag[0], self._way_out(), flip=drag[1])
            with suppress(PlanningError):  # out of reach, for instance
                demo.grasp_peg(self.peg, self.end)
            if self._lifted(self.end):
                self._helpful = plans.index(drag)
                return
        raise PlanningError(
            f"{self.peg.name} cannot be grasped by its {self.end}: it is out of reach, or the box"
            " is in the way."
        )

    def _way_out(self) -> np.ndarray:
        """The shortest way [2] that takes the peg to an open place."""
        middle = (self.peg.head.position + self.peg.tail.position)[:2] / 2
        others = [peg.position[:2] for peg in self.pegs[1:]]

        def is_open(place: np.ndarray) -> bool:
            near, farthest = WORKSPACE
            reached = near < np.linalg.norm(place - ROBOT_BASE[:2]) < farthest
            apart = np.linalg.norm(place - self.box.position[:2]) > OPEN_FROM_BOX
            return bool(
                reached
                and apart
                and all(np.linalg.norm(place - other) > OPEN_FROM_PEG for other in others)
            )

        angles, lengths = np.linspace(0, 2 * np.pi, 16, endpoint=False), np.arange(0.04, 0.4, 0.02)
        ways = [
            length * np.array([np.cos(angle), np.sin(angle)])
            for length in lengths
            for angle in angles
        ]
        away = middle - self.box.position[:2]
        # A peg beside the box is not pulled through it; one that is only far away may come nearer.
        beside = np.linalg.norm(away) < OPEN_FROM_BOX
        most = SIDEWAYS * np.linalg.norm(away)
        open_ways = (
            w
            for w in ways
            if (not beside or w @ away >= most * np.linalg.norm(w)) and is_open(middle + w)
        )
        return next(open_ways, 0.1 * away / np.linalg.norm(away))

    def _demonstrate_insertion(self, demo: "Demonstrator") -> None:
        """Insert as the benchmark does; where that fails, push on, begin anew, and at last from
        another grasp.
        """
        task = (self.peg, self.end, self.side, self.box)
        tries: list[Callable[[], None]] = [
            lambda: demo.insert_peg(*task),
            lambda: demo.insert_peg_fully(*task, begun=True),
            lambda: demo.insert_peg_fully(*task),
            lambda: self._insert_anew(demo, flip=True),
            lambda: self._insert_anew(demo, flip=False),
        ]
        for attempt in tries if self.second_tries else tries[:1]:
            if not self._inserted(self.end, self.side):
                with suppress(PlanningError):
                    attempt()

    def _insert_anew(self, demo: "Demonstrator", flip: bool) -> None:
        demo.withdraw()
        if any(self.is_grasping(end) for end in self.ends(self.end)):
            demo.lay_down_peg(self._way_out())
        demo.grasp_peg(self.peg, self.end, flip)
        if self._lifted(self.end):
            demo.insert_peg_fully(self.peg, self.end, self.side, self.box)

    # Choices --------------------------------------------------------------------------------------

    def choices(self) -> list[Choice]:
        def every_end() -> list[Thing]:
            return [end for peg in self.pegs for end in (peg.head, peg.tail)]

        return [
            Choice("a", "pick up the peg by grasping one end", self._grasp, every_end),
            Choice(
                "b", "insert the peg from the right side", lambda demo, _: self._insert(demo, 1)
            ),
            Choice(
                "c", "insert the peg from the left side", lambda demo, _: self._insert(demo, -1)
            ),
        ]

    def _grasp(self, demo: "Demonstrator", thing: Thing | None) -> None:
        peg = next(peg for peg in self.pegs if thing in (peg.head, peg.tail))
        demo.grasp_peg(peg, "head" if thing is peg.head else "tail")

    def _insert(self, demo: "Demonstrator", side: int) -> None:
        """Insert whichever peg the gripper is at, by whichever end it holds."""
        tcp = self.tcp_pose.p
        ends = [(peg, end) for peg in self.pegs for end in ENDS]
        peg, end = min(ends, key=lambda e: float(np.linalg.norm(getattr(*e).position - tcp)))
        demo.insert_peg(peg, end, side, self.box)
        if not any(self._inside(half) for half in (peg.head, peg.tail)):
            demo.insert_peg_fully(peg, end, side, self.box, begun=True)

    def goals(self) -> list[str]:
        goal = "watch the video carefully, then grasp the same"
        if self.in_view:
            side = "right" if self.side == 1 else "left"
            return [
                f"grasp the marked end of the peg and insert it into the {side} side of the box"
            ]
        return [
            (
                f"{goal} end of the same peg you've picked before and insert it into the same side"
                " of the box"
            ),
            (
                f"{goal} peg at the same end and insert it into the same side of the box as in the"
                " video"
            ),
        ]
