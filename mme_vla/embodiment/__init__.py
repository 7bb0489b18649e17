"""What a robot is to a policy: its cameras, its state and its actions."""

from mme_vla.embodiment.actions import ActionSpace
from mme_vla.embodiment.base import Camera, Embodiment, State
from mme_vla.embodiment.options import Option
from mme_vla.embodiment.robomme import ROBOMME_JOINT

__all__ = ["ROBOMME_JOINT", "ActionSpace", "Camera", "Embodiment", "Option", "State"]
