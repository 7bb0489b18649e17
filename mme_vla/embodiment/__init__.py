"""What a robot is to a policy: its cameras, its state and its actions."""

from mme_vla.embodiment.action_space import ActionSpace, Option
from mme_vla.embodiment.robomme import ROBOMME_JOINT
from mme_vla.embodiment.robot import Camera, Embodiment, State

__all__ = ["ROBOMME_JOINT", "ActionSpace", "Camera", "Embodiment", "Option", "State"]
