"""MoveCube (Imitation): the video moves a cube to a target in one of three manners; move it in the
same manner.
"""

import math
from collections.abc import Sequence
from typing import Any

import sapien

from mme_vla.envs.facts import Candidates
from mme_vla.envs.robomme.robot.demonstrator import Demonstrator
from mme_vla.envs.robomme.scene.articulated import PEG_COLOUR, build_peg
from mme_vla.envs.robomme.scene.objects import H, at, build_cube, build_disc, cube_pose
from mme_vla.envs.robomme.scene.placement import (
    Avoid,
    Draws,
    Region,
    SceneError,
    draw_cube,
    draw_disc,
)
from mme_vla.envs.robomme.scene.predicates import (
    any_picked_up,
    gripper_open,
    picked_up,
    pushed_onto,
)
from mme_vla.envs.robomme.tasks import register_task
from mme_vla.envs.robomme.tasks.families.stages import delay, end_video, pick, place, wait
from mme_vla.envs.subtasks import Choice, SubTask
from mme_vla.envs.task import Task, candidates_among

MANNERS = ("hook", "push", "grasp")
MANNER_TEXTS = {
    "hook": "hook the cube with the peg",
    "push": "push the cube with the closed gripper",
    "grasp": "pick up the cube and place it",
}
PEG_LENGTH, PEG_RADIUS = 0.1, 0.01
TARGET_RADIUS = 0.04
CUBE_FROM_TARGET = 5 * H
CUBE_GAP = 0.005
TRIES = 128
HOLD_STEPS = {"hook": 30, "push": 60, "grasp": 60}
MORE_TRIES = 2  # where the cube did not stay on the target


@register_task
class MoveCube(Task):
    """Hook it with a peg, push it with the closed gripper, or pick and place it; the difficulty
    changes nothing.
    """

    shared_draws = True

    def build(self, draws: Draws) -> None:
        for _ in range(2):
            draws.uniform()  # part of the official stream, without effect
        video_peg = self._place_peg(draws, "demo")
        peg = self._place_peg(draws, "execution")
        for _ in range(2):
            draws.integer(0, 2)
        video_goal = self.values.place(
            "layout.demo.goal_xy", lambda: draw_disc(draws, Region((0, 0), 0.15), TARGET_RADIUS)
        )
        goal = self.values.place(
            "layout.execution.goal_xy", lambda: draw_disc(draws, Region((0, 0), 0.1), TARGET_RADIUS)
        )
        x, y, yaw = video_peg
        self.peg = self.add(
            build_peg(self, "peg", PEG_LENGTH, PEG_RADIUS, PEG_COLOUR, PEG_COLOUR, (x, y), yaw)
        )
        self.target = self.add(
            build_disc(self, "target", TARGET_RADIUS, 0.005, "purple", video_goal)
        )
        x, y, yaw = self._place_cube(draws, "demo", video_goal, [])
        self.cube = self.add(build_cube(self, "cube", "red", (x, y), yaw))
        x, y, yaw = self._place_cube(draws, "execution", goal, [self.cube])
        self._execution_poses = {
            self.peg: at(peg[:2], 0, peg[2]),
            self.target: sapien.Pose([*goal, self.target.position[2]], self.target.pose.q),
            self.cube: cube_pose((x, y), yaw),
        }

    def _place_peg(self, draws: Draws, part: str) -> tuple[float, float, float]:
        """Place and yaw of the peg in the video (`demo`) or in the execution."""
        values = self.values
        if values.specified:
            _, x, y = values.place(f"layout.{part}.peg_offsets", list, size=3)
            return x, y, values.number(f"layout.{part}.peg_yaw", float)
        side = -0.2 if draws.coin() else 0.2
        x = -0.05 + 0.1 * draws.uniform()
        y = side - 0.05 + 0.1 * draws.uniform()
        yaw = math.radians(-45 + 90 * draws.uniform())
        values.note(f"layout.{part}.peg_offsets", [0.0, x, y])
        values.note(f"layout.{part}.peg_yaw", yaw)
        return x, y, yaw

    def _place_cube(
        self, draws: Draws, part: str, goal: Sequence[float], avoid: Sequence[Avoid]
    ) -> list[float]:
        """Place and yaw [3] of the cube in the video (`demo`) or in the execution."""
        name = f"layout.{part}.cube_pose"
        x, y, yaw = self.values.place(name, lambda: self._draw_cube(draws, goal, avoid), size=3)
        clear = not self.values.specified or math.dist((x, y), goal) > H
        self.values.require(clear, name, f"overlaps spec.layout.{part}.goal_xy")
        return [x, y, yaw]

    def _draw_cube(
        self, draws: Draws, goal: Sequence[float], avoid: Sequence[Avoid]
    ) -> list[float]:
        """A place near a point that is not near the goal."""
        for _ in range(TRIES):
            centre = (-0.1 + 0.2 * draws.uniform(), -0.1 + 0.2 * draws.uniform())
            if math.dist(centre, goal) > CUBE_FROM_TARGET:
                what = f"{self.where}: the cube"
                xy, yaw = draw_cube(draws, Region(centre, 0.05), avoid, CUBE_GAP, what)
                return [*xy, yaw]
        raise SceneError(f"{self.where}: the cube finds no place away from the target.")

    def start_episode(self, draws: Draws) -> None:
        self.manner = MANNERS[
            self.values.integer("initializations.way_idx", lambda: draws.integer(0, 3), most=2)
        ]

    def after_step(self, k: int) -> None:
        if self.reset_in_progress:
            for thing, pose in self._execution_poses.items():
                thing.displace(pose)

    def flip_fact(self) -> dict[str, Any]:
        """The video takes the peg instead of the cube, or the cube instead of the peg."""
        manner = "grasp" if self.manner == "hook" else "hook"
        return self.values.changed({"initializations.way_idx": MANNERS.index(manner)})

    def candidates(self) -> Candidates | None:
        """The peg and the cube: what the manner of the video begins with."""
        subtask = self.progress.current
        if subtask is None or subtask.video or subtask.operation != "how":
            return None
        first = self.peg.tail if self.manner == "hook" else self.cube
        return candidates_among([self.peg.tail, self.cube], [first])

    def subtasks(self) -> list[SubTask]:
        moves = {"hook": self._hook, "push": self._push, "grasp": self._grasp}[self.manner]
        return [
            *moves(video=True),
            wait(self, HOLD_STEPS[self.manner] + delay(self)),
            end_video(self),
            *moves(video=False),
        ]

    def _on_target(self) -> bool:
        return pushed_onto(self.cube, self.target)

    def _pushed(self) -> bool:
        return self._on_target() and gripper_open(self)

    def _holds_peg(self) -> bool:
        return any_picked_up(self, (self.peg.head, self.peg.tail))

    def _holds_cube(self) -> bool:
        return picked_up(self, self.cube)

    def _hook(self, video: bool) -> list[SubTask]:
        return [
            SubTask(
                "Pick up the peg",
                done=self._holds_peg,
                run=lambda demo: demo.grasp_peg(self.peg, "tail"),
                grounded="Pick up the peg at <>",
                failed=lambda: self._holds_cube() or self._on_target(),
                targets=[self.peg.tail],
                choice="a",
                video=video,
                operation="how",
            ),
            SubTask(
                "Hook the cube to the target with the peg",
                done=self._pushed,
                run=self._demonstrate_move,
                grounded="Hook the cube at <> to the target at <> with the peg",
                targets=[self.cube, self.target],
                choice="b",
                video=video,
            ),
        ]

    def _push(self, video: bool) -> list[SubTask]:
        push = SubTask(
            "Close the gripper and push the cube to the target",
            done=self._pushed,
            run=self._demonstrate_move,
            grounded="Close the gripper and push the cube at <> to the target at <>",
            failed=lambda: self._holds_cube() or self._holds_peg(),
            targets=[self.cube, self.target],
            choice="c",
            video=video,
            operation="how",
        )
        return [push]

    def _demonstrate_move(self, demo: Demonstrator) -> None:
        """Hook or push as the benchmark does, and again where the cube did not stay."""
        move = demo.hook if self.manner == "hook" else demo.push
        move(self.cube, self.target)
        tries = MORE_TRIES if self.second_tries else 0
        for _ in range(tries):
            if not self._pushed():
                demo.withdraw()
                if self.manner == "hook":
                    demo.grasp_peg(self.peg, "tail")
                move(self.cube, self.target)

    def _grasp(self, video: bool) -> list[SubTask]:
        return [
            pick(
                self,
                self.cube,
                "Pick up the cube",
                "d",
                failed=lambda: self._on_target() or self._holds_peg(),
                video=video,
                operation="how",
            ),
            place(self, self.cube, self.target, "place the cube onto the target", "e", video=video),
        ]

    def choices(self) -> list[Choice]:
        return [
            Choice("a", "pick up the peg", lambda demo, _: demo.grasp_peg(self.peg, "tail")),
            Choice(
                "b",
                "hook the cube to the target with the peg",
                lambda demo, _: demo.hook(self.cube, self.target),
            ),
            Choice(
                "c",
                "close gripper and push the cube to the target",
                lambda demo, _: demo.push(self.cube, self.target),
            ),
            Choice("d", "pick up the cube", lambda demo, _: demo.pick(self.cube)),
            Choice(
                "e", "place the cube onto the target", lambda demo, _: demo.place_on(self.target)
            ),
        ]

    def goals(self) -> list[str]:
        goal = "watch the video carefully, then move the cube to the target in the same manner"
        manner = ""
        if self.in_view:
            manner = f": {MANNER_TEXTS[self.manner]}"
        return [f"{goal} as before{manner}", f"{goal} shown in the video{manner}"]
