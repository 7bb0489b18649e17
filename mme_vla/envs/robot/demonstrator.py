"""Whoever shows how a task is done: everything the robot can be made to do, as one object."""

from mme_vla.envs.robot.control import PlanningError
from mme_vla.envs.robot.gripper_skills import GripperPrimitives
from mme_vla.envs.robot.peg_skills import PegPrimitives
from mme_vla.envs.robot.stick_skills import StickPrimitives

__all__ = ["Demonstrator", "PlanningError"]


class Demonstrator(GripperPrimitives, PegPrimitives, StickPrimitives):
    """Performs the primitives that demonstrations and multi-choice options are made of.

    Motions are planned from where the arm is and carried out without looking; the same scene gives the same steps.
    Waypoints are announced before the motion that leads there.

    Example:
        >>> demonstrator = Demonstrator(env, env.step)  # doctest: +SKIP
        >>> demonstrator.pick(env.cubes[0])  # doctest: +SKIP
    """
