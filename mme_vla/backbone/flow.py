"""Flow matching: the path from noise to actions, its loss, and the times of Euler steps.

τ = 1 is pure noise: x_τ = τ·noise + (1 − τ)·actions, target u = noise − actions.
"""

import math
from collections.abc import Callable, Mapping
from typing import Any, ClassVar

import torch
from torch import Tensor

from mme_vla.backbone.base import Injection
from mme_vla.errors import UserError, check_sizes, require
from mme_vla.registry import HEADS
from mme_vla.types import Batch, Noise, Overlap

EULER_STEPS = 10  # as released
MIN_PERIOD, MAX_PERIOD = 4e-3, 4.0


def sample_time(
    count: int, distribution: str, device: torch.device, generator: torch.Generator | None = None
) -> Tensor:
    """Sample τ [count]: `beta` gives 0.001 + 0.999·Beta(1.5, 1), as released; `uniform` U(0, 1), as
    in the paper.
    """
    uniform = torch.rand(count, device=device, generator=generator)
    if distribution == "uniform":
        return uniform
    return 0.001 + 0.999 * uniform ** (1 / 1.5)  # the quantile function of Beta(α, 1) is u^(1/α)


def interpolate(actions: Tensor, noise: Tensor, time: Tensor) -> tuple[Tensor, Tensor]:
    """Return (x_τ, u) for chunks [b, h, a] and times [b]."""
    tau = time[:, None, None]
    return tau * noise + (1 - tau) * actions, noise - actions


def step_loss(velocity: Tensor, target: Tensor) -> Tensor:
    """Squared error averaged over action dimensions: [b, h, a] → [b, h]. Padded dimensions count,
    as released.
    """
    return (velocity.float() - target.float()).square().mean(-1)


def time_embedding(time: Tensor, width: int) -> Tensor:
    """Sin-cos features [b, width] of τ [b], periods 4e-3 … 4 in geometric steps."""
    fraction = torch.linspace(0, 1, width // 2, device=time.device, dtype=torch.float32)
    period = MIN_PERIOD * (MAX_PERIOD / MIN_PERIOD) ** fraction
    # Angles reach 1,600 rad, where the order of float32 operations shows: this is the released one.
    angle = time.float()[:, None] * (2 * math.pi / period)
    return torch.cat([angle.sin(), angle.cos()], dim=-1)


def euler_times(steps: int, device: torch.device) -> Tensor:
    """The times 1, 1 − 1/steps, … of Euler steps [steps], added up in float32 as released."""
    # Computed on the device: a copy from the CPU would wait for the GPU, and could not be in a CUDA
    # graph.
    times = []
    time = torch.ones((), device=device)
    for _ in range(steps):
        times.append(time)
        time = time - 1.0 / steps
    return torch.stack(times)


Predict = Callable[[Tensor, Tensor], Tensor]
"""`predict(x_t, time)`: the network's output [b, h, a] at noisy chunks [b, h, a] and flow times
[b].
"""
PredictAt = Callable[[Tensor, int], Tensor]
"""`predict(x, index)`: the same while sampling, at the flow time with this index in
`FlowHead.times`.
"""


@HEADS.register("flow")
class FlowHead:
    """Flow matching as π0.5 has it: time distribution, loss and velocity of a network that predicts
    the velocity. The loop over Euler steps is in `Pi05Backbone.sample`.

    A head of your own overrides what differs, registers under a name and is chosen with
    `backbone.head.name`.

    Args:
        horizon, action_dim: of a chunk [h, a].
        time_distribution: `beta` or `uniform`, see `sample_time`.
        steps: Euler steps unless the caller says otherwise.
        deviation: σ of Gaussian noise in each Euler step while sampling, in units of normalised
            actions (policy gradients); 0 samples without it.
    """

    supports_rtc: ClassVar[bool] = True
    """Whether real-time chunking can guide the sampler."""

    def __init__(
        self,
        horizon: int,
        action_dim: int,
        time_distribution: str = "beta",
        steps: int = EULER_STEPS,
        deviation: float = 0.0,
    ):
        check_sizes("backbone.head", steps=steps)
        require(deviation >= 0, f"backbone.head.deviation={deviation} must not be negative.")
        self.deviation = deviation
        self.horizon, self.action_dim = horizon, action_dim
        self.time_distribution, self.steps = time_distribution, steps

    def training_noise(self, count: int, generator: torch.Generator) -> Noise:
        """`noise` [n, h, a] and flow times `time` [n], on the CPU."""
        noise = torch.randn(count, self.horizon, self.action_dim, generator=generator)
        time = sample_time(count, self.time_distribution, noise.device, generator)
        return {"noise": noise, "time": time}

    def sampling_noise(self, generator: torch.Generator) -> Noise:
        """The starting `noise` [h, a], on the CPU; with `deviation` also `increments` [steps, h,
        a].
        """
        shape = self.horizon, self.action_dim
        noise = {"noise": torch.randn(*shape, generator=generator)}
        if self.deviation:
            noise["increments"] = torch.randn(self.steps, *shape, generator=generator)
        return noise

    def loss(self, predict: Predict, actions: Tensor, noise: Mapping[str, Tensor]) -> Tensor:
        """The loss [b, h] of `actions` [b, h, a]: with noise ε and flow times τ, the network reads
        x_τ = τε + (1 − τ)·actions, and the loss of a step is the mean over its numbers of (v − u)²,
        where v = predict(x_τ, τ) and u = ε − actions.
        """
        x_t, target = interpolate(actions.float(), noise["noise"], noise["time"])
        return step_loss(predict(x_t, noise["time"]), target)

    def times(self, steps: int, device: torch.device) -> Tensor:
        """The flow times at which the network is called while sampling, one an Euler step."""
        return euler_times(steps, device)

    # While sampling: `start` gives x at time 1, and one `step` follows for each of the `times`

    def start(self, noise: Mapping[str, Tensor], steps: int, overlap: Overlap | None) -> Tensor:
        """The state x [b, h, a] at flow time 1.

        Raises:
            UserError: noise of Gaussian steps, and another number of steps or real-time chunking.
        """
        if "increments" not in noise:
            return noise["noise"]
        count = noise["increments"].shape[1]
        if count != steps:
            raise UserError(
                f"flow_steps={steps}: backbone.head.deviation has noise for {count}; set"
                " backbone.head.steps."
            )
        if overlap is not None:
            raise UserError("backbone.head.deviation must be 0 for real-time chunking.")
        return noise["noise"]

    def velocity(self, predict: PredictAt, times: Tensor, noise: Mapping[str, Tensor]) -> PredictAt:
        """The velocity [b, h, a] as a function of a state and the number of its step; here it is
        the network's output.

        Args:
            predict: the network's output, as such a function.
            times: [steps].
            noise: as `sampling_noise` makes it.
        """
        return predict

    def step(self, x: Tensor, velocity: Tensor, steps: int, noise: Tensor | None = None) -> Tensor:
        """One Euler step of states x [b, h, a]: x − v/k, and σ·ε where there is `noise`.

        Args:
            velocity: v [b, h, a] at x.
            steps: k, of the whole way.
            noise: σ·ε [b, h, a].
        """
        x = x - velocity.to(x.dtype) / steps
        return x if noise is None else x + noise


@HEADS.register("clean_flow")
class CleanFlowHead(FlowHead):
    """Flow matching of a network that predicts the chunk without its noise; the
    velocity follows.
    """

    def loss(self, predict: Predict, actions: Tensor, noise: Mapping[str, Tensor]) -> Tensor:
        """The loss [b, h]: the mean over a step's numbers of (predict(x_τ, τ) − a)²."""
        x_t, _ = interpolate(actions.float(), noise["noise"], noise["time"])
        return step_loss(predict(x_t, noise["time"]), actions)

    def velocity(self, predict: PredictAt, times: Tensor, noise: Mapping[str, Tensor]) -> PredictAt:
        """(x − clean chunk) / τ; τ is at least one step."""

        def velocity(x: Tensor, index: int) -> Tensor:
            return (x - predict(x, index)) / times[index].clamp(min=1 / len(times))

        return velocity


class HasFlowHead:
    """Capability of a backbone: its chunks are learned and sampled by a `FlowHead`, which
    `build_head` makes.
    """

    head: FlowHead

    def predictor(self, batch: Batch, injection: Injection) -> Predict:
        """The network's output at noisy chunks [b, h, a] and flow times [b], with gradient, for one
        observation.
        """
        raise NotImplementedError


def build_head(config: Any) -> FlowHead:
    """The head that `config.head` names, for the sizes and the time distribution of `config`."""
    section = {"time_distribution": config.time_distribution, **config.head}
    head: FlowHead = HEADS.build(section, horizon=config.horizon, action_dim=config.action_dim)
    return head
