"""AdamW, warm-up, schedule, clipping: the released recipes, number by number."""

import math
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from torch import Tensor, nn
from torch.distributed.tensor import DTensor

from mme_vla.backbone.base import FineTuneSpec
from mme_vla.errors import did_you_mean, require
from mme_vla.training.parallel import like
from mme_vla.training.settings import TrainSettings


def scheduled_rate(step: int, settings: TrainSettings) -> float:
    """Rate of update `step`, from 0, of a recipe.

    Linear to `lr` at step `warmup`, from lr/(warmup + 1) or from 0; then constant, or half a cosine
    that is `lr` times `schedule_end` at `schedule_steps`, or `gamma` times less from each of the
    `milestones` on.
    """
    peak = settings.lr
    warmup = settings.warmup
    if step < warmup:
        start = 0.0
        if not settings.warmup_from_zero:
            start = peak / (warmup + 1)
        return start + (peak - start) * step / warmup
    if settings.schedule == "cosine":
        total = settings.schedule_steps or settings.steps
        done = min((step - warmup) / max(total - warmup, 1), 1.0)
        least = settings.schedule_end
        return peak * (least + (1 - least) * 0.5 * (1 + math.cos(math.pi * done)))
    if settings.schedule == "steps":
        passed = sum(step >= milestone for milestone in settings.milestones)
        return peak * settings.gamma**passed
    return peak


def lr_factors(names: Iterable[str], spec: FineTuneSpec, settings: TrainSettings) -> list[float]:
    """Factors of the learning rate of parameters, by their component (`train.part_lr`)."""
    factors = settings.part_lr or {}
    parts = [spec.component_of(name) for name in names]
    for part in factors:
        require(
            part in spec.components,
            f"train.part_lr names {part!r}. {did_you_mean(part, spec.components)}",
        )
        if part not in parts:
            warnings.warn(
                f"train.part_lr.{part} has no effect: no weight of {part} is trained.",
                stacklevel=2,
            )
    return [factors.get(part, 1.0) for part in parts]


def make_optimizer(
    parameters: Iterable[nn.Parameter],
    settings: TrainSettings,
    factors: Sequence[float] | None = None,
) -> torch.optim.Optimizer:
    """AdamW over all trainable parameters, fused, which every device that trains supports; or
    timm's LAMB.

    LAMB scales each tensor's update down to that tensor's norm, never up. Parameters of fewer than
    `decay_min_dim` dimensions (biases, norms) are a group of their own, without weight decay.

    Args:
        factors: of each parameter's learning rate, of `lr_factors`; a group keeps its own as
            `lr_factor`. None: all 1.
    """
    parameters = list(parameters)
    if factors is None:
        factors = [1.0] * len(parameters)
    members: dict[tuple[float, bool], list[nn.Parameter]] = {}
    for parameter, factor in zip(parameters, factors, strict=True):
        decays = parameter.ndim >= settings.decay_min_dim
        members.setdefault((factor, decays), []).append(parameter)
    groups = []
    # Large factors first, and of one factor those that decay: checkpoints count on the order.
    for factor, decays in sorted(members, reverse=True):
        group: dict[str, Any] = {"params": members[factor, decays]}
        if not decays:
            group["weight_decay"] = 0.0
        if factor != 1:
            group["lr_factor"] = factor
        groups.append(group)
    options: dict[str, Any] = {
        "lr": settings.lr,
        "betas": settings.betas,
        "eps": settings.eps,
        "weight_decay": settings.weight_decay,
    }
    if settings.optimizer == "lamb":
        from mme_vla.training.lamb import ClippedLamb  # imports timm, and so torchvision

        return ClippedLamb(groups, **options)
    return torch.optim.AdamW(groups, **options, fused=True)


@torch.no_grad()
def clip_gradients(gradients: list[Tensor], max_norm: float) -> Tensor:
    """Scale all gradients in place so that their common norm is at most `max_norm`; return the norm
    before.
    """
    norm = gradient_norm(gradients)
    torch._foreach_mul_(gradients, (max_norm / norm).clamp(max=1.0))
    return norm


def gradient_norm(gradients: list[Tensor]) -> Tensor:
    """The common norm of all gradients."""
    return torch.linalg.vector_norm(torch.stack(torch._foreach_norm(gradients)))


class EMA:
    """average ← decay·average + (1 − decay)·weights after every update, begun with the initial
    weights as released.
    """

    def __init__(
        self,
        parameters: Mapping[str, nn.Parameter],
        decay: float,
        warmup: bool = False,
        reshard: Callable[[], None] = lambda: None,
    ) -> None:
        """Begin with copies of the parameters; of sharded ones, every process of its own part.

        Args:
            decay: of the average; with `warmup` at most, and (1 + k)/(10 + k) after k updates
                before (0 at first).
            reshard: lets go of weights that were gathered from the parameters before they change.
        """
        self.decay, self.warmup, self._reshard = decay, warmup, reshard
        self._parameters = dict(parameters)
        self._average = [p.detach().clone() for p in self._parameters.values()]

    def decay_after(self, done: int) -> float:
        """The decay of the update before which `done` were done; the first one copies, while
        warming up.
        """
        if not self.warmup:
            return self.decay
        return min((1 + done) / (10 + done), self.decay) if done else 0.0

    @torch.no_grad()
    def update(self, done: int = 0) -> None:
        """Move towards the current weights, after `done` earlier updates (which only a warm-up
        asks).
        """
        torch._foreach_lerp_(
            self._average, list(self._parameters.values()), 1 - self.decay_after(done)
        )

    @torch.no_grad()
    def load(self, tensors: Mapping[str, Tensor]) -> None:
        """Take the averages from `tensors`, which must name every parameter."""
        for name, average in zip(self._parameters, self._average, strict=True):
            average.copy_(like(average, tensors[name]))

    def tensors(self) -> dict[str, Tensor]:
        return dict(zip(self._parameters, self._average, strict=True))

    @contextmanager
    def applied(self) -> Iterator[None]:
        """Within this context the module has the averaged weights.

        Storage is exchanged and nothing copied, but for shards: what gathers them holds on to their
        storage, so their numbers are exchanged.
        """
        self._exchange()
        try:
            yield
        finally:
            self._exchange()

    @torch.no_grad()
    def _exchange(self) -> None:
        self._reshard()
        for i, parameter in enumerate(self._parameters.values()):
            average = self._average[i]
            if isinstance(parameter, DTensor) and isinstance(average, DTensor):
                local, other = parameter.to_local(), average.to_local()
                copy = local.clone()
                local.copy_(other)
                other.copy_(copy)
            else:
                parameter.data, self._average[i] = average, parameter.data
        self._reshard()


class WeightUpdate:
    """Clips the gradients, moves the weights, and their average towards them.

    Clipping, AdamW and averaging are three passes over the weights, some 52 bytes a parameter with
    the norm. With `one_pass` they are one compiled pass of 40 bytes, a launch for each weight. It
    rounds differently.
    """

    def __init__(
        self,
        parameters: Mapping[str, nn.Parameter],
        optimizer: torch.optim.Optimizer,
        ema: EMA,
        clip_norm: float,
        one_pass: bool = False,
    ) -> None:
        """Prepare updates of `parameters`, which the optimizer and the average have too.

        Args:
            clip_norm: largest common norm of the gradients.
            one_pass: compile it. The optimizer is `torch.optim.AdamW`, and no weight is sharded.
        """
        self._parameters = dict(parameters)
        self._optimizer, self._ema, self._clip_norm = optimizer, ema, clip_norm
        self._compiled: Callable[..., None] | None = None
        if one_pass:
            # One code for each shape of a weight.
            limit = torch._dynamo.config.recompile_limit
            torch._dynamo.config.recompile_limit = max(limit, 256)
            self._compiled = torch.compile(_adamw_and_average, fullgraph=True, dynamic=False)

    @torch.no_grad()
    def __call__(self, done: int) -> Tensor:
        """Make the update after `done` earlier ones, and let go of the gradients.

        Returns:
            The norm of the gradients before clipping.
        """
        gradients = [p.grad for p in self._parameters.values() if p.grad is not None]
        # The optimizer makes the moments in its first step, and leaves out what has no gradient.
        has_moments = len(self._optimizer.state) == len(self._parameters)
        if self._compiled is not None and has_moments and len(gradients) == len(self._parameters):
            norm = gradient_norm(gradients)
            self._run(self._compiled, (self._clip_norm / norm).clamp(max=1.0), done)
        else:
            norm = clip_gradients(gradients, self._clip_norm)
            self._optimizer.step()
            self._ema.update(done)
        self._optimizer.zero_grad(set_to_none=True)
        return norm

    def _run(self, compiled: Callable[..., None], factor: Tensor, done: int) -> None:
        """Pass over every group of parameters, whose gradients are to be scaled by `factor`."""
        names = {id(p): name for name, p in self._parameters.items()}
        averages = self._ema.tensors()
        share = torch.tensor(1 - self._ema.decay_after(done), dtype=torch.float64)
        for group in self._optimizer.param_groups:
            parameters = group["params"]
            states = [self._optimizer.state[p] for p in parameters]
            steps = [state["step"] for state in states]
            torch._foreach_add_(steps, 1)
            # In float64, as the optimizer corrects the moments' bias; 16 bytes each, since compiled
            # code copies what lies elsewhere.
            counts = torch.stack(steps).double()[:, None].expand(-1, 4)
            first, second = group["betas"]
            corrections = (1 - first**counts).float()[:, 0].unbind()
            root_corrections = (1 - second**counts).sqrt().float()[:, 0].unbind()
            # Tensors, since a number would be compiled into the code.
            rate = torch.tensor(group["lr"], dtype=torch.float64)
            constants = (first, second, group["eps"], group["weight_decay"])
            # Weights of one shape follow each other, so that their code is found at once.
            for i in sorted(range(len(parameters)), key=lambda i: parameters[i].shape):
                parameter, state = parameters[i], states[i]
                compiled(
                    parameter,
                    parameter.grad,
                    state["exp_avg"],
                    state["exp_avg_sq"],
                    averages[names[id(parameter)]],
                    corrections[i],
                    root_corrections[i],
                    factor,
                    rate,
                    share,
                    constants,
                )


def _adamw_and_average(
    weight: Tensor,
    gradient: Tensor,
    mean: Tensor,
    square: Tensor,
    average: Tensor,
    correction: Tensor,
    root_correction: Tensor,
    factor: Tensor,
    rate: Tensor,
    share: Tensor,
    constants: tuple[float, float, float, float],
) -> None:
    """Scale a gradient, take a step of AdamW (Loshchilov and Hutter, algorithm 2), and move the
    average by `share`, in place. All weights at once would compile for minutes.

    Args:
        mean, square: Adam's first and second moments.
        correction, root_correction: of their bias: 1 − β₁ᵗ and √(1 − β₂ᵗ).
        factor, rate, share: of the clipping, of learning, and 1 − decay of the average.
        constants: β₁, β₂, ε and the weight decay.
    """
    first, second, epsilon, decay = constants
    clipped = gradient * factor
    weight.mul_(1 - rate * decay)
    mean.lerp_(clipped, 1 - first)
    square.mul_(second).addcmul_(clipped, clipped, value=1 - second)
    root = square.sqrt() / root_correction + epsilon
    weight.sub_(mean / correction / root * rate)
    average.add_((weight - average) * share)
