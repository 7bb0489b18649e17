"""What happens inside a policy while it acts, by hooks that exist only inside a `with` block."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Self

import torch
from torch import Tensor, nn

from mme_vla.backbone.gemma import JointBlock, LayerTimeModulation, Layout, StaticKV
from mme_vla.backbone.layers import layout_mask
from mme_vla.errors import UserError, require
from mme_vla.integration.modulator import Modulator
from mme_vla.policy.mme import MMEPolicy

PARTS = {"memory": "memory", "images": "observation", "prompt": "language", "action": "action"}
"""Block → what the paper calls it; blocks of other names keep theirs."""


@dataclass
class AttentionMass:
    """Attention probability mass of the action tokens by layer and part.

    parts: names of the columns.
    layers: [depth, parts], each row sums to 1: means over action tokens, heads, Euler steps and
        samples.
    """

    parts: list[str]
    layers: Tensor

    def share(self, part: str) -> Tensor:
        """Mass by layer [depth] outside the actions themselves, so that it adds up to 100 % as in
        the paper's table.
        """
        self_mass = self.layers[:, self.parts.index("action")]
        return self.layers[:, self.parts.index(part)] / (1 - self_mass)

    def table(self) -> list[tuple[str, float, float]]:
        """(part, mean, maximum over layers) in percent; the actions' own share is of everything."""
        rows = []
        for part in self.parts:
            if part == "action":
                values = self.layers[:, self.parts.index(part)]
            else:
                values = self.share(part)
            rows.append((part, 100 * float(values.mean()), 100 * float(values.max())))
        return rows


class Watch[T]:
    """Adds up numbers of a policy's modules while it is entered; a subclass adds the hooks and
    reads the sums.
    """

    def __init__(self, policy: MMEPolicy) -> None:
        self.policy = policy
        self._handles: list[Any] = []
        self._sums = self._lap = torch.zeros(())

    def __enter__(self) -> Self:
        self._handles = self._hooks()
        return self

    def __exit__(self, *_: object) -> None:
        for handle in self._handles:
            handle.remove()

    def result(self) -> T:
        """What was observed."""
        return self._checked(self._sums)

    def lap(self) -> T:
        """What was observed since the last lap."""
        since, self._lap = self._sums - self._lap, self._sums.clone()
        return self._checked(since)

    def _checked(self, sums: Tensor) -> T:
        require(
            sums.any(),
            f"{type(self).__name__} has seen nothing: let the policy act inside the `with` block.",
        )
        return self._read(sums)

    def _hooks(self) -> list[Any]:
        raise NotImplementedError

    def _read(self, sums: Tensor) -> T:
        raise NotImplementedError


class AttentionWatch(Watch[AttentionMass]):
    """The attention of a policy's action tokens, of every pass.

    The probabilities are computed a second time, from the inputs that each layer is about to read.

    >>> with AttentionWatch(policy) as watch:  # doctest: +SKIP
    ...     policy.act(episodes)
    >>> watch.result().table()  # doctest: +SKIP
    """

    _names: Sequence[str] = ()
    _lengths: Sequence[int] = ()
    _watching = False

    def _hooks(self) -> list[Any]:
        transformer: Any = self.policy.backbone.transformer
        handles = [transformer.register_forward_pre_hook(self._begin, with_kwargs=True)]
        for i, layer in enumerate(transformer.layers):
            hook = partial(self._layer, i)
            handles.append(layer.register_forward_pre_hook(hook, with_kwargs=True))
        return handles

    def _read(self, sums: Tensor) -> AttentionMass:
        parts = list(dict.fromkeys(PARTS.get(name, name) for name in self._names))
        layers = torch.zeros(len(sums), len(parts), dtype=torch.float64)
        for column, name in enumerate(self._names):
            layers[:, parts.index(PARTS.get(name, name))] += sums[:, column]
        return AttentionMass(parts, layers / layers.sum(1, keepdim=True))

    def _begin(self, transformer: Any, args: tuple, kwargs: dict[str, Any]) -> None:
        layout: Layout = kwargs["layout"] if "layout" in kwargs else args[1]
        blocks: Sequence[Any] = kwargs["blocks"] if "blocks" in kwargs else args[0]
        self._watching = blocks[-1].expert == transformer.action_expert
        if not self._watching:
            return
        self._names = [span.name for span in layout.spans]
        self._lengths = [span.length for span in layout.spans]
        if not self._sums.ndim:
            shape = (len(transformer.layers), len(layout.spans))
            self._sums = torch.zeros(shape, dtype=torch.float64)
        self._mask = layout_mask(layout.mask_layout, torch.float32)

    @torch.no_grad()
    def _layer(self, index: int, block: JointBlock, args: tuple, kwargs: dict[str, Any]) -> None:
        if not self._watching:
            return
        names = ("segments", "rope", "mask", "condition", "hook", "past")
        arguments = {**dict.fromkeys(names), **dict(zip(names, args, strict=False)), **kwargs}
        segments, condition = arguments["segments"], arguments["condition"]
        of_attention = condition
        if isinstance(condition, LayerTimeModulation):
            of_attention = condition.attention
        past: StaticKV | None = arguments["past"]
        keys: list[Tensor] = []
        if past is not None:
            keys.append(past.past()[0])
        row = 0
        q = None
        for segment in segments:
            rows = slice(row, row + segment.tokens.shape[1])
            answers = segment.expert == block.action_expert
            layer: Any = block.experts[segment.expert]
            queries, k, _, _ = layer.project(
                segment.summed(), arguments["rope"].rows(rows), of_attention if answers else None
            )
            keys.append(k)
            row = rows.stop
            if answers:
                q, mask = queries, self._mask[:, :, rows]
        assert q is not None
        k = torch.cat(keys, 1).repeat_interleave(q.shape[2] // keys[0].shape[2], dim=2)
        logits = torch.einsum("bqnh,bknh->bnqk", q.float(), k.float()) * q.shape[-1] ** -0.5 + mask
        mass = logits.softmax(-1).mean((1, 2))  # b k
        parts = torch.stack([part.sum(1) for part in mass.split(self._lengths, dim=1)], 1)
        self._sums[index] += parts.sum(0).double().cpu()


@dataclass
class ModulationStats:
    """Mean and deviation [depth] of a layer's predicted scales a and biases β, over samples, steps,
    tokens, features.

    The residual stream is multiplied by 1 + a. `overall` pools the layers.
    """

    scale: tuple[Tensor, Tensor]
    bias: tuple[Tensor, Tensor]
    overall: dict[str, tuple[float, float]]


class ModulationWatch(Watch[ModulationStats]):
    """What a policy's modulator predicts."""

    def _hooks(self) -> list[Any]:
        integration = self.policy.integration
        if not isinstance(integration, Modulator):
            raise UserError(
                "This policy has no modulator to observe: choose integration=modulator, or"
                " framesamp_modul."
            )
        if not self._sums.ndim:
            self._sums = torch.zeros(len(integration.layers), 2, 3, dtype=torch.float64)
        handles = []
        for i, layer in enumerate(integration.layers):
            linear: Any = layer.modulation
            handles.append(linear.register_forward_hook(partial(self._take, i)))
        return handles

    def _read(self, sums: Tensor) -> ModulationStats:
        mean, std = _moments(sums)  # depth × (scale, bias) × (count, sum, squares)
        means, stds = _moments(sums.sum(0))
        overall = {
            "scale": (float(means[0]), float(stds[0])),
            "bias": (float(means[1]), float(stds[1])),
        }
        return ModulationStats((mean[:, 0], std[:, 0]), (mean[:, 1], std[:, 1]), overall)

    def _take(self, index: int, _module: nn.Module, _args: tuple, output: Tensor) -> None:
        for row, part in enumerate(output.chunk(2, dim=-1)):
            values = part.detach().double()
            sums = [values.new_tensor(values.numel()), values.sum(), values.square().sum()]
            self._sums[index, row] += torch.stack(sums).cpu()


def _moments(sums: Tensor) -> tuple[Tensor, Tensor]:
    count, total, squares = sums.unbind(-1)
    mean = total / count
    return mean, (squares / count - mean.square()).clamp(min=0).sqrt()
