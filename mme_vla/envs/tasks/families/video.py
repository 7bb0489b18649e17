"""What the two VideoPlace tasks share: a cube is carried over targets in the video; put it on one of them again."""

from abc import abstractmethod
from typing import TYPE_CHECKING, ClassVar

import sapien

from mme_vla.envs.scene.articulated import build_button
from mme_vla.envs.scene.motions import Cue, Swap, under
from mme_vla.envs.scene.objects import Cube, Disc, H, build_cube, build_disc
from mme_vla.envs.scene.placement import Avoid, Draws, Region, SceneError, draw_button, draw_cube, draw_disc
from mme_vla.envs.scene.stage import RESET_QPOS
from mme_vla.envs.scene.things import (
    StaticFor,
    any_picked_up,
    dropped,
    dropped_onto,
    picked_up,
    pressed,
    reset_reached,
)
from mme_vla.envs.subtasks import NO_RECORD, Choice, SubTask
from mme_vla.envs.task import Task

if TYPE_CHECKING:
    from mme_vla.envs.robot.demonstrator import Demonstrator


def back_to_start(env: Task, steps: int = 30) -> list[SubTask]:
    """From the video to the execution: the arm goes home, then to where its first approach ended."""
    return [
        SubTask(
            NO_RECORD,
            done=lambda: env.after_video and reset_reached(env, RESET_QPOS),
            run=lambda demo: demo.hard_reset(steps),
            video=True,
        ),
        SubTask(
            NO_RECORD,
            done=lambda: env.stored_qpos is not None and reset_reached(env, env.stored_qpos),
            run=lambda demo: demo.hard_reset(qpos=env.stored_qpos),
            video=True,
        ),
    ]


CUBES = {"easy": 1, "medium": 3, "hard": 3}
TARGET_RADIUS = 0.04
TABLE_Z = 0.01
SUNK_Z = -0.05
GO_HOME_STEPS, SWAP_STAGE_STEPS = 20, 60
SWAP_LANE = 0.1


class VideoPlace(Task):
    """The cube visits targets, then a spot of the table; in hard episodes two targets then change places."""

    dials = frozenset({"delay"})
    spot_radius: ClassVar[float]
    """How far the spot where the video puts the cube at its end stays from the edge of its region."""
    target_counts: ClassVar[dict[str, int]]
    operation: ClassVar[str] = "which"
    """What is mistaken by who puts the cube on another target."""

    def build(self, draws: Draws) -> None:
        spot = draw_disc(draws, Region((-0.1, 0), 0.1), self.spot_radius, [], gap=H)
        if spot is None:
            raise SceneError(f"{type(self).__name__}, seed {self.seed}: the cube's last spot finds no place.")
        self.spot = self.add(build_disc(self, "spot", self.spot_radius, 0.005, "purple", spot))
        self.button = self.add(build_button(self, draw_button(draws, (0.1, 0), (0.05, 0.3))))
        colours = [("red", "blue", "green")[i] for i in draws.permutation(3)][: CUBES[self.difficulty]]
        avoid: list[Avoid] = [self.spot, self.button]
        self.cubes: list[Cube] = []
        for colour in colours:
            place = draw_cube(draws, Region((0, 0), 0.2), avoid, gap=H)
            if place is None:
                raise SceneError(f"{type(self).__name__}, seed {self.seed}: the {colour} cube finds no place.")
            self.cubes.append(self.add(build_cube(self, f"cube_{colour}", colour, *place)))
            avoid.append(self.cubes[-1])
        self.targets: list[Disc] = []
        for i in range(self.target_counts[self.difficulty]):
            xy = draw_disc(draws, Region((0, 0), 0.2), TARGET_RADIUS, avoid, gap=H)
            if xy is None:
                raise SceneError(f"{type(self).__name__}, seed {self.seed}: target {i} finds no place.")
            self.targets.append(self.add(build_disc(self, f"target_{i}", TARGET_RADIUS, 0.005, "purple", xy)))
            avoid.append(self.targets[-1])
        self.spot.set_home(sapien.Pose([*spot, SUNK_Z], self.spot.pose.q))
        self.cube = self.cubes[draws.integer(0, len(self.cubes))]
        hard = self.difficulty == "hard"
        self._swapped = [self.targets[i] for i in draws.permutation(len(self.targets))[:2]] if hard else []
        self.draw_script(draws)

    @abstractmethod
    def draw_script(self, draws: Draws) -> None:
        """Draw what the video shows and what is asked for."""

    @abstractmethod
    def visits(self) -> list[SubTask]:
        """The video's sub-tasks up to where the cube goes back to the table."""

    @property
    @abstractmethod
    def goal_target(self) -> Disc:
        """Where the cube belongs."""

    def start_episode(self, draws: Draws) -> None:
        self._swap: Swap | None = None
        self._swap_due = False

    def before_physics(self, k: int) -> None:
        if self._swap_due and self._swap is None:
            first, second = self._swapped
            self._swap = Swap(first, self.targets, start=k, lane=SWAP_LANE, partner=second)
        if self._swap is not None:
            self._swap.apply(k)

    def cues(self) -> list[Cue]:
        return [under(self.goal_target)]

    def failure(self) -> bool:
        """Notes whether the swap may begin, one step after its stage is entered; the rules belong to the stages."""
        self._swap_due = bool(self._swapped) and self.progress.current is self._swap_stage
        return False

    def subtasks(self) -> list[SubTask]:
        steps = GO_HOME_STEPS + self.turned("delay")
        self._swap_stage = SubTask(
            "static", StaticFor(self, SWAP_STAGE_STEPS), lambda demo: demo.hold(SWAP_STAGE_STEPS), video=True
        )
        after = [
            self.show_pick(),
            SubTask(
                "drop the cube onto table",
                done=lambda: dropped(self, self.cube),
                run=lambda demo: demo.place_on(self.spot, TABLE_Z),
                video=True,
            ),
            SubTask("static", StaticFor(self, steps), lambda demo: self._go_home(demo, steps), video=True),
            self._swap_stage,
            SubTask(
                NO_RECORD,
                done=lambda: self.after_video and reset_reached(self, self.reset_action[:-1]),
                run=lambda demo: demo.hard_reset(),
                video=True,
            ),
        ]
        return [*self.visits(), *after, *self._execution()]

    @staticmethod
    def _go_home(demo: "Demonstrator", steps: int) -> None:
        demo.go_home()
        demo.hold(steps)

    def show_pick(self) -> SubTask:
        """The video's picking up of the cube."""
        return SubTask(
            "pick up the cube",
            done=lambda: picked_up(self, self.cube),
            run=lambda demo: demo.pick(self.cube),
            targets=[self.cube],
            choice="a",
            video=True,
        )

    def show_drop(self, target: Disc) -> SubTask:
        """The video's dropping of the cube on a target."""
        return SubTask(
            "drop the cube onto target",
            done=lambda: dropped_onto(self, self.cube, target),
            run=lambda demo: demo.place_on(target),
            targets=[target],
            choice="b",
            video=True,
        )

    def show_press(self) -> SubTask:
        """The video's press of the button."""
        return SubTask(
            "press the button",
            done=lambda: pressed(self.button),
            run=lambda demo: demo.press(self.button),
            targets=[self.button],
            choice="c",
            video=True,
        )

    def _execution(self) -> list[SubTask]:
        cube, target = self.cube, self.goal_target
        other_cubes = [c for c in self.cubes if c is not cube]
        other_targets = [t for t in self.targets if t is not target]
        return [
            SubTask(
                "pick up the cube",
                done=lambda: picked_up(self, cube),
                run=lambda demo: demo.pick(cube),
                grounded="pick up the cube at <>",
                failed=lambda: any_picked_up(self, other_cubes),
                targets=[cube],
                choice="a",
                pick=True,
            ),
            SubTask(
                "place the cube onto the correct target",
                done=lambda: dropped_onto(self, cube, target),
                run=lambda demo: demo.place_on(target),
                grounded="place the cube onto the correct target at <>",
                failed=lambda: any(dropped_onto(self, cube, other) for other in other_targets),
                targets=[target],
                choice="b",
                operation=self.operation,
            ),
        ]

    def choices(self) -> list[Choice]:
        return [
            Choice("a", "pick up the cube", lambda demo, cube: demo.pick(cube), lambda: self.cubes),
            Choice("b", "drop onto", lambda demo, target: demo.place_on(target), lambda: self.targets),
            Choice("c", "press the button", lambda demo, _: demo.press(self.button)),
        ]
