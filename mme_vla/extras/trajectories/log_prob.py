"""Log-probabilities for policy gradients: of choices, and of the path of a flow that is sampled in
Gaussian steps.
"""

from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor

from mme_vla.backbone.flow import FlowHead, HasFlowHead, PredictAt
from mme_vla.errors import UserError
from mme_vla.extras.trajectories.choice import ChoiceHead, normal_log_density
from mme_vla.policy.mme import MMEPolicy
from mme_vla.types import Batch, MemoryTokens


@dataclass(frozen=True)
class SamplePath:
    """A chunk with the states it went through.

    states: [b, k + 1, h, a], from noise to the chunk.
    deviation: of each of the k Gaussian steps.
    log_prob: [b], log-density of the states; None where `deviation` is 0.
    """

    states: Tensor
    deviation: float
    log_prob: Tensor | None

    @property
    def chunk(self) -> Tensor:
        """The normalised chunk [b, h, a]."""
        return self.states[:, -1]


@torch.no_grad()
def sample_path(
    policy: MMEPolicy,
    batch: Batch,
    deviation: float,
    *,
    steps: int | None = None,
    generator: torch.Generator | None = None,
    noise: Tensor | None = None,
    increments: Tensor | None = None,
    memory: MemoryTokens | None = None,
) -> SamplePath:
    """Sample chunks in Euler steps with Gaussian noise.

    Args:
        deviation: σ of each step's noise, in units of normalised actions.
        steps: Euler steps; the head's own number by default.
        generator: of the noise, on the CPU.
        noise: the start x_0 [b, h, a]; sampled by default.
        increments: the steps' noise ε [b, k, h, a]; likewise.
        memory: memory tokens; by default those of `batch.history`.
    """
    if deviation < 0:
        raise UserError(f"deviation={deviation} must not be negative.")
    head = _flow_head(policy)
    steps = (steps or head.steps) if increments is None else increments.shape[1]
    count = len(batch.prompt)
    if noise is None:
        noise = torch.randn(count, policy.horizon, policy.action_dim, generator=generator)
    if increments is None:
        increments = torch.randn(
            count, steps, policy.horizon, policy.action_dim, generator=generator
        )
    increments = increments.to(policy.device)
    predict = _predictor(policy, batch, steps, memory)
    with policy.autocast():
        states = gaussian_steps(head, predict, noise.to(policy.device), increments, deviation)
        log_prob = None
        if deviation:
            log_prob = steps_log_prob(head, predict, states, deviation)
    return SamplePath(states, deviation, log_prob)


def path_log_prob(
    policy: MMEPolicy, batch: Batch, path: SamplePath, memory: MemoryTokens | None = None
) -> Tensor:
    """Log-density [b] of a path under the policy as it is now, with gradient.

    Args:
        batch: what the path was sampled for.
        memory: memory tokens; by default those of `batch.history`.
    """
    if not path.deviation:
        raise UserError("A path without noise has no density: sample it with deviation > 0.")
    predict = _predictor(policy, batch, path.states.shape[1] - 1, memory)
    with policy.autocast():
        return steps_log_prob(_flow_head(policy), predict, path.states, path.deviation)


def gaussian_steps(
    head: FlowHead, predict: PredictAt, noise: Tensor, increments: Tensor, deviation: float
) -> Tensor:
    """Every state x_0 … x_k [b, k + 1, h, a] of k Euler steps with noise: x_{i+1} = x_i − v(x_i)/k
    + σ·ε_i.

    Args:
        noise: x_0 [b, h, a].
        increments: ε [b, k, h, a], standard normal.
        deviation: σ; 0 gives plain Euler steps.
    """
    steps = increments.shape[1]
    times = head.times(steps, noise.device)
    velocity = head.velocity(predict, times, {"noise": noise})
    states = [noise]
    for index, increment in enumerate(increments.unbind(1)):
        v = velocity(states[-1], index)
        scaled = deviation * increment if deviation else None
        states.append(head.step(states[-1], v, steps, scaled))
    return torch.stack(states, 1)


def steps_log_prob(head: FlowHead, predict: PredictAt, path: Tensor, deviation: float) -> Tensor:
    """Log-density [b] of the states [b, k + 1, h, a] of `gaussian_steps`: log N(x_0) + Σ log
    N(x_{i+1} | x_i).

    Gradients reach the network's parameters, and not the states.
    """
    steps = path.shape[1] - 1
    states = path.detach().unbind(1)
    times = head.times(steps, path.device)
    velocity = head.velocity(predict, times, {"noise": states[0]})
    log_prob = normal_log_density(states[0], 1.0)
    for index, (state, reached) in enumerate(pairwise(states)):
        error = reached - state + velocity(state, index).to(path.dtype) / steps
        log_prob = log_prob + normal_log_density(error, deviation)
    return log_prob


def log_prob(
    policy: MMEPolicy,
    batch: Batch,
    chunk: Tensor | None = None,
    memory: MemoryTokens | None = None,
    execute: int | None = None,
) -> Tensor:
    """Log-probability [b] of choices under the policy as it is now, with gradient; for
    `backbone.head.name=choice`.

    Args:
        batch: what the policy saw; `batch.options` are the letters that were offered.
        chunk: the sampled chunk [b, h, a] in the network's units; `batch.actions` by default.
        memory: memory tokens; by default those of `batch.history`.
        execute: steps of the chunk that are executed, and count; the embodiment's number by
            default.
    """
    head = _head(policy)
    if not isinstance(head, ChoiceHead):
        raise UserError(
            "log_prob() needs backbone.head.name=choice; for chunks of a flow use path_log_prob()."
        )
    chunk = batch.actions if chunk is None else chunk
    if chunk is None:
        raise UserError("log_prob() needs a chunk, or batch.actions.")
    predict = _predictor(policy, batch, 1, memory)
    with policy.autocast():
        steps = head.log_prob(predict, chunk.to(policy.device), batch.options)  # b h
    past = policy.require_processor().samples.window - 1
    return steps[:, past : past + (execute or policy.embodiment.action.execute)].sum(1)


def _flow_head(policy: MMEPolicy) -> FlowHead:
    head = _head(policy)
    if isinstance(head, ChoiceHead):
        raise UserError("backbone.head.name=choice samples no path: use log_prob().")
    return head


def _head(policy: MMEPolicy) -> FlowHead:
    if not isinstance(policy.backbone, HasFlowHead):
        raise UserError(
            f"Log-probabilities require a flow backbone; {type(policy.backbone).__name__} has no"
            " FlowHead."
        )
    return policy.backbone.head


def _predictor(
    policy: MMEPolicy, batch: Batch, steps: int, memory: MemoryTokens | None
) -> PredictAt:
    """The network's output by the index of a step. Observation and memory are read once."""
    times = _head(policy).times(steps, policy.device)
    if memory is None:
        memory = policy.model.memory_tokens(batch)
    batch = policy.model.prepare_images(batch)
    with policy.autocast():
        assert isinstance(policy.backbone, HasFlowHead)
        predict = policy.backbone.predictor(batch, policy.model.inject(batch, memory))
    return lambda x, index: predict(x, times[index].expand(len(x)))
