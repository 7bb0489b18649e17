"""Forward and inverse kinematics of the arm by Pinocchio, in double precision.

The simulator's own kinematic model rounds poses to single precision, which screw plans and then
contacts amplify. Poses are in the world unless named otherwise; the model itself works in the base
frame. Radians and metres.
"""

from functools import cache
from typing import Any

import numpy as np
import pinocchio
import sapien
from transforms3d.quaternions import quat2mat

from mme_vla.embodiment.robomme import ARM_JOINTS

TCP, WRIST = "panda_hand_tcp", "panda_link7"
LIMIT_TOLERANCE = 1e-3
"""Tolerance of the joint limits, radians (metres for the fingers)."""
IK_TOLERANCE = 1e-3
"""Largest accepted distance of an inverse-kinematics solution: metres plus the chord of the two
quaternions.
"""
_RESTARTS = 19
_STEP, _DAMPING, _CONVERGED, _ITERATIONS = 0.1, 1e-12, 1e-5, 1000


@cache
def _model(urdf: str) -> Any:
    return pinocchio.buildModelFromUrdf(urdf)


def matrix_of(pose: sapien.Pose) -> np.ndarray:
    """A pose as a homogeneous matrix [4, 4] in double precision."""
    matrix = np.eye(4)
    matrix[:3, :3] = quat2mat(np.asarray(pose.q, np.float64))
    matrix[:3, 3] = np.asarray(pose.p, np.float64)
    return matrix


class Arm:
    """The kinematic model of a ManiSkill Panda, with gripper or with stick.

    Joint vectors may be [7] (the arm) or longer (arm, then fingers, which do not move the tool
    centre point).

    Args:
        agent: a ManiSkill agent on the CPU simulator whose tool centre point's link is `TCP`.
    """

    def __init__(self, agent: Any) -> None:
        articulation = agent.robot._objs[0]
        self._model = _model(str(agent.urdf_path))
        self._data = self._model.createData()
        self._tcp = self._model.getFrameId(TCP)
        self._wrist = self._model.getFrameId(WRIST)
        self.base = sapien.Pose(articulation.root_pose.p, articulation.root_pose.q)
        """The base's pose in the world."""
        limits = np.asarray(articulation.qlimits, np.float64)[:ARM_JOINTS]
        self.lower, self.upper = limits[:, 0], limits[:, 1]
        """Joint limits of the arm, [7] each."""

    def forward(self, qpos: np.ndarray) -> sapien.Pose:
        """Pose of the tool centre point in the world."""
        return self.base * sapien.Pose(self.transform(qpos))

    def transform(self, qpos: np.ndarray) -> np.ndarray:
        """Pose of the tool centre point in the frame of the robot's base, as a homogeneous matrix
        [4, 4] in double precision.
        """
        return np.array(self._place(self._padded(qpos), self._tcp).homogeneous)

    def heights(self, qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Places [3] of the tool centre point and of the hand's mounting, in the base frame."""
        tool = np.array(self._place(self._padded(qpos), self._tcp).translation)
        wrist = pinocchio.updateFramePlacement(self._model, self._data, self._wrist)
        return tool, np.array(wrist.translation)

    def jacobian(self, qpos: np.ndarray) -> np.ndarray:
        """Spatial Jacobian [6, 7] in the base frame: linear velocity of the point at its origin,
        then angular.
        """
        joints = self._padded(qpos)
        frame = pinocchio.ReferenceFrame.WORLD
        full = pinocchio.computeFrameJacobian(self._model, self._data, joints, self._tcp, frame)
        return np.array(full)[:, :ARM_JOINTS]

    def within_limits(self, qpos: np.ndarray) -> bool:
        """Whether every arm joint is inside its limits, up to `LIMIT_TOLERANCE`."""
        arm = np.asarray(qpos)[:ARM_JOINTS]
        return bool(
            np.all(arm >= self.lower - LIMIT_TOLERANCE)
            and np.all(arm <= self.upper + LIMIT_TOLERANCE)
        )

    def ik(self, pose: sapien.Pose, qpos: np.ndarray) -> np.ndarray | None:
        """Joint angles that bring the tool centre point to a pose, by damped closed-loop iteration.

        The iteration starts at the given joints, and, where that does not converge within the
        limits, at up to 19 random configurations, always the same ones. Angles are wrapped into the
        limits where a full turn allows it.

        Args:
            pose: target in the world.
            qpos: where to start, [7] or longer.

        Returns:
            The first solution [7] within the limits and `IK_TOLERANCE`, or None.
        """
        target = np.linalg.inv(matrix_of(self.base)) @ matrix_of(pose)
        start = self._padded(qpos)
        goal = pinocchio.SE3(target)
        frame = pinocchio.ReferenceFrame.LOCAL
        damping = _DAMPING * np.eye(6)
        random = np.random.default_rng(0)
        for _ in range(1 + _RESTARTS):
            # Follow the displacement to the target.
            joints = start.copy()
            for _ in range(_ITERATIONS):
                error = pinocchio.log6(goal.actInv(self._place(joints, self._tcp))).vector
                if np.linalg.norm(error) < _CONVERGED:
                    break
                jacobian = pinocchio.computeFrameJacobian(
                    self._model, self._data, joints, self._tcp, frame
                )[:, :ARM_JOINTS]
                step = jacobian.T @ np.linalg.solve(jacobian @ jacobian.T + damping, error)
                joints[:ARM_JOINTS] -= _STEP * step
            arm = joints[:ARM_JOINTS].copy()
            arm -= 2 * np.pi * np.floor((arm - self.lower + LIMIT_TOLERANCE) / (2 * np.pi))
            match = sapien.Pose(self.transform(arm))
            if self.within_limits(arm) and pose_distance(match, sapien.Pose(target)) < IK_TOLERANCE:
                return arm
            start = self._padded(random.uniform(self.lower, self.upper))
        return None

    def _place(self, joints: np.ndarray, frame: int) -> Any:
        pinocchio.forwardKinematics(self._model, self._data, joints)
        return pinocchio.updateFramePlacement(self._model, self._data, frame)

    def _padded(self, qpos: np.ndarray) -> np.ndarray:
        full = np.zeros(self._model.nq)
        full[:ARM_JOINTS] = np.asarray(qpos, np.float64)[:ARM_JOINTS]
        return full


def pose_distance(a: sapien.Pose, b: sapien.Pose) -> float:
    """Distance of two poses: metres between the origins plus the chord between the quaternions."""
    return float(
        np.linalg.norm(a.p - b.p) + min(np.linalg.norm(a.q - b.q), np.linalg.norm(a.q + b.q))
    )
