"""How much the action tokens attend to memory, observation and language (paper, "Memory token contribution").

The probabilities are computed a second time, from the inputs each layer is about to read, by hooks that exist only
inside the context manager: a pass that nobody watches costs what it always did.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Self

import torch
from torch import Tensor

from mme_vla.backbone.attention import layout_mask
from mme_vla.backbone.gemma import JointBlock, KeyValue, LayerModulation, Layout, StaticKV
from mme_vla.errors import UserError
from mme_vla.policy.mme import MMEPolicy

PARTS = {"memory": "memory", "images": "observation", "prompt": "language", "action": "action"}
"""Block → what the paper calls it; blocks of other names keep theirs."""


@dataclass
class AttentionMass:
    """Attention probability mass of the action tokens by layer and part.

    parts: names of the columns. layers: [depth, parts], each row sums to 1: means over action tokens, heads, Euler
    steps and samples.
    """

    parts: list[str]
    layers: Tensor

    def share(self, part: str) -> Tensor:
        """Mass by layer [depth] outside the actions themselves, so that it adds up to 100 % as in the paper's table."""
        if part not in self.parts:
            raise UserError(f"No attention on {part!r}: the sequence holds {', '.join(self.parts)}.")
        self_mass = self.layers[:, self.parts.index("action")]
        return self.layers[:, self.parts.index(part)] / (1 - self_mass)

    def table(self) -> list[tuple[str, float, float]]:
        """(part, mean, maximum over layers) in percent; the actions' own share is of everything."""
        rows = []
        for part in self.parts:
            values = self.layers[:, self.parts.index(part)] if part == "action" else self.share(part)
            rows.append((part, 100 * float(values.mean()), 100 * float(values.max())))
        return rows


@dataclass
class AttentionWatch:
    """Watches every pass of a policy's action tokens while it is entered.

    >>> with AttentionWatch(policy) as watch:  # doctest: +SKIP
    ...     policy.act(episodes)
    >>> watch.result().table()  # doctest: +SKIP
    """

    policy: MMEPolicy
    _names: list[str] = field(default_factory=list)
    _lengths: list[int] = field(default_factory=list)
    _sums: Tensor | None = None
    _samples: int = 0
    _lap: tuple[Tensor | None, int] = (None, 0)
    _watching: bool = False
    _mask: Tensor = field(default_factory=lambda: torch.empty(0))
    _handles: list[Any] = field(default_factory=list)

    def __enter__(self) -> Self:
        transformer: Any = self.policy.backbone.transformer
        self._handles = [transformer.register_forward_pre_hook(self._begin, with_kwargs=True)]
        for i, layer in enumerate(transformer.layers):
            self._handles.append(layer.register_forward_pre_hook(partial(self._layer, i), with_kwargs=True))
        return self

    def __exit__(self, *_: object) -> None:
        for handle in self._handles:
            handle.remove()
        self._handles = []

    def result(self) -> AttentionMass:
        """What has been seen."""
        return self._mass(None, 0)

    def lap(self) -> AttentionMass:
        """What has been seen since the last lap."""
        mass = self._mass(*self._lap)
        assert self._sums is not None
        self._lap = (self._sums.clone(), self._samples)
        return mass

    def _mass(self, before: Tensor | None, samples: int) -> AttentionMass:
        if self._sums is None or self._samples == samples:
            raise UserError("No action token has been seen: let the policy act inside the `with` block.")
        sums = self._sums if before is None else self._sums - before
        parts = list(dict.fromkeys(PARTS.get(name, name) for name in self._names))
        layers = torch.zeros(len(sums), len(parts), dtype=torch.float64)
        for column, name in enumerate(self._names):
            layers[:, parts.index(PARTS.get(name, name))] += sums[:, column]
        return AttentionMass(parts, layers / (self._samples - samples))

    def _begin(self, transformer: Any, args: tuple, kwargs: dict[str, Any]) -> None:
        layout: Layout = kwargs["layout"] if "layout" in kwargs else args[1]
        blocks: Sequence[Any] = kwargs["blocks"] if "blocks" in kwargs else args[0]
        self._watching = blocks[-1].expert == transformer.action_expert
        if not self._watching:
            return
        names = [span.name for span in layout.spans]
        if self._names not in ([], names):
            raise UserError(f"One watch sees one kind of policy: the sequence was {self._names}, now it is {names}.")
        self._names, self._lengths = names, [span.length for span in layout.spans]
        if self._sums is None:
            self._sums = torch.zeros(len(transformer.layers), len(names), dtype=torch.float64)
        self._mask = layout_mask(layout.mask_layout, torch.float32)
        self._samples += len(layout.valid)

    @torch.no_grad()
    def _layer(self, index: int, block: JointBlock, args: tuple, kwargs: dict[str, Any]) -> None:
        if not self._watching:
            return
        names = ("segments", "turn", "mask", "condition", "hook", "past")
        arguments = {**dict.fromkeys(names), **dict(zip(names, args, strict=False)), **kwargs}
        segments, condition = arguments["segments"], arguments["condition"]
        of_attention = condition.attention if isinstance(condition, LayerModulation) else condition
        past: KeyValue | StaticKV | None = arguments["past"]
        if isinstance(past, StaticKV):
            past = past.past(sum(segment.tokens.shape[1] for segment in segments))
        keys: list[Tensor] = [] if past is None else [past[0]]
        row, q = 0, None
        for segment in segments:
            rows = slice(row, row + segment.tokens.shape[1])
            answers = segment.expert == block.action_expert
            layer: Any = block.experts[segment.expert]
            queries, k, _, _ = layer.project(
                segment.tokens, arguments["turn"].rows(rows), of_attention if answers else None
            )
            keys.append(k)
            row = rows.stop
            if answers:
                q, mask = queries, self._mask[:, :, rows]
        assert q is not None
        assert self._sums is not None
        k = torch.cat(keys, 1).repeat_interleave(q.shape[2] // keys[0].shape[2], dim=2)
        logits = torch.einsum("bqnh,bknh->bnqk", q.float(), k.float()) * q.shape[-1] ** -0.5 + mask
        mass = logits.softmax(-1).mean((1, 2))  # b k
        parts = torch.stack([part.sum(1) for part in mass.split(self._lengths, dim=1)], 1)
        self._sums[index] += parts.sum(0).double().cpu()
