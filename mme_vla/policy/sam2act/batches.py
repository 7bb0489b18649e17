"""What SAM2Act+ learns from: keyframes with their clouds and the waypoints that follow them."""

from dataclasses import dataclass

from torch import Tensor

from mme_vla.types import TensorStruct


@dataclass
class KeyframeBatch(TensorStruct):
    """Sequences of k keyframes; k is 1 where single transitions are learnt.

    points: [b, k, n, 3], metres in the world, bounds not applied yet. colours: [b, k, n, 3] uint8.
    state: [b, k, p]. language: [b, l, w] the goal's tokens.
    target: [b, k, 3], metres. rotation: [b, k, 4], quaternions (x, y, z, w). gripper, collision: [b, k] int64.
    """

    points: Tensor
    colours: Tensor
    state: Tensor
    language: Tensor
    target: Tensor
    rotation: Tensor
    gripper: Tensor
    collision: Tensor
