"""Motion plans for the arm: a straight screw motion of the tool, and an RRT* path in joint space
where that fails.

Both give joint angles to be used as targets, one row a control step. Their timing is the fastest
one that keeps every joint below a velocity and an acceleration limit, so the number of steps
follows from the path.
"""

import logging
from typing import Any

import numpy as np
import sapien
import toppra
from ompl import base, geometric, util
from toppra import algorithm, constraint
from transforms3d.quaternions import mat2quat, quat2mat

from mme_vla.embodiment.robomme import ARM_JOINTS
from mme_vla.envs.robomme.robot.kinematics import Arm, matrix_of

CONTROL_STEP = 0.05
"""Seconds between two rows of a plan: the control period."""
JOINT_STEP = 0.1
"""Length of one step along a screw motion, in joint space (radians, Euclidean norm)."""
MOST_STEPS = 200
"""Steps after which a screw motion is given up: at the edge of its reach the arm would swing for
ever.
"""
_STALLED = 1e-4
_NO_ROTATION = 3e-5
_PI_TOLERANCE = 1e-5
# The trace of a rotation matrix within these of 3 and of -1: the angle is then below 0.0055, or
# within 0.0032 of pi.

logging.getLogger("toppra").setLevel(logging.ERROR)


def plan_screw(
    arm: Arm,
    qpos: np.ndarray,
    target_pose: sapien.Pose,
    velocity_limit: float = 0.9,
    acceleration_limit: float = 0.9,
    precision: type[np.floating[Any]] = np.float64,
) -> np.ndarray | None:
    """Move the tool to a pose along one screw: rotation about, and translation along, a single
    axis.

    The displacement's twist is followed by the pseudo-inverse of the Jacobian, in joint steps of
    norm `JOINT_STEP`. Differences in orientation below 0.0055 radians are left as they are.
    Collisions are not examined.

    Args:
        arm: the kinematic model.
        qpos: present joint angles, [7] or longer. The path keeps their precision, as in `mplib`:
            single in official demonstrations of the gripper, double in those of the stick.
        target_pose: of the tool centre point in the world.
        velocity_limit, acceleration_limit: of every joint, rad/s and rad/s².
        precision: in which the length of the target's quaternion is summed; single in official
            demonstrations.

    Returns:
        Joint targets [n, 7], the first being the present angles; None where a joint limit is in the
        way, the motion stalls at a singularity, or the displacement turns the tool by half a turn.
    """
    joints = np.array(qpos)[:ARM_JOINTS]
    goal = goal_in_base(arm.base, target_pose, precision)
    displacement = goal @ np.linalg.inv(arm.transform(joints))
    remaining = twist_of(displacement)
    if remaining is None:
        return None
    path = [joints.copy()]
    arrived = False
    while not arrived:
        jacobian = arm.jacobian(joints)
        step = np.linalg.pinv(jacobian) @ remaining
        length = np.linalg.norm(step)
        if length == 0:
            return None
        step *= JOINT_STEP / length
        motion = jacobian @ step
        overshoot = np.linalg.norm(motion) / max(np.linalg.norm(remaining), np.finfo(float).tiny)
        arrived = bool(overshoot > 1)
        if arrived:
            step, motion = step / overshoot, motion / overshoot
        joints = (joints + step).astype(joints.dtype)
        remaining = remaining - motion
        if np.linalg.norm(motion) < _STALLED or not arm.within_limits(joints):
            return None
        path.append(joints)
        if len(path) > MOST_STEPS:
            return None
    return time_optimal(np.array(path), velocity_limit, acceleration_limit)


def plan_free(
    arm: Arm,
    qpos: np.ndarray,
    target_pose: sapien.Pose,
    velocity_limit: float = 0.9,
    acceleration_limit: float = 0.9,
    seed: int = 0,
) -> np.ndarray | None:
    """Move the tool to a pose along a joint path found by sampling (RRT*); the fallback of
    `plan_screw`.

    Args:
        seed: of the samples; the others as in `plan_screw`.

    Returns:
        Joint targets [n, 7], the first being the present angles; None where the pose is out of
        reach or no path exists.
    """
    start = np.asarray(qpos, np.float64)[:ARM_JOINTS]
    goal = arm.ik(target_pose, start)
    if goal is None:
        return None
    path = sample_path(arm, start, goal, seed)
    if path is None:
        return None
    return time_optimal(path, velocity_limit, acceleration_limit)


def time_optimal(
    path: np.ndarray, velocity_limit: float, acceleration_limit: float
) -> np.ndarray | None:
    """The fastest passage through joint waypoints, sampled.

    A cubic spline through the waypoints, which are spaced evenly in its parameter, is given
    constant accelerations between grid points (TOPP-RA, Pham and Pham 2018) and sampled at
    floor(duration / `CONTROL_STEP`) times.

    Args:
        path: joint waypoints [k, 7], k at least 2.
        velocity_limit, acceleration_limit: of every joint, rad/s and rad/s².

    Returns:
        Joint targets [n, 7], or None where no passage within the limits exists.
    """
    joints = path.shape[1]
    spline = toppra.SplineInterpolator(np.linspace(0, 1, len(path)), path)
    limits = [
        constraint.JointVelocityConstraint(np.full(joints, velocity_limit)),
        constraint.JointAccelerationConstraint(np.full(joints, acceleration_limit)),
    ]
    timing = algorithm.TOPPRA(limits, spline, parametrizer="ParametrizeConstAccel")
    passage = timing.compute_trajectory()
    if passage is None:
        return None
    times = np.linspace(0, passage.duration, int(passage.duration / CONTROL_STEP))
    return np.asarray(passage(times))


def goal_in_base(
    base_pose: sapien.Pose, target_pose: sapien.Pose, precision: type[np.floating[Any]]
) -> np.ndarray:
    """A pose in the world as a matrix [4, 4] in the base's frame, rounded as by `mplib` with NumPy
    1.

    The rotation is divided by the quaternion's squared length, summed in `precision`. In single
    precision this length is off by up to 1e-7, and the goal is turned by up to 1e-9.
    """
    w, x, y, z = np.asarray(target_pose.q, precision)
    summed = w * w + x * x + y * y + z * z
    exact = np.square(target_pose.q, dtype=np.float64).sum()
    goal = matrix_of(target_pose)
    goal[:3, :3] = np.eye(3) + exact / float(summed) * (goal[:3, :3] - np.eye(3))
    goal = np.linalg.inv(matrix_of(base_pose)) @ goal
    goal[:3, :3] = quat2mat(mat2quat(goal[:3, :3]))
    return goal


def twist_of(transform: np.ndarray) -> np.ndarray | None:
    """Exponential coordinates [6] of a rigid displacement [4, 4], linear part first; None for half
    a turn.
    """
    rotation, translation = transform[:3, :3], transform[:3, 3]
    trace = np.trace(rotation)
    if abs(trace - 3) <= _NO_ROTATION:
        return np.concatenate([translation, np.zeros(3)])
    if abs(trace + 1) <= _PI_TOLERANCE:
        return None
    angle = np.arccos((trace - 1) / 2)
    x = rotation[2, 1] - rotation[1, 2]
    y = rotation[0, 2] - rotation[2, 0]
    z = rotation[1, 0] - rotation[0, 1]
    axis = np.array([x, y, z]) / (2 * np.sin(angle))
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    # Inverse of the left Jacobian of SO(3): from the displacement's translation to the twist's
    # linear part.
    linear = np.eye(3) - angle / 2 * cross + (1 - angle / 2 / np.tan(angle / 2)) * cross @ cross
    return np.concatenate([linear @ translation, angle * axis])


RESOLUTION = 0.05
"""Joint distance between two configurations that are checked on an edge, radians."""
REACH = 0.5
"""Longest edge that the tree grows, radians."""
GOAL_BIAS = 0.2
ROUNDS = 1500
"""Iterations of the sampler; a number, not a time, so that the same seed gives the same path on any
load.
"""
WRIST_CLEARANCE = 0.03
COLUMN_RADIUS, COLUMN_HEIGHT = 0.15, 0.45
"""The robot's base and shoulder as a cylinder that the hand keeps out of, metres."""


class Obstacles:
    """Whether the arm is clear of the table and of the robot's own column.

    The tool may go as low as in `ends`, the start and goal configurations [7].
    """

    def __init__(self, arm: Arm, ends: list[np.ndarray]) -> None:
        self._arm = arm
        lowest = 0.0
        for end in ends:
            tool, _ = arm.heights(end)
            lowest = min(lowest, tool[2] + arm.base.p[2])
        self._floor = lowest - 1e-3

    def clear(self, joints: np.ndarray) -> bool:
        """Whether one configuration [7] is free."""
        tool, wrist = self._arm.heights(joints)
        for place in (tool, wrist):
            if np.linalg.norm(place[:2]) < COLUMN_RADIUS and place[2] < COLUMN_HEIGHT:
                return False
        height = self._arm.base.p[2]
        return bool(tool[2] + height >= self._floor and wrist[2] + height >= WRIST_CLEARANCE)

    def clear_between(self, a: np.ndarray, b: np.ndarray) -> bool:
        """Whether the straight joint path between two configurations is free, the first one not
        examined.
        """
        steps = max(1, int(np.ceil(np.linalg.norm(b - a) / RESOLUTION)))
        return all(self.clear(a + (b - a) * i / steps) for i in range(1, steps + 1))


def sample_path(arm: Arm, start: np.ndarray, goal: np.ndarray, seed: int) -> np.ndarray | None:
    """Joint waypoints [k, 7] from start to goal: the straight line if it is free, else what OMPL's
    RRT* finds.

    Args:
        start, goal: joint angles [7].
        seed: of the samples.

    Returns:
        The path, or None after `ROUNDS` iterations.
    """
    obstacles = Obstacles(arm, [start, goal])
    if obstacles.clear_between(start, goal):
        return np.array([start, goal])
    util.setLogLevel(util.LOG_NONE)
    util.RNG.setSeed(seed + 1)  # zero means the time of day
    space = base.RealVectorStateSpace(ARM_JOINTS)
    bounds = base.RealVectorBounds(ARM_JOINTS)
    for joint, (low, high) in enumerate(zip(arm.lower, arm.upper, strict=True)):
        bounds.setLow(joint, min(low, start[joint], goal[joint]))
        bounds.setHigh(joint, max(high, start[joint], goal[joint]))
    space.setBounds(bounds)
    setup = geometric.SimpleSetup(space)
    setup.setStateValidityChecker(lambda state: obstacles.clear(_joints(state)))
    information = setup.getSpaceInformation()
    information.setStateValidityCheckingResolution(RESOLUTION / space.getMaximumExtent())
    setup.setStartAndGoalStates(_state(space, start), _state(space, goal))
    planner = geometric.RRTstar(information)
    planner.setRange(REACH)
    planner.setGoalBias(GOAL_BIAS)
    setup.setPlanner(planner)
    rounds = iter(range(ROUNDS))
    setup.solve(base.PlannerTerminationCondition(lambda: next(rounds, None) is None))
    if not setup.haveExactSolutionPath():
        return None
    between = [_joints(state) for state in setup.getSolutionPath().getStates()[1:-1]]
    path = [start, *between, goal]

    # Leave out what a straight line can skip, then space the rest evenly, so that a spline stays
    # near it.
    points = [start]
    i = 0
    while i < len(path) - 1:
        j = len(path) - 1
        while j > i + 1 and not obstacles.clear_between(path[i], path[j]):
            j -= 1
        steps = int(np.ceil(np.linalg.norm(path[j] - path[i]) / REACH))
        for k in range(1, steps):
            points.append(path[i] + (path[j] - path[i]) * k / steps)
        points.append(path[j])
        i = j
    return np.array(points)


def _joints(state: Any) -> np.ndarray:
    return np.array([state[joint] for joint in range(ARM_JOINTS)])


def _state(space: Any, joints: np.ndarray) -> Any:
    state = space.allocState()
    for joint, angle in enumerate(joints):
        state[joint] = float(angle)
    return state
