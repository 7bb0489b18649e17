"""`check_integration`: does memory reach the action through an integration, and only
as it should?
"""

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from mme_vla.backbone.flow import FlowHead, HasFlowHead
from mme_vla.errors import UserError
from mme_vla.policy.mme import MMEPolicy
from mme_vla.testing.small import open_gates, random_batch, tiny_sections
from mme_vla.types import Batch, MemoryTokens

TOLERANCE = 1e-4


def check_integration(
    name: str, memory: str = "framesamp", backbone: str = "tiny", **options: Any
) -> None:
    """Run every check on the integration that is registered under `name`, with a memory and a small
    backbone.

    Prints a line for each that passed.

    Args:
        name: the key in `INTEGRATIONS`.
        memory: the key of a memory to bring in.
        backbone: a file of configs/backbone.
        options: the integration's own, as its YAML would give them.
    """
    sections = tiny_sections(f"{memory}_context", backbone)
    policy = build_small(sections | {"integration": {"name": name, **options}})
    if policy.integration.memory_width < 1:
        raise UserError(f"The integration {name!r} takes no memory: its memory_width is 0.")
    batch = random_batch(policy, batch=2, valid=64)
    draws = policy.training_noise(2, torch.Generator().manual_seed(0))
    assert batch.history is not None
    with torch.no_grad():
        memory_tokens = policy.model.memory_tokens(batch)
        assert memory_tokens is not None
        before = _loss(policy, batch, draws, memory_tokens)
        check_reach(policy, batch, draws, memory_tokens, before)
        print(f"{name}: the tokens of {memory} change the loss, their padding does not")
        together, _ = policy(batch, draws, memory=memory_tokens)
        error = float((together - before.mean()).abs())
        assert error <= TOLERANCE, (
            f"samples of one batch see each other: alone their loss differs by {error:.2g}."
        )
        print(f"{name}: samples of one batch are independent")
        check_sampling(policy, batch, memory_tokens)
        print(f"{name}: sampling agrees with the pass that training makes")
    check_gradients(policy, batch, draws)
    print(f"{name}: every parameter of the memory and the integration gets a gradient")


def build_small(sections: dict[str, Any]) -> MMEPolicy:
    """A policy from plain sections, its gates open so that every part reaches the action."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        policy = MMEPolicy.from_config(sections)
    open_gates(policy)
    with torch.no_grad():
        for parameter in policy.integration.parameters():
            # near zero, or zero, where it starts as the identity
            parameter.add_(
                0.05 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(1))
            )
    return policy.eval()


def _loss(
    policy: MMEPolicy, batch: Batch, draws: dict[str, Tensor], memory: MemoryTokens
) -> Tensor:
    assert batch.actions is not None
    losses = []
    for i in range(len(batch.prompt)):
        row = slice(i, i + 1)
        one = Batch(
            batch.images[row],
            batch.image_mask[row],
            batch.prompt[row],
            batch.prompt_mask[row],
            actions=batch.actions[row],
        )
        noise = {name: value[row] for name, value in draws.items()}
        loss, _ = policy(one, noise, memory=memory.rows(row))
        losses.append(loss)
    return torch.stack(losses)


def check_reach(
    policy: MMEPolicy, batch: Batch, draws: dict[str, Tensor], memory: MemoryTokens, before: Tensor
) -> None:
    """Other memories give other losses; what stands where the mask is False gives none."""
    other = _loss(policy, batch, draws, replace(memory, tokens=-memory.tokens))
    assert (other - before).abs().min() > 0, (
        "memory does not reach the action: other tokens, the same loss."
    )
    padded = replace(memory, tokens=memory.tokens.masked_fill(~memory.mask[..., None], 1e3))
    assert (~memory.mask).any(), "the check needs padding among the memory tokens"
    error = float((_loss(policy, batch, draws, padded) - before).abs().max())
    assert error <= TOLERANCE, f"what is in the memory's padding changed the loss by {error:.2g}."


def check_sampling(policy: MMEPolicy, batch: Batch, memory: MemoryTokens) -> None:
    """What runs once a chunk and what runs in every step add up to the pass that training makes."""
    draws = {
        k: torch.stack([v, v])
        for k, v in policy.sampling_noise(torch.Generator().manual_seed(0)).items()
    }
    for steps in (1, 2):  # as many as samples, too: a step must not be taken for a sample
        chunk = policy.sample_actions(batch, draws, steps=steps, memory=memory)
        assert torch.isfinite(chunk).all(), "a sampled chunk is not finite."
        if isinstance(policy.backbone, HasFlowHead):
            joint = sample_jointly(policy, policy.backbone.head, batch, draws, steps, memory)
            error = float((chunk - joint).abs().max())
            assert error <= TOLERANCE, (
                f"sampling (cached prefix) and training (one pass) differ by {error:.2g}."
            )


def sample_jointly(
    policy: MMEPolicy,
    head: FlowHead,
    batch: Batch,
    draws: dict[str, Tensor],
    steps: int,
    memory: MemoryTokens,
) -> Tensor:
    """A chunk [b, h, a] by the head's Euler steps, each of which runs the network in one pass."""
    x = head.start(draws, steps, None)
    times = head.times(steps, x.device)
    velocity = head.velocity(
        lambda x_t, index: policy.predict(batch, x_t, times[index].expand(len(x_t)), memory),
        times,
        draws,
    )
    for index in range(len(times)):
        x = head.step(x, velocity(x, index), len(times))
    return x


def check_gradients(policy: MMEPolicy, batch: Batch, draws: dict[str, Tensor]) -> None:
    """Every parameter of integration and memory learns."""
    policy.requires_grad_(True)
    loss, _ = policy(batch, draws)
    loss.backward()
    idle = []
    for name, parameter in policy.named_parameters():
        is_of_memory = policy.finetune_spec.component_of(name) == "memory"
        if is_of_memory and (parameter.grad is None or not parameter.grad.any()):
            idle.append(name)
    assert not idle, f"no gradient reaches {', '.join(idle)}."
