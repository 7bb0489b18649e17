"""InsertPeg (Imitation): the video grasps one end of a peg and inserts it from one side; do the
same with that peg.
"""

import math
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from typing import Any

import numpy as np
import sapien
from pydantic import FiniteFloat

from mme_vla.envs.facts import Candidates
from mme_vla.envs.robomme.robot.control import PlanningError
from mme_vla.envs.robomme.robot.demonstrator import Demonstrator, PegEnd
from mme_vla.envs.robomme.robot.robots import ROBOT_BASE
from mme_vla.envs.robomme.scene.articulated import Peg, build_peg
from mme_vla.envs.robomme.scene.motions import Cue, Highlight, Mark, build_mark, on_table
from mme_vla.envs.robomme.scene.objects import (
    APERTURE_COLOUR,
    APERTURE_Z,
    at,
    build_aperture_box,
    build_highlight,
)
from mme_vla.envs.robomme.scene.placement import Draws, Point, SceneError
from mme_vla.envs.robomme.scene.predicates import StaticFor, any_picked_up
from mme_vla.envs.robomme.scene.things import Thing, distance_xy
from mme_vla.envs.robomme.scene.values import Coordinate
from mme_vla.envs.robomme.tasks import register_task
from mme_vla.envs.robomme.tasks.families.stages import end_video
from mme_vla.envs.subtasks import NO_RECORD, Choice, SubTask
from mme_vla.envs.task import Task, candidates_among

PEGS, PEG_LENGTH, PEG_RADIUS = 3, 0.05, 0.01
FROM_BOX, FROM_PEG = 0.06, 0.075
TRIES = 256
ENDS: tuple[PegEnd, PegEnd] = ("head", "tail")
OTHER_END: dict[PegEnd, PegEnd] = {"head": "tail", "tail": "head"}
SIDES = {1: "right", -1: "left"}
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
        draws.integer(0, 3)  # likewise
        self.box = self.add(build_aperture_box(self, (0, 0), math.pi / 2))
        self.pegs: list[Peg] = []
        for i in range(self.values.count("initializations.pegs", PEGS)):
            xy = (0.2, 0.2 * (i - 1))
            peg = build_peg(self, f"peg_{i}", PEG_LENGTH, PEG_RADIUS, head, tail, xy, 0)
            self.pegs.append(self.add(peg))
        self.values.require(self.pegs, "initializations.pegs", "is missing or empty")
        self.peg = self.pegs[0]
        self.wrong_ends = [end for peg in self.pegs[1:] for end in (peg.head, peg.tail)]
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
        pegs = self._read_pegs() if values.specified else self._draw_pegs(draws, (x, y))
        for peg, (place, rotation) in zip(self.pegs, pegs, strict=True):
            peg.set_home(at(place, 0, rotation))
        end = values.integer("initializations.obj_sample", lambda: draws.integer(0, 2), most=1)
        side = values.integer("initializations.dir_sample", lambda: draws.integer(0, 2), most=1)
        self.end = ENDS[end]
        self.side = (-1, 1)[side]
        below = self.box.position - [0, 0, Highlight.DEPTH]
        self._disc.move_to(sapien.Pose(below, self._disc.pose.q))
        self.mark = Mark(self._red_disc, self.box.position, DISPLAY_STEPS)
        self._helpful = 0
        self._restoring = False

    def _read_pegs(self) -> list[tuple[Point, float]]:
        """Place and yaw of each peg of the row."""
        values = self.values
        pegs: list[tuple[Point, float]] = []
        kind = list[tuple[tuple[Coordinate, Coordinate], FiniteFloat]]
        for i, (place, yaw) in enumerate(values.read("initializations.pegs", kind)):
            clear = all(math.dist(place, other) >= PEG_RADIUS for other, _ in pegs)
            values.require(clear, f"initializations.pegs.{i}", "overlaps another peg")
            pegs.append((place, yaw))
        return pegs

    def _draw_pegs(self, draws: Draws, box: Point) -> list[tuple[Point, float]]:
        pegs: list[tuple[Point, float]] = []
        for _ in self.pegs:
            place = self._draw_place(draws, box, [other for other, _ in pegs])
            pegs.append((place, math.radians(-45 + 90 * draws.uniform())))
        self.values.note("initializations.pegs", pegs)
        return pegs

    def _draw_place(self, draws: Draws, box: Point, others: Sequence[Point]) -> Point:
        for _ in range(TRIES):
            place = (-0.2 + 0.4 * draws.uniform(), -0.3 + 0.6 * draws.uniform())
            clear = all(math.dist(place, other) > FROM_PEG for other in others)
            if clear and math.dist(place, box) > FROM_BOX:
                return place
        raise SceneError(f"{self.where}: a peg finds no place.")

    def flip_fact(self) -> dict[str, Any] | None:
        """The first two pegs, of which the video takes one, change places."""
        if len(self.pegs) < 2:
            return None
        first, second, *others = self.values.find("initializations.pegs")
        return self.values.changed({"initializations.pegs": [second, first, *others]})

    def candidates(self) -> Candidates | None:
        """The pegs, before one is grasped."""
        subtask = self.progress.current
        if subtask is None or subtask.video or subtask.operation != "which":
            return None
        return candidates_among(self.pegs, [self.peg])

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

    def ends(self, end: PegEnd) -> tuple[Thing, Thing]:
        """The grasped end of the peg and the one that is inserted."""
        if end == "head":
            return self.peg.head, self.peg.tail
        return self.peg.tail, self.peg.head

    def _lifted(self, end: PegEnd) -> bool:
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
        base = np.array(ROBOT_BASE)
        distance, other = distance_xy(grasped.position, base), distance_xy(free.position, base)
        return distance < other or (distance == other and self.end == "head")

    def _inside(self, thing: Thing) -> bool:
        return float(np.linalg.norm(thing.position - self.box.position)) <= INSERTED

    def _inserted(self, end: PegEnd, side: int) -> bool:
        """The free end is in the box, the gripper on the given side of it."""
        grasped, free = self.ends(end)
        box = self.box.position
        nearer = np.linalg.norm(free.position - box) < np.linalg.norm(grasped.position - box)
        return self._inside(free) and bool(nearer) and (self.tcp_pose.p[1] - box[1]) * side < 0

    # Sub-tasks ------------------------------------------------------------------------------------

    def subtasks(self) -> list[SubTask]:
        hold = SubTask(
            NO_RECORD, StaticFor(self, HOLD_STEPS), lambda demo: demo.hold(HOLD_STEPS), video=True
        )
        return [*self._both(video=True), end_video(self), hold, *self._both(video=False)]

    def _wrong_peg(self) -> bool:
        return any_picked_up(self, self.wrong_ends)

    def _wrong_grasp(self) -> bool:
        return self._lifted(OTHER_END[self.end]) or self._wrong_peg()

    def _wrong_insertion(self) -> bool:
        wrong_end = OTHER_END[self.end]
        if self._inserted(wrong_end, 1) or self._inserted(wrong_end, -1):
            return True
        return self._inserted(self.end, -self.side) or self._wrong_peg()

    def _both(self, video: bool) -> list[SubTask]:
        grasped, free = self.ends(self.end)
        word = "near" if self._is_near(grasped, free) else "far"  # from the robot's base
        insertion = f"Insert the peg from the {SIDES[self.side]} side"
        if video:
            insertion += " of the box"
        return [
            SubTask(
                f"Pick up the peg by grasping the {word} end",
                done=lambda: self._lifted(self.end),
                run=self._demonstrate_grasp,
                grounded=f"Pick up the peg by grasping the {word} end at <>",
                failed=None if video else self._wrong_grasp,
                targets=[grasped],
                choice="a",
                video=video,
                operation="which",
            ),
            SubTask(
                insertion,
                done=lambda: self._inserted(self.end, self.side),
                run=self._demonstrate_insertion,
                grounded=f"{insertion} at <>",
                failed=None if video else self._wrong_insertion,
                targets=[self.box],
                choice="b" if self.side == 1 else "c",
                video=video,
                operation=lambda: "which" if self._wrong_peg() else "how",
            ),
        ]

    # Demonstration --------------------------------------------------------------------------------

    # Where the benchmark's demonstrator fails, other motions follow; where it does not, there are
    # none.

    def _demonstrate_grasp(self, demo: Demonstrator) -> None:
        """Grasp as the benchmark does; where the box is in the hand's way, move the peg by its
        other end first.
        """
        if not self.second_tries:
            demo.grasp_peg(self.peg, self.end)
            return
        other = OTHER_END[self.end]
        # How the peg is dragged before the grasp: by which end, and whether with a flipped hand.
        drags = [None, (other, False), (other, True), (self.end, True)]
        # What helped in the video is likely to help again.
        for i in range(self._helpful, len(drags)):
            drag = drags[i]
            if drag is not None:
                end, flip = drag
                with suppress(PlanningError):
                    demo.drag_peg(self.peg, end, self._way_out(), flip)
            with suppress(PlanningError):  # out of reach, for instance
                demo.grasp_peg(self.peg, self.end)
            if self._lifted(self.end):
                self._helpful = i
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
            if not (reached and apart):
                return False
            return all(np.linalg.norm(place - other) > OPEN_FROM_PEG for other in others)

        away = middle - self.box.position[:2]
        # A peg beside the box is not pulled through it; one that is only far away may come nearer.
        beside = np.linalg.norm(away) < OPEN_FROM_BOX
        most = SIDEWAYS * np.linalg.norm(away)
        for length in np.arange(0.04, 0.4, 0.02):
            for angle in np.linspace(0, 2 * np.pi, 16, endpoint=False):
                way = length * np.array([np.cos(angle), np.sin(angle)])
                passes_box = beside and way @ away < most * np.linalg.norm(way)
                if not passes_box and is_open(middle + way):
                    return way
        return 0.1 * away / np.linalg.norm(away)

    def _demonstrate_insertion(self, demo: Demonstrator) -> None:
        """Insert as the benchmark does; where that fails, push on, begin anew, and at last from
        another grasp.
        """
        task = (self.peg, self.end, self.side, self.box)
        tries: list[Callable[[], None]] = [partial(demo.insert_peg, *task)]
        if self.second_tries:
            tries += [
                partial(demo.insert_peg_fully, *task, begun=True),
                partial(demo.insert_peg_fully, *task),
                partial(self._insert_anew, demo, flip=True),
                partial(self._insert_anew, demo, flip=False),
            ]
        for attempt in tries:
            if not self._inserted(self.end, self.side):
                with suppress(PlanningError):
                    attempt()

    def _insert_anew(self, demo: Demonstrator, flip: bool) -> None:
        demo.withdraw()
        if any(self.is_grasping(end) for end in self.ends(self.end)):
            demo.lay_down_peg(self._way_out())
        demo.grasp_peg(self.peg, self.end, flip)
        if self._lifted(self.end):
            demo.insert_peg_fully(self.peg, self.end, self.side, self.box)

    # Choices --------------------------------------------------------------------------------------

    def choices(self) -> list[Choice]:
        ends = [self.peg.head, self.peg.tail, *self.wrong_ends]
        return [
            Choice("a", "pick up the peg by grasping one end", self._grasp, ends),
            Choice("b", "insert the peg from the right side", partial(self._insert, 1)),
            Choice("c", "insert the peg from the left side", partial(self._insert, -1)),
        ]

    def _grasp(self, demo: Demonstrator, thing: Thing) -> None:
        for peg in self.pegs:
            for end in ENDS:
                if thing is getattr(peg, end):
                    demo.grasp_peg(peg, end)

    def _insert(self, side: int, demo: Demonstrator, _: None) -> None:
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
            side = SIDES[self.side]
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
