"""What the two VideoPlace tasks share: a cube is carried over targets in the video; put it on one
of them again.
"""

from abc import abstractmethod
from typing import ClassVar

import sapien

from mme_vla.envs.robomme.robot.demonstrator import Demonstrator
from mme_vla.envs.robomme.scene.motions import Cue, Swap, under
from mme_vla.envs.robomme.scene.objects import Cube, Disc, H
from mme_vla.envs.robomme.scene.placement import Avoid, Draws, Region
from mme_vla.envs.robomme.scene.predicates import any_picked_up, dropped, dropped_onto
from mme_vla.envs.robomme.scene.things import Thing
from mme_vla.envs.robomme.tasks.families.stages import (
    SAMPLED_COLOURS,
    VideoSwaps,
    add_button,
    add_cubes,
    add_target,
    check_colour,
    delay,
    end_video,
    go_home,
    pick,
    place,
    press,
    press_choice,
    sample_colours,
    wait,
)
from mme_vla.envs.subtasks import Choice, SubTask

CUBES = {"easy": 1, "medium": 3, "hard": 3}
TARGET_RADIUS = 0.04
TABLE_Z = 0.01
SUNK_Z = -0.05
GO_HOME_STEPS, SWAP_STAGE_STEPS = 20, 60
SWAP_LANE = 0.1


class Place(Thing):
    """Where an object stood at first: a place without a body."""

    def __init__(self, thing: Thing) -> None:
        self._at = thing.initial_pose

    @property
    def pose(self) -> sapien.Pose:
        return self._at


class VideoPlace(VideoSwaps):
    """The cube visits targets, then a spot of the table; in hard episodes two targets then change
    places.
    """

    fact_choices = "bc"
    spot_radius: ClassVar[float]
    """How far the spot where the video puts the cube at its end stays from the edge of
    its region.
    """
    target_counts: ClassVar[dict[str, int]]
    operation: ClassVar[str] = "which"
    """What is mistaken by who puts the cube on another target."""

    def build(self, draws: Draws) -> None:
        values, table = self.values, Region((0, 0), 0.2)
        region = Region((-0.1, 0), 0.1)
        self.spot = add_target(
            self, draws, "spot", "layout.goal_xy", region, self.spot_radius, [], gap=H
        )
        self.button = add_button(self, draws, (0.1, 0), (0.05, 0.3))
        colours = sample_colours(self, draws, SAMPLED_COLOURS)[: CUBES[self.difficulty]]
        self.cubes = add_cubes(self, draws, colours, table, [self.spot, self.button])
        self.targets = self._add_targets(draws, table)
        # The spot is not to be seen: a cube is put down where it would be.
        self.spot.set_home(sapien.Pose([*values.find("layout.goal_xy"), SUNK_Z], self.spot.pose.q))
        n_cubes, n_targets = len(self.cubes), len(self.targets)
        self.demonstrated = values.indices(
            "objects.demo_ids", lambda: [draws.integer(0, n_cubes)], n_cubes
        )
        values.require(
            self.demonstrated, "objects.demo_ids", "is empty; expected the cubes of the video"
        )
        self.cube = self.cubes[self.demonstrated[0]]

        def sample_swap() -> list[int]:
            return draws.permutation(n_targets) if self.difficulty == "hard" else []

        swapped = values.indices("objects.swap_pair_ids", sample_swap, n_targets)
        self._swapped = [self.targets[i] for i in swapped[:2]]
        values.require(
            len(self._swapped) != 1,
            "objects.swap_pair_ids",
            "has one target; expected two, or none",
        )
        self.draw_script(draws)
        check_colour(self, self.cube.colour)

    def _add_targets(self, draws: Draws, table: Region) -> list[Disc]:
        count = self.values.count("layout.targets", self.target_counts[self.difficulty])
        targets: list[Disc] = []
        for i in range(count):
            avoid: list[Avoid] = [self.spot, self.button, *self.cubes, *targets]
            target = add_target(
                self,
                draws,
                f"target_{i}",
                f"layout.targets.{i}",
                table,
                TARGET_RADIUS,
                avoid,
                gap=H,
            )
            targets.append(target)
        self.values.require(
            count >= 2, "layout.targets", f"has {count} targets; expected at least 2"
        )
        return targets

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

    def make_swaps(self, start: int) -> list[Swap]:
        first, second = self._swapped
        return [Swap(first, self.targets, start, SWAP_LANE, second)]

    def cues(self) -> list[Cue]:
        return [under(self.goal_target)]

    def subtasks(self) -> list[SubTask]:
        stage = wait(self, SWAP_STAGE_STEPS)
        self.swap_stage = stage if self._swapped else None
        steps = self.visits()
        if not self.tier:
            drop = SubTask(
                "drop the cube onto table",
                done=lambda: dropped(self, self.cube),
                run=lambda demo: demo.place_on(self.spot, TABLE_Z),
                video=True,
            )
            steps += [self.show_pick(self.cube), drop]
        home = go_home(self, GO_HOME_STEPS + delay(self))
        return [*steps, home, stage, end_video(self), *self._execution()]

    def put_back(self, cube: Cube) -> list[SubTask]:
        """Pick the cube up in the video and put it where it stood at first, as in RoboMME-OOD."""
        home = Place(cube)
        put = SubTask(
            "put the cube back to its original position",
            done=lambda: dropped_onto(self, cube, home),
            run=lambda demo: demo.place_on(home),
            video=True,
        )
        return [self.show_pick(cube), put]

    def show_pick(self, cube: Cube) -> SubTask:
        """The video's picking up of a cube."""
        return pick(self, cube, "pick up the cube", grounded="", video=True)

    def show_drop(self, cube: Cube, target: Disc) -> SubTask:
        """The video's dropping of a cube on a target."""
        return place(self, cube, target, "drop the cube onto target", grounded="", video=True)

    def show_press(self) -> SubTask:
        """The video's press of the button."""
        return press(self.button, "press the button", "c", grounded="", video=True)

    def _execution(self) -> list[SubTask]:
        cube, target = self.cube, self.goal_target
        wrong_cubes = [other for other in self.cubes if other is not cube]
        wrong_targets = [other for other in self.targets if other is not target]
        return [
            pick(
                self,
                cube,
                "pick up the cube",
                failed=lambda: any_picked_up(self, wrong_cubes),
                pick=True,
            ),
            place(
                self,
                cube,
                target,
                "place the cube onto the correct target",
                failed=lambda: any(dropped_onto(self, cube, wrong) for wrong in wrong_targets),
                operation=self.operation,
            ),
        ]

    def choices(self) -> list[Choice]:
        return [
            Choice("a", "pick up the cube", Demonstrator.pick, self.cubes),
            Choice("b", "drop onto", Demonstrator.place_on, self.targets),
            press_choice("c", "press the button", self.button),
        ]
