"""What the two VideoPlace tasks share: a cube is carried over targets in the video; put it on one of them again."""

from abc import abstractmethod
from typing import TYPE_CHECKING, ClassVar

import sapien

from mme_vla.envs.scene.articulated import build_button
from mme_vla.envs.scene.motions import Cue, Swap, under
from mme_vla.envs.scene.objects import Cube, Disc, H, build_disc
from mme_vla.envs.scene.placement import Avoid, Draws, Region, SceneError, draw_button, draw_disc
from mme_vla.envs.scene.predicates import any_picked_up, dropped, dropped_onto
from mme_vla.envs.subtasks import Choice, SubTask
from mme_vla.envs.task import Task
from mme_vla.envs.tasks.families.stages import add_cube, end_video, go_home, pick, press, wait

if TYPE_CHECKING:
    pass


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
            self.cubes.append(add_cube(self, draws, f"cube_{colour}", colour, Region((0, 0), 0.2), avoid))
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
        """Sample what the video shows and where the cube belongs."""

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
        self._swap_stage = wait(self, SWAP_STAGE_STEPS)
        after = [
            self.show_pick(),
            SubTask(
                "drop the cube onto table",
                done=lambda: dropped(self, self.cube),
                run=lambda demo: demo.place_on(self.spot, TABLE_Z),
                video=True,
            ),
            go_home(self, GO_HOME_STEPS + self.turned("delay")),
            self._swap_stage,
            end_video(self),
        ]
        return [*self.visits(), *after, *self._execution()]

    def show_pick(self) -> SubTask:
        """The video's picking up of the cube."""
        return pick(self, self.cube, "pick up the cube", grounded="", video=True)

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
        return press(self.button, "press the button", "c", grounded="", video=True)

    def _execution(self) -> list[SubTask]:
        cube, target = self.cube, self.goal_target
        other_cubes = [c for c in self.cubes if c is not cube]
        other_targets = [t for t in self.targets if t is not target]
        return [
            pick(self, cube, "pick up the cube", failed=lambda: any_picked_up(self, other_cubes), pick=True),
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
