"""The base of the demonstrator: planned motions, gripper, waiting, and the way back to the start.

Every motion is a sequence of joint targets, one a control step, passed to a callable that performs
the step.
"""

import math
from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING

import numpy as np
import sapien

from mme_vla.embodiment.robomme import ARM_JOINTS
from mme_vla.envs.robomme.robot.kinematics import Arm
from mme_vla.envs.robomme.robot.planning import plan_free, plan_screw

if TYPE_CHECKING:
    from mme_vla.envs.task import Task

OPEN, CLOSE = 1.0, -1.0
"""Gripper commands."""
GRIPPER_STEPS = 6
"""Control steps that opening or closing takes."""
FREE_TRIES = 3
LONG_DETOUR = 200
"""Steps above which a sampled motion is planned again."""
HOME = (0.0, 0.0, 0.2)
LIMITS = {False: (0.9, 0.9), True: (0.3, 0.9)}
"""Joint velocity and acceleration limits, rad/s and rad/s², of the gripper robot and of the stick
robot (`stick`).
"""


class PlanningError(RuntimeError):
    """No motion to a pose was found."""


class RobotControl:
    """Drives the robot of one task.

    Args:
        env: the task, after its reset.
        step: performs one control step with joint targets and gripper [8], or joint targets [7] for
            the stick.
        on_waypoint: called with a pose of the tool and its gripper command before the motion there
            begins.
    """

    def __init__(
        self,
        env: "Task",
        step: Callable[[np.ndarray], object],
        on_waypoint: Callable[[sapien.Pose, float], None] | None = None,
    ) -> None:
        self.env = env
        self.arm = Arm(env.agent)
        self.gripper = OPEN
        """The command the gripper was last given; motions keep it."""
        self.left = 0
        """Steps that are known to follow the present one: those left of a motion or a grip, and
        `and_then`.
        """
        self.and_then = 0
        """Steps that the caller will add to the motion under way."""
        self.step = step
        self._on_waypoint = on_waypoint

    def move_to(self, pose: sapien.Pose, gripper: float | None = None) -> None:
        """Move the tool to a pose: straight if possible, else by a detour.

        Args:
            pose: of the tool centre point in the world.
            gripper: announce the pose as a waypoint with this gripper command; None announces
                nothing.

        Raises:
            PlanningError: neither a screw motion nor sampling found a way; nothing has moved.
        """
        self.announce(pose, gripper)
        velocity, acceleration = LIMITS[self.env.stick]
        # The screw planner has no randomness: what fails once fails always.
        qpos = np.asarray(self.env.qpos, np.float64 if self.env.stick else np.float32)
        plan = plan_screw(self.arm, qpos, pose, velocity, acceleration, np.float32)
        if plan is None:
            for seed in range(FREE_TRIES):
                detour = plan_free(self.arm, self.env.qpos, pose, velocity, acceleration, seed=seed)
                if detour is not None and (plan is None or len(detour) < len(plan)):
                    plan = detour
                if plan is not None and len(plan) <= LONG_DETOUR:
                    break
        if plan is None:
            place = [round(float(x), 4) for x in pose.p]
            orientation = [round(float(x), 4) for x in pose.q]
            raise PlanningError(
                f"No way to {place}, orientation {orientation} (wxyz): out of the arm's reach or"
                " blocked."
            )
        self.follow(plan)

    def follow(self, targets: Iterable[np.ndarray]) -> None:
        """Perform one control step for each row of joint targets [7]."""
        rows = list(targets)
        for done, joints in enumerate(rows, 1):
            self.left = len(rows) - done + self.and_then
            self._command(joints)

    def announce(self, pose: sapien.Pose, gripper: float | None) -> None:
        """Report a waypoint; the stick's are always closed."""
        if gripper is not None and self._on_waypoint is not None:
            self._on_waypoint(pose, CLOSE if self.env.stick else gripper)

    def open(self) -> None:
        """Open the gripper, holding the arm; the stick has none, and nothing happens."""
        self._move_gripper(OPEN)

    def close(self) -> None:
        """Likewise, close it."""
        self._move_gripper(CLOSE)

    def hold(self, n: int) -> None:
        """Wait with an open gripper for `n` steps, rounded up to whole gripper motions."""
        for _ in range(math.ceil(n / GRIPPER_STEPS)):
            self.open()

    def hold_until(self, k: int) -> None:
        """Wait with a closed gripper until at least `k` steps of the episode are done."""
        while self.env.steps_done < k:
            self.close()

    def go_home(self) -> None:
        """Move above the middle of the table and open the gripper."""
        self.move_to(self.at(HOME))
        self.open()

    def hard_reset(self, n: int = 30, qpos: np.ndarray | None = None) -> None:
        """Open the gripper and send the arm back at once, without a planned motion.

        Args:
            n: steps of the command that follows the opening.
            qpos: joint angles to go to, [7]; by default those of the reset.
        """
        self.open()
        if qpos is None:
            qpos = self.env.reset_action
        for _ in range(n):
            self._command(qpos)
            # Only now: tasks restore their objects after each step but the first.
            self.env.reset_in_progress = True
        self.env.reset_in_progress = False
        self.env.after_video = True

    def at(self, position: Iterable[float], q: np.ndarray | None = None) -> sapien.Pose:
        """A pose of the tool at a place [3], by default with its present orientation."""
        if q is None:
            q = self.env.tcp_pose.q
        return sapien.Pose(list(position), q)

    def _move_gripper(self, command: float) -> None:
        if self.env.stick:
            return
        self.gripper = command
        qpos = self.env.qpos
        for done in range(1, GRIPPER_STEPS + 1):
            self.left = GRIPPER_STEPS - done
            self._command(qpos)

    def _command(self, joints: np.ndarray) -> None:
        arm = np.asarray(joints, np.float64)[:ARM_JOINTS]
        self.step(arm if self.env.stick else np.append(arm, self.gripper))
