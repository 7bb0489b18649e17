"""`NetworkPolicy`: what policies of one network share: precision, memory tokens and
stored frames.
"""

import hashlib
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from mme_vla.backbone.layers import autocast
from mme_vla.backbone.siglip import pool_grid
from mme_vla.errors import UserError
from mme_vla.policy.base import Policy, PolicyInfo
from mme_vla.policy.episode import Episode
from mme_vla.policy.tensor_files import dtype_of
from mme_vla.speed.sharding import ShardGroup, stacked_layers
from mme_vla.types import MemoryTokens

if TYPE_CHECKING:
    from mme_vla.processing.base import PolicyProcessor


class MemoryTower(NamedTuple):
    """The vision tower whose tokens a memory stores.

    encode: images [n, 3, image_size, image_size] as the tower takes them → tokens [n, s², width].
    settings: what else its tokens depend on, for the fingerprint.
    """

    tower: nn.Module
    encode: Callable[[Tensor], Tensor]
    width: int
    image_size: int
    settings: Sequence[str] = ()


class NetworkPolicy(Policy):
    """A policy of one network.

    A subclass sets its modules, `memory` and the fields of `info` that have other values, and
    implements `memory_tower` if it has a memory, `frames_read` if its episodes read frames of which
    no memory knows, and what `Policy` requires.
    """

    action_dim: int
    """Width of a chunk inside the network. The embodiment's own actions are its first columns."""

    acts_in_bfloat16: ClassVar[bool] = False
    """Whether `dtype="auto"` rounds its weights to bfloat16 on a GPU."""

    def __init__(
        self,
        processor: "PolicyProcessor | None" = None,
        config: Mapping[str, Any] | None = None,
        *,
        compute_dtype: str = "float32",
        history_dtype: str = "bfloat16",
        augment: bool = True,
    ) -> None:
        """Keep the settings.

        Args:
            processor: needed for episodes and data; the network alone runs on batches without it.
            config: what `from_config` was given; saved with the weights.
            compute_dtype: `bfloat16` runs matrix products under autocast over the float32 master
                weights.
            history_dtype: dtype of stored vision tokens; bfloat16 as released.
            augment: augment the current views while training.
        """
        super().__init__()
        self.processor = processor
        self.config = dict(config or {})
        self.augment = augment
        self.compute_dtype = dtype_of(compute_dtype, "policy.compute_dtype")
        self.info = PolicyInfo(history_dtype=dtype_of(history_dtype, "policy.history_dtype"))

    def autocast(self) -> torch.autocast:
        """The context all network code runs in."""
        return autocast(self.device, self.compute_dtype)

    # Memory

    @property
    def memory_tower(self) -> MemoryTower:
        """The tower of the stored vision tokens."""
        raise NotImplementedError

    @torch.no_grad()
    def encode_memories(self, episodes: Sequence[Episode]) -> MemoryTokens | None:
        """Encode the histories of running episodes, with their streams; None without memory."""
        if self.memory is None:
            return None
        histories = []
        for episode in episodes:
            episode.read = episode.required_history()
            histories.append(episode.read)
        with self.autocast():
            return self.memory.encode(histories, [episode.stream for episode in episodes])

    @torch.no_grad()
    def prepare(self, episode: Episode) -> bool:
        """Read a piece of what the next memory tokens need; return whether more remain."""
        if self.memory is None or episode.read is None:
            return False
        with self.autocast():
            return self.memory.prepare(episode.read, episode.stream)

    def frames_read(self, steps: np.ndarray, exec_start: int) -> np.ndarray | None:
        """Frames that the memory reads; none without memory."""
        if self.memory is None:
            return np.zeros(0, np.int64)
        return self.memory.frames_read(steps, exec_start)

    # Cost

    def shard_groups(self) -> Sequence[ShardGroup]:
        """Modules whose weights sharded processes gather one by one. All other weights are gathered
        for a whole pass, in float32.
        """
        return [ShardGroup(layer) for layer in stacked_layers(self)]

    def full_batch(self, device: torch.device | str = "cpu") -> Any:
        """A batch of one at its fullest: every view, the longest prompt, a full memory, actions to
        learn from.

        Raises:
            UserError: this kind of policy makes none, so its cost cannot be counted.
        """
        raise UserError(
            f"{type(self).__name__} has no full_batch(), which `mme-vla analyse cost` counts."
        )

    @torch.no_grad()
    def encode_frames(self, frames: np.ndarray | Tensor, batch_size: int = 32) -> Tensor:
        """Encode memory-view frames [n, H, W, 3] uint8 into stored tokens [n, grid², d_vision]."""
        storage = self.require_memory().storage
        source = self.memory_tower
        device = self.device
        processor = self.require_processor()
        empty = torch.zeros(
            0, storage.grid**2, source.width, dtype=self.info.history_dtype, device=device
        )
        encoded = [empty]
        for start in range(0, len(frames), batch_size):
            images = processor.memory_images(frames[start : start + batch_size], device=device)
            with self.autocast():
                tokens = pool_grid(source.encode(images), storage.grid, storage.pooling)
                encoded.append(tokens.to(empty))
        return torch.cat(encoded)

    def vision_fingerprint(self) -> str:
        """Hash the memory's vision tower, its dtype and the settings that a cache of its tokens
        depends on.
        """
        source = self.memory_tower
        digest = hashlib.sha256(str(self.compute_dtype).encode())
        for name, tensor in sorted(source.tower.state_dict().items()):
            digest.update(name.encode())
            digest.update(tensor.detach().float().cpu().contiguous().numpy().tobytes())
        for setting in filter(None, source.settings):
            digest.update(setting.encode())
        return digest.hexdigest()
