"""Forward and inverse kinematics of the arm.

Poses are in the world unless named otherwise; the model itself works in the base frame. Radians and metres.
"""

from typing import Any

import numpy as np
import sapien

from mme_vla.embodiment.robomme import ARM_JOINTS

LIMIT_TOLERANCE = 1e-3
"""Tolerance of the joint limits, radians (metres for the fingers)."""
IK_TOLERANCE = 1e-3
"""Largest accepted distance of an inverse-kinematics solution: metres plus the chord of the two quaternions."""
_RESTARTS = 19
_STEP, _DAMPING, _CONVERGED, _ITERATIONS = 0.1, 1e-12, 1e-5, 1000


class Arm:
    """The kinematic model of a ManiSkill Panda, with gripper or with stick.

    Joint vectors may be [7] (the arm) or longer (arm, then fingers, which do not move the tool centre point).

    Args:
        agent: a ManiSkill agent on the CPU simulator whose `tcp` is the tool centre point's link.
    """

    def __init__(self, agent: Any) -> None:
        articulation = agent.robot._objs[0]
        self._model = articulation.create_pinocchio_model()
        self._tcp = articulation.links.index(agent.tcp._objs[0])
        self._wrist = next(i for i, link in enumerate(articulation.links) if link.name.endswith("panda_link7"))
        self._dof = int(articulation.dof)
        self.base = sapien.Pose(articulation.root_pose.p, articulation.root_pose.q)
        """The base's pose in the world."""
        limits = np.asarray(articulation.qlimits, np.float64)[:ARM_JOINTS]
        self.lower, self.upper = limits[:, 0], limits[:, 1]
        """Joint limits of the arm, [7] each."""

    def forward(self, qpos: np.ndarray) -> sapien.Pose:
        """Pose of the tool centre point in the world."""
        return self.base * self.forward_in_base(qpos)

    def forward_in_base(self, qpos: np.ndarray) -> sapien.Pose:
        """Pose of the tool centre point in the frame of the robot's base."""
        self._model.compute_forward_kinematics(self._padded(qpos))
        return self._model.get_link_pose(self._tcp)

    def wrist_in_base(self) -> sapien.Pose:
        """Pose of the hand's mounting, in the base frame, at the joints of the last `forward_in_base`."""
        return self._model.get_link_pose(self._wrist)

    def jacobian(self, qpos: np.ndarray) -> np.ndarray:
        """Spatial Jacobian [6, 7] in the base frame: linear velocity of the point at its origin, then angular."""
        self._model.compute_full_jacobian(self._padded(qpos))
        return np.asarray(self._model.get_link_jacobian(self._tcp, False))[:, :ARM_JOINTS]

    def within_limits(self, qpos: np.ndarray) -> bool:
        """Whether every arm joint is inside its limits, up to `LIMIT_TOLERANCE`."""
        arm = np.asarray(qpos)[:ARM_JOINTS]
        return bool(np.all(arm >= self.lower - LIMIT_TOLERANCE) and np.all(arm <= self.upper + LIMIT_TOLERANCE))

    def ik(self, pose: sapien.Pose, qpos: np.ndarray) -> np.ndarray | None:
        """Joint angles that bring the tool centre point to a pose, by damped closed-loop iteration.

        The iteration starts at the given joints, and, where that does not converge within the limits, at up to 19
        random configurations, always the same ones. Angles are wrapped into the limits where a full turn allows it.

        Args:
            pose: target in the world.
            qpos: where to start, [7] or longer.

        Returns:
            The first solution [7] within the limits and `IK_TOLERANCE`, or None.
        """
        target = self.base.inv() * pose
        start = self._padded(qpos)
        random = np.random.default_rng(0)
        for _ in range(1 + _RESTARTS):
            result, _, _ = self._model.compute_inverse_kinematics(
                self._tcp,
                target,
                start,
                np.arange(self._dof) < ARM_JOINTS,
                _CONVERGED,
                _ITERATIONS,
                _STEP,
                _DAMPING,
            )
            arm = self._wrapped(np.asarray(result)[:ARM_JOINTS])
            if self.within_limits(arm) and pose_distance(self.forward_in_base(arm), target) < IK_TOLERANCE:
                return arm
            start = self._padded(random.uniform(self.lower, self.upper))
        return None

    def _padded(self, qpos: np.ndarray) -> np.ndarray:
        full = np.zeros(self._dof)
        full[:ARM_JOINTS] = np.asarray(qpos, np.float64)[:ARM_JOINTS]
        return full

    def _wrapped(self, arm: np.ndarray) -> np.ndarray:
        revolutions = np.floor((arm - self.lower + LIMIT_TOLERANCE) / (2 * np.pi))
        return arm - 2 * np.pi * revolutions


def pose_distance(a: sapien.Pose, b: sapien.Pose) -> float:
    """Distance of two poses: metres between the origins plus the chord between the quaternions."""
    return float(np.linalg.norm(a.p - b.p) + min(np.linalg.norm(a.q - b.q), np.linalg.norm(a.q + b.q)))
