"""`Policy`: what training, evaluation, serving and weights speak to, whatever is inside."""

import re
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor

from mme_vla.embodiment import Embodiment
from mme_vla.embodiment.robomme import embodiment_of
from mme_vla.errors import UserError, brief
from mme_vla.memory.base import Memory
from mme_vla.policy.episode import Episode
from mme_vla.policy.saving import Saved
from mme_vla.speed.recompute import Recompute
from mme_vla.speed.sharding import ShardGroup, stacked_layers
from mme_vla.types import Noise, stack_noise

if TYPE_CHECKING:
    from mme_vla.processing.base import PolicyProcessor


class Policy(Saved):
    """A policy: a loss to train, chunks to sample, episodes to act in, parts to freeze or adapt, a folder to live in.

    A subclass registers in `POLICIES` (`policy.name` of a configuration), sets `memory` (or None), `processor`,
    `config`, `horizon` and `action_dim`, and implements what raises NotImplementedError. What a batch is, its processor
    says: whoever trains only moves it to a device. Random numbers come from outside (`training_noise`,
    `sampling_noise`), so that training resumes bit for bit, and the noise of an episode does not depend on its batch; only the policy knows
    what they mean.
    """

    memory: Memory | None
    processor: "PolicyProcessor | None"
    config: dict[str, Any]
    compute_dtype: torch.dtype = torch.float32
    """Matrix products run in it, under autocast."""
    history_dtype: torch.dtype = torch.bfloat16
    """Of stored vision tokens."""
    horizon: int
    """Steps of a chunk."""
    n_past_steps: int = 0
    """Steps at a chunk's beginning that lie in the past and are never executed."""
    n_distractor_episodes: int = 0
    """Unrelated episodes that it is shown before each of its own, as a stress split asks for them."""
    sample_steps: int = 1
    """Steps of its sampler unless told otherwise."""
    supports_rtc: bool = False
    """Whether its chunks can agree with actions that are already promised (`Episode.promise`)."""
    max_actions: int | None = None
    """Actions after which a rollout ends an episode as timed out, beside its limit of frames; None: that one alone."""
    action_dim: int
    """Width of a chunk inside the network; the embodiment's own actions are its first columns."""

    @property
    def device(self) -> torch.device:
        return next(self.parameters()).device

    @property
    def embodiment(self) -> Embodiment:
        """The robot this policy is for: its processor's, else its configuration's."""
        return embodiment_of(self.config) if self.processor is None else self.processor.embodiment

    # Training

    def training_noise(self, count: int, generator: torch.Generator) -> Noise:
        """The random numbers that the losses of `count` samples take, on the CPU: each value [count, …]."""
        return {}

    def augmentation_params(self, count: int, generator: torch.Generator) -> Noise:
        """The random numbers that change the images of `count` training samples, if any; beside `training_noise`'s."""
        return {}

    def forward(self, batch: Any, draws: Mapping[str, Tensor] | None = None) -> tuple[Tensor, dict[str, Tensor]]:
        """The loss of a batch, and metrics to log (detached).

        Args:
            batch: with `actions`. draws: as `training_noise` makes them, on the policy's device; fresh ones by default.
        """
        raise NotImplementedError

    def recompute(self, mode: Recompute) -> None:
        """Compute activations again in the backward pass instead of keeping them (all, or `selective`), or not."""
        raise NotImplementedError

    def shard_groups(self) -> Sequence[ShardGroup]:
        """What processes that share the weights gather together; all else is gathered for a whole pass, in float32."""
        return [ShardGroup(layer) for layer in stacked_layers(self)]

    # Sampling

    def sampling_noise(self, generator: torch.Generator) -> Noise:
        """The random numbers that one sampled chunk takes, on the CPU, without a batch axis."""
        return {}

    def sample_actions(self, batch: Any, draws: Mapping[str, Tensor] | None = None, steps: int | None = None) -> Tensor:
        """A normalised chunk [b, h, a].

        Args:
            draws: as `sampling_noise` makes them, with a batch axis, on the policy's device; fresh ones by default.
            steps: of an iterative head; its own number by default.
        """
        raise NotImplementedError

    def compile_sampling(self, layers: bool = False) -> None:
        """Make chunks quick, for a policy whose weights are done; see `MMEPolicy.compile_sampling`.

        Raises:
            UserError: this policy's sampler cannot be compiled.
        """
        raise UserError(f"{type(self).__name__} has no sampler that can be compiled: leave sampling=eager.")

    @property
    def compiles_sampling(self) -> bool:
        """Whether `compile_sampling` is for this policy."""
        return False

    # Episodes

    def start_episode(self, goal: str, seed: int = 0) -> Episode:
        """Begin an episode: its memory, its noise and its current view live in the returned object alone."""
        return Episode(self, goal, seed)

    def act(self, episodes: Episode | Sequence[Episode], steps: int | None = None) -> np.ndarray:
        """Choose the next chunk for one episode or for many in one batch, adding nothing to their memories.

        Returns:
            float32 [n, h, w], or [h, w] for one episode: actions as the embodiment executes them; without the first
            `skipped` of a chunk.
        """
        if isinstance(episodes, Episode):
            alone: np.ndarray = self.act([episodes], steps)[0]
            return alone
        if not episodes:
            return np.zeros((0, self.horizon - self.n_past_steps, self.embodiment.action.width), np.float32)
        processor = self.require_processor()
        if not self.supports_rtc and any(e.action_prefix is not None for e in episodes):
            name = self.config.get("name", type(self).__name__)
            raise UserError(
                f"{name} answers without regard to what was promised: real-time chunking needs a policy whose actions "
                "are a flow, such as π0.5's. Leave out set_action_prefix()."
            )
        processor.require_stats()  # before any episode's noise or memory moves on
        batch = self.observation(episodes)
        draws = stack_noise([e.draw() for e in episodes])
        was_training = self.training
        self.eval()
        try:
            chunk = self.answer(batch, episodes, draws, steps).float().cpu()
        finally:
            self.train(was_training)
        states, space = torch.stack([e.state for e in episodes]), self.embodiment.action
        absolute = processor.absolute_actions(chunk, states)
        decided = [space.decide(rows, e.options) for rows, e in zip(absolute, episodes, strict=True)]
        actions = torch.stack(decided).numpy()[:, self.n_past_steps :]
        for episode, actions_of in zip(episodes, actions, strict=True):
            episode.acted(actions_of)
        return actions

    def prepare(self, episode: Episode) -> bool:
        """Do a piece of what an episode's next chunk will need, in time in which nobody waits; no action changes.

        Server and rollouts call it while robots move: a recurrent memory whose list of frames is full would otherwise
        take all of them anew when the next chunk is asked for.

        Returns:
            Whether a piece is left.
        """
        return False

    def observation(self, episodes: Sequence[Episode]) -> Any:
        """What running episodes see now, as a batch of the processor's kind on the policy's device."""
        raise NotImplementedError

    def answer(
        self, batch: Any, episodes: Sequence[Episode], draws: Mapping[str, Tensor], steps: int | None = None
    ) -> Tensor:
        """A normalised chunk [n, h, a] for what `observation` saw, through what the episodes remember."""
        raise NotImplementedError

    def frames_read(self, steps: np.ndarray, exec_start: int) -> np.ndarray | None:
        """Which frames of the memory camera are looked at, beside the current ones, when acting at these steps.

        A simulation draws no others. By default None: every frame of every camera may be.

        Args:
            steps: [n] current frames, video included. exec_start: the first execution frame.

        Returns:
            int64 [n], ascending, each once; or None.
        """
        return None

    def encode_frames(self, frames: np.ndarray) -> Tensor:
        """Memory-view frames [n, H, W, 3] uint8 → pooled tokens [n, grid², d_vision] as a history stores them.

        Only policies with a memory that stores vision tokens are asked.
        """
        raise NotImplementedError

    def vision_fingerprint(self) -> str:
        """A hash of what the tokens of `encode_frames` depend on, and a cache of them."""
        raise NotImplementedError

    def check_processor(self, source: str) -> None:
        """Make sure that the network and its processor are for the same robot; a subclass compares their sizes too."""
        processor = self.require_processor()
        robot = embodiment_of(self.config)
        if self.config.get("embodiment") is not None and robot != processor.embodiment:
            raise UserError(
                f"{source}: the processor is of the robot {brief(processor.embodiment.name)} and the configuration of "
                f"{brief(robot.name)}, or the two say different things of it. The files are from two checkpoints, or "
                "one was changed."
            )

    # Costs

    def full_batch(self, device: torch.device | str = "cpu") -> Any:
        """A batch of one without content, at its fullest: every view and word, a full memory, actions to learn from."""
        raise NotImplementedError

    def warm_up_vision(self) -> None:
        """Run the vision tower on one black memory frame."""
        raise NotImplementedError

    # Parts

    frozen: str | None = None
    """Pattern of the parameters that never learn, whatever fine-tuning asks for."""
    keyframes: int = 1
    """Keyframes of a training sample, where samples are such."""
    lora_targets: Sequence[str] = ()
    """Linear layers that LoRA wraps unless told otherwise, by the end of their name."""
    heads: Sequence[str] = ()
    """Modules that learn in full beside the adapters, by the end of their name."""
    lora_exclude: str | None = None
    """Pattern of linear layers whose weight is read past any adapter that wraps them."""

    def parts(self) -> Mapping[str, str]:
        """Part → pattern of its parameters' names, in order; the first that matches decides.

        Fine-tuning, `inspect` and reports speak of these: `vision`, `vlm`, `action`, `memory`.
        """
        raise NotImplementedError

    def component_of(self, name: str) -> str:
        """The part that a parameter belongs to."""
        for part, pattern in self.parts().items():
            if re.match(pattern, name):
                return part
        raise ValueError(f"No part of {type(self).__name__} holds {name!r}; the last pattern must match the rest.")

    def require_memory(self) -> Memory:
        """Return the memory, or say that there is none."""
        if self.memory is None:
            raise UserError("This policy has no memory, so it stores no vision tokens of past frames.")
        return self.memory

    def require_processor(self) -> "PolicyProcessor":
        """Return the processor, or say what it takes to have one."""
        if self.processor is None:
            raise UserError(
                "This policy was built without a processor, so it can run batches but no raw data: build it with "
                "build_policy() or load it with from_pretrained()."
            )
        return self.processor
