"""What a model costs: FLOPs and parameters, counted on the meta device, so that full size needs no memory.

FLOPs are those of PyTorch's `FlopCounterMode` over the real code: two for each multiply-add of linear layers,
convolutions, matrix products and attention (on meta its kernel is taken apart into counted products; `count_model`
makes sure of that). Elementwise work, norms, softmax and embedding look-ups are not counted. Batch 1, two cameras,
every prompt as long as its model's config allows, a full memory; recurrent memories read a full window. Past frames
arrive as stored tokens, as they do in training; what the vision tower spends on them in an episode is a number of its
own.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

from mme_vla.config.composition import compose, config_dir
from mme_vla.errors import UserError
from mme_vla.evaluation.results.cost_table import REPLAN, ModelCost
from mme_vla.memory.recurrent import RecurrentMemory
from mme_vla.policy.build import build_policy
from mme_vla.policy.mme import MMEPolicy
from mme_vla.types import Batch, HistoryTokens


def count_model(model: str, budget: int | None = None, backbone: str = "pi05") -> ModelCost:
    """Count a model at a memory budget (None: its own).

    Raises:
        UserError: an unknown model, a budget for a model without memory, or a PyTorch that does not count attention.
    """
    _check_attention_is_counted()
    policy, batch = on_meta(model, budget, backbone)
    return ModelCost(
        model=model,
        prompt=batch.prompt.shape[1],
        parameters=sum(p.numel() for p in policy.parameters()),
        forward=flops(lambda: policy(batch)),
        chunk=flops(lambda: policy.sample_actions(batch)),
        memory=flops(lambda: policy.encode_memory(batch.history)),
        streamed=_streamed(policy, batch),
        frames=_frames(policy),
    )


def flops(work: Callable[[], object]) -> int:
    """FLOPs of a call, forward only."""
    with torch.no_grad(), FlopCounterMode(display=False) as counter:
        work()
    return counter.get_total_flops()


def on_meta(model: str, budget: int | None = None, backbone: str = "pi05") -> tuple[MMEPolicy, Batch]:
    """A model and a full batch of one, both on the meta device.

    Raises:
        UserError: an unknown model, or a budget for a model without memory.
    """
    policy = build_policy(model, backbone=backbone, device="meta")
    if budget is not None:
        if policy.memory is None:
            raise UserError(f"{model} has no memory, so no budget of {budget} tokens.")
        policy = build_policy(model, backbone=backbone, device="meta", memory={"budget": budget})
    policy.augment = False  # elementwise, and it draws numbers
    length = compose("policy", [f"model={model}", f"backbone={backbone}"]).processor.prompt_length
    return policy, full_batch(policy, length, "meta")


def full_batch(policy: MMEPolicy, prompt: int, device: str = "cpu") -> Batch:
    """A batch of one without content: all views, `prompt` tokens without padding, and a memory that is full."""
    size, views, history = policy.backbone.image_size, len(policy.embodiment.cameras), None
    if policy.memory is not None:
        n = policy.memory.padded_length(policy.memory.capacity)
        features = torch.zeros(1, n, policy.backbone.vision_width, device=device)
        mask = torch.ones(1, n, dtype=torch.bool, device=device)
        history = HistoryTokens(features, torch.zeros(1, n, 3, device=device), mask)
    return Batch(
        images=torch.zeros(1, views, 3, size, size, dtype=torch.uint8, device=device),
        image_mask=torch.ones(1, views, dtype=torch.bool, device=device),
        prompt=torch.full((1, prompt), 5, device=device),
        prompt_mask=torch.ones(1, prompt, dtype=torch.bool, device=device),
        history=history,
        actions=torch.zeros(1, policy.horizon, policy.action_dim, device=device),
    )


def all_models() -> list[str]:
    """The models that ship, by name."""
    return sorted(path.stem for path in (config_dir() / "model").glob("*.yaml"))


def _check_attention_is_counted() -> None:
    q, k = torch.empty(1, 8, 20, 32, device="meta"), torch.empty(1, 8, 50, 32, device="meta")
    mask = torch.zeros(1, 1, 20, 50, device="meta")
    found = flops(lambda: nn.functional.scaled_dot_product_attention(q, k, k, attn_mask=mask))
    if found != 2 * (2 * 8 * 20 * 50 * 32):
        raise UserError(f"This PyTorch ({torch.__version__}) counts {found} FLOPs for an attention of 1,024,000.")


def _streamed(policy: MMEPolicy, batch: Batch) -> int | None:
    memory, history = policy.memory, batch.history
    if not isinstance(memory, RecurrentMemory) or history is None:
        return None
    last = slice(-(memory.storage.grid**2), None)
    frame: Any = history.features[:, last], history.positions[:, last], history.mask[:, last]
    return flops(lambda: memory.read(memory.update(memory.init_state(1), *frame)))


def _frames(policy: MMEPolicy) -> int:
    if policy.memory is None:
        return 0
    size = policy.backbone.image_size
    image = torch.empty(1, 3, size, size, device="meta")
    wanted = sum(policy.memory.storage.keeps(frame) for frame in range(REPLAN, 2 * REPLAN))
    return wanted * flops(lambda: policy.backbone.encode_images(image))
