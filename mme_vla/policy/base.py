"""`Policy`: the interface that training, evaluation, serving and weights use."""

import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import torch
from torch import Tensor, nn

from mme_vla.backbone.base import FineTuneSpec
from mme_vla.embodiment import Embodiment
from mme_vla.embodiment.robomme import embodiment_of
from mme_vla.errors import UserError, require
from mme_vla.memory.base import MemoryModule
from mme_vla.policy.episode import Episode, executable_actions
from mme_vla.policy.identity import PolicyIdentity
from mme_vla.policy.saving import load_policy, push_folder, save_policy
from mme_vla.policy.sections import PolicySections
from mme_vla.policy.self_check import renew_self_check
from mme_vla.types import Noise, stack_noise

if TYPE_CHECKING:
    from mme_vla.processing.base import PolicyProcessor


@dataclass(frozen=True)
class PolicyInfo:
    """Facts about a policy that rollouts, caches and checkpoints read.

    sample_steps: default steps of its sampler.
    supports_rtc: whether it can sample chunks that continue an action prefix (real-time chunking).
    max_actions: actions after which its rollouts end, beside their limit of frames.
    resamples: whether a chunk can be sampled any number of times at one step of an episode.
    max_running: most episodes that it can act in at the same time; None for any number.
    identity: what records call a policy that does not compute here; None for what its configuration
        says.
    server: what a receipt names of the server where the policy computes, its metadata and times so
        far; None for a policy that computes here.
    history_dtype: of stored vision tokens (`Policy.encode_frames`).
    processor_sizes: sizes of the network that its processor must have too, by the name of the
        processor's attribute, such as `image_size` or `embodiment.action.horizon`. A checkpoint in
        which they differ is damaged.
    """

    sample_steps: int = 1
    supports_rtc: bool = False
    max_actions: int | None = None
    resamples: bool = True
    max_running: int | None = None
    identity: PolicyIdentity | None = None
    server: Mapping[str, Any] | None = None
    history_dtype: torch.dtype = torch.bfloat16
    processor_sizes: Mapping[str, object] = field(default_factory=dict)


class Policy(nn.Module):
    """A policy: a loss to train, chunks to sample, episodes to act in, parameters to fine-tune, a
    folder to save to.

    A subclass registers in `POLICIES` (`policy.name` of a configuration), sets the attributes
    below that have no default, and implements what raises NotImplementedError. What it need not
    have is a method or an attribute with a default. Its processor defines the batches. Random
    numbers are passed in (`training_noise`, `sampling_noise`), so that training resumes bit for
    bit, and the noise of an episode does not depend on its batch.
    """

    memory: MemoryModule | None
    processor: "PolicyProcessor | None"
    config: dict[str, Any]
    """What `from_config` was given; saved with the weights."""
    compute_dtype: torch.dtype = torch.float32
    """Matrix products run in it, under autocast."""
    horizon: int
    """Steps of a chunk. The first `processor.samples.window - 1` lie in the past and are not
    executed.
    """
    info: PolicyInfo = PolicyInfo()
    loss_weights: Mapping[str, float] | None = None
    """Weights of auxiliary losses by name, which training sets from `train.losses`. None for a
    policy that has no such losses, and weighs no samples (`Batch.weight`).
    """
    _renews_self_check: bool = False
    """Whether the checkpoint that it was loaded from has a self-check. It is recorded again, of the
    weights as they are then, where the policy is saved.
    """

    @property
    def device(self) -> torch.device:
        return next(self.parameters()).device

    @property
    def embodiment(self) -> Embodiment:
        """The robot of the processor, else of the configuration."""
        return embodiment_of(self.config) if self.processor is None else self.processor.embodiment

    @property
    def finetune_spec(self) -> FineTuneSpec:
        """Which parameters are which component, and which of them LoRA adapts."""
        raise NotImplementedError

    def require_processor(self) -> "PolicyProcessor":
        """Return the processor.

        Raises:
            UserError: the policy was built without one.
        """
        if self.processor is None:
            raise UserError(
                "This policy was built without a processor, so it can run batches but no raw data:"
                " build it with build_policy() or load it with from_pretrained()."
            )
        return self.processor

    # Stored vision tokens of past frames

    def require_memory(self) -> MemoryModule:
        """Return the memory.

        Raises:
            UserError: the policy has none.
        """
        if self.memory is None:
            raise UserError(
                "This policy has no memory, so it stores no vision tokens of past frames."
            )
        return self.memory

    def encode_frames(self, frames: np.ndarray) -> Tensor:
        """Encode memory-view frames [n, H, W, 3] uint8 into stored tokens [n, grid², d_vision]."""
        raise UserError(
            f"{type(self).__name__} stores no vision tokens of past frames: it lacks"
            " encode_frames()."
        )

    def vision_fingerprint(self) -> str:
        """Hash what the tokens of `encode_frames`, and a cache of them, depend on."""
        raise UserError(
            f"{type(self).__name__} stores no vision tokens of past frames: it lacks"
            " vision_fingerprint()."
        )

    def frames_read(self, steps: np.ndarray, exec_start: int) -> np.ndarray | None:
        """Frames of the memory camera, beside the current ones, that acting at these steps reads,
        so that a simulation renders no others.

        Args:
            steps: [n] current frames, video included.
            exec_start: the first execution frame.

        Returns:
            int64 [n], ascending and unique; None if any frame of any camera may be read.
        """
        return None

    # Training

    def training_noise(self, count: int, generator: torch.Generator) -> Noise:
        """Sample the random numbers for the losses of `count` samples, on the CPU: each value
        [count, …].
        """
        return {}

    def augmentation_params(self, count: int, generator: torch.Generator) -> Noise:
        """Random numbers [count, …] on the CPU for the images of `count` samples, beside
        `training_noise`'s.
        """
        return {}

    def forward(
        self, batch: Any, noise: Mapping[str, Tensor] | None = None
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the loss of a batch, and metrics to log (detached).

        Args:
            batch: with `actions`.
            noise: of `training_noise`, on the policy's device; sampled by default.
        """
        raise NotImplementedError

    # Sampling

    def sampling_noise(self, generator: torch.Generator) -> Noise:
        """Sample the random numbers for one chunk, on the CPU, without a batch axis."""
        return {}

    def sample_actions(
        self, batch: Any, noise: Mapping[str, Tensor] | None = None, steps: int | None = None
    ) -> Tensor:
        """Sample a normalised chunk [b, h, a].

        Args:
            noise: of `sampling_noise`, with a batch axis, on the policy's device; sampled by
                default.
            steps: of an iterative sampler; its default by default.
        """
        raise NotImplementedError

    def compile_sampling(
        self, layers: bool = False, report: Callable[[str], object] = lambda text: None
    ) -> bool:
        """Compile the sampler of a policy whose weights are final.

        Args:
            layers: compile the network's layers too.
            report: gets a line on each part that is ready.

        Returns:
            Whether the policy has a sampler that can be compiled.
        """
        return False

    # Episodes

    def start_episode(self, goal: str, seed: int = 0) -> Episode:
        """Begin an episode. Its memory, noise and current view are in the returned object alone."""
        return Episode(self, goal, seed)

    def act(self, episodes: Episode | Sequence[Episode], steps: int | None = None) -> np.ndarray:
        """Choose the next chunk for one episode or for many in one batch. No frame is observed; a
        recurrent memory continues its stream. After checks it calls `choose_actions`, the last
        function of this file.

        Returns:
            float32 [n, h, w], or [h, w] for one episode: actions as the embodiment executes them,
            without the steps of a chunk that lie in the past.
        """
        if isinstance(episodes, Episode):
            single: np.ndarray = self.act([episodes], steps)[0]
            return single
        if not episodes:
            n_past = self.require_processor().samples.window - 1
            return np.zeros((0, self.horizon - n_past, self.embodiment.action.width), np.float32)
        if not self.info.supports_rtc and any(e.action_prefix is not None for e in episodes):
            name = PolicySections.of(self.config).name or type(self).__name__
            raise UserError(
                f"{name} does not support real-time chunking, which needs a flow policy such as"
                " π0.5. Leave out set_action_prefix()."
            )
        return choose_actions(self, episodes, steps).actions

    def prepare(self, episode: Episode) -> bool:
        """Compute a part of an episode's next chunk while the robot moves; no action changes by it.

        Returns:
            Whether more remains. A recurrent memory reads its next list of frames so.
        """
        return False

    def observation(self, episodes: Sequence[Episode]) -> Any:
        """The current observations of episodes, as a batch of the processor's kind on the policy's
        device.
        """
        raise NotImplementedError

    def predict_chunk(
        self,
        batch: Any,
        episodes: Sequence[Episode],
        noise: Mapping[str, Tensor],
        steps: int | None = None,
    ) -> Tensor:
        """Sample a normalised chunk [n, h, a] for an `observation`, with the memories of the
        episodes.
        """
        raise NotImplementedError

    # Folders

    @classmethod
    def from_config(
        cls,
        config: Mapping[str, Any],
        processor: "PolicyProcessor | None" = None,
        *,
        fresh_backbone: bool = True,
    ) -> Self:
        """Build from plain sections.

        Args:
            fresh_backbone: False if a checkpoint is loaded next: the backbone's weights are not
                initialised.
        """
        raise NotImplementedError

    @classmethod
    def from_pretrained(
        cls,
        source: str | Path,
        *,
        device: str | torch.device = "cpu",
        dtype: str = "float32",
        revision: str | None = None,
        token: str | None = None,
        trust_plugins: bool = False,
        tokenizer: str | Path | None = None,
        **policy: Any,
    ) -> Self:
        """Load what `save_pretrained` wrote; of a training checkpoint, the EMA weights.

        `Policy.from_pretrained` loads every kind of policy, a subclass only its own.

        Args:
            source: a folder (of a checkpoint; of a run, for its newest checkpoint; `…/latest`, for
                the newest run), or `owner/name` of a hub repository.
            device: where to put the weights.
            dtype: of the weights. `bfloat16` halves the memory, for inference: compute is then
                bfloat16 too, and no weight requires a gradient. `auto`: bfloat16 on a GPU if the
                policy is made for it, else float32.
            revision: branch, tag or commit of the repository.
            token: for private repositories.
            trust_plugins: import the modules that the checkpoint names under `plugins`, and those
                of parts of installed packages. They run code of their authors.
            tokenizer: in place of the checkpoint's own, which is fetched from the hub only if it is
                π0.5's.
            policy: overrides of the `policy` section, such as `compute_dtype="bfloat16"`.

        Raises:
            UserError: no checkpoint at `source`, or files that do not fit together.
        """
        return load_policy(
            cls,
            source,
            device=device,
            dtype=dtype,
            revision=revision,
            token=token,
            trust_plugins=trust_plugins,
            tokenizer=tokenizer,
            options=policy,
        )

    def save_pretrained(
        self, folder: str | Path, *, dtype: str = "float32", card: Mapping[str, Any] | None = None
    ) -> None:
        """Write weights, configuration, statistics and tokenizer, with checksums in `SHA256SUMS`.

        A policy that was loaded from a checkpoint with a self-check gets a new one of its weights.

        Args:
            dtype: of the stored weights: `float32` or `bfloat16`.
            card: facts for the model card, kept in the configuration: `data` (text), `recipe`,
                `results` (tables), `license`, `base_model`, `datasets` (ids on the hub).
        """
        check = renew_self_check(self, dtype)
        save_policy(self, Path(folder), dtype=dtype, card=card, self_check=check)

    def push_to_hub(
        self,
        repo_id: str,
        *,
        private: bool = False,
        token: str | None = None,
        revision: str | None = None,
        message: str = "Upload policy",
        dtype: str = "float32",
        card: Mapping[str, Any] | None = None,
    ) -> str:
        """Store the policy on the Hugging Face Hub, as `save_pretrained` writes it; return the
        repository's address.

        Args:
            repo_id: `owner/name`; created if it does not exist.
            private: only if it is created now.
            token: a write token; the one stored by `hf auth login` by default.
            revision: the branch to commit to.
            message: of the commit.
            dtype, card: as for `save_pretrained`.
        """
        with tempfile.TemporaryDirectory() as folder:
            self.save_pretrained(folder, dtype=dtype, card=card)
            return push_folder(
                Path(folder),
                repo_id,
                private=private,
                token=token,
                revision=revision,
                message=message,
            )


@dataclass(frozen=True)
class SelectedActions:
    """What a policy chose for n episodes.

    batch: of `Policy.observation`.
    chunk: [n, h, a], in the network's units.
    actions: float32 [n, h, w], as the embodiment executes them, without the steps of a chunk that
        lie in the past.
    """

    batch: Any
    chunk: Tensor
    actions: np.ndarray


def draw_noise(policy: Policy, count: int, generator: torch.Generator | None = None) -> Noise:
    """The noise of so many new samples in one batch, from PyTorch's generator by default."""
    if generator is None:
        generator = torch.default_generator
    return stack_noise([policy.sampling_noise(generator) for _ in range(count)])


def frames_a_piece(policy: Policy, encoded: int) -> int:
    """Frames that are read at a time, for so many that are encoded: of some memories most never
    are.
    """
    return encoded if policy.memory is None else encoded * policy.memory.storage.keep_every


def choose_actions(
    policy: Policy,
    episodes: Sequence[Episode],
    steps: int | None = None,
    sample_chunk: Callable[[Any, Mapping[str, Tensor]], Tensor] | None = None,
) -> SelectedActions:
    """Choose the next chunk for episodes in one batch, with each episode's own noise.

    Args:
        steps: of an iterative sampler; its default by default.
        sample_chunk: in place of `Policy.predict_chunk`, from the observation and its noise to the
            normalised chunk [n, h, a]: for what records how a chunk was sampled.
    """
    require(
        all(episode.policy is policy for episode in episodes),
        "An episode belongs to another policy: act with the one whose start_episode() made it.",
    )
    policy.require_processor().require_stats()  # before the noise or memory of an episode changes
    batch = policy.observation(episodes)
    noise = stack_noise([episode.draw() for episode in episodes])
    # `eval` itself takes milliseconds: it goes through a thousand modules and sets each.
    in_training = [module for module in policy.modules() if module.training]
    if in_training:
        policy.eval()
    try:
        if sample_chunk is None:
            chunk = policy.predict_chunk(batch, episodes, noise, steps)
        else:
            chunk = sample_chunk(batch, noise)
        chunk = chunk.float().cpu()
    finally:
        for module in in_training:
            module.training = True
    actions = executable_actions(policy, chunk, episodes)
    for episode, executed in zip(episodes, actions, strict=True):
        episode.acted(executed)
    return SelectedActions(batch, chunk, actions)
