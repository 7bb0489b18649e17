"""Name tables: how a foreign checkpoint names and lays out our tensors, written once and read in
both directions.

A package supplies a table for its own modules; an adapter in `weights/` applies the tables to whole
checkpoints.
"""

import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import torch
from einops import rearrange
from torch import Tensor

from mme_vla.backbone.pi05 import Pi05Backbone
from mme_vla.errors import UserError, counted
from mme_vla.policy.base import Policy
from mme_vla.policy.sections import PolicySections
from mme_vla.policy.tensor_files import check_fit


@dataclass(frozen=True)
class Piece:
    """Some rows of one of our tensors, as they lie in a foreign one.

    path: the foreign name.
    pattern: einops pattern from theirs to ours; empty where they are the same.
    axes: sizes of the pattern's grouped axes, which the way back needs.
    layer: index in the foreign tensor's leading layer axis, if it has one.
    """

    path: str
    pattern: str = ""
    axes: Mapping[str, int] = field(default_factory=dict)
    layer: int | None = None

    def to_target(self, tensor: Tensor) -> Tensor:
        if self.layer is not None:
            # a tensor of its own, which keeps no other layer in memory
            tensor = tensor[self.layer].clone()
        if not self.pattern:
            return tensor
        return rearrange(tensor, self.pattern, **self.axes)

    def to_source(self, tensor: Tensor) -> Tensor:
        if not self.pattern:
            return tensor
        left, right = self.pattern.split("->")
        return rearrange(tensor, f"{right} -> {left}", **self.axes)

    def rows(self) -> int:
        """How many rows of our tensor this piece fills; asked only where several
        pieces share one.
        """
        right = self.pattern.split("->")[1].strip()
        axes = right.split()[:1]
        if right.startswith("("):  # the leading axis groups several
            axes = right[1:].split(")")[0].split()
        return math.prod(self.axes[axis] for axis in axes)


NameTable = dict[str, list[Piece]]
"""Our parameter name → the pieces that make it, in order of rows."""


@dataclass(frozen=True)
class Unread:
    """A foreign tensor, or one layer of it, that no action reads: dropped when read, zeros when
    written.
    """

    path: str
    shape: tuple[int, ...]
    layer: int | None = None


@dataclass(frozen=True)
class Derived:
    """A foreign tensor that follows from the configuration: recomputed, never read, and written for
    other readers.
    """

    path: str
    make: Callable[[], Tensor]


def prefixed(prefix: str, table: NameTable) -> NameTable:
    """Return the table of a module that sits at `prefix` in its parent."""
    return {f"{prefix}.{name}": pieces for name, pieces in table.items()}


def linear(path: str, *, layer: int | None = None) -> NameTable:
    """A linear layer stored as kernel (in, out), with its bias."""
    kernel = Piece(f"{path}/kernel", "i o -> o i", layer=layer)
    bias = Piece(f"{path}/bias", layer=layer)
    return {"weight": [kernel], "bias": [bias]}


def read(table: NameTable, source: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Translate a foreign checkpoint, which has all names of the table in their shapes, into our
    names and layouts.
    """
    target = {}
    for name, pieces in table.items():
        parts = [piece.to_target(source[piece.path]) for piece in pieces]
        target[name] = torch.cat(parts) if len(parts) > 1 else parts[0].contiguous()
    return target


def write(
    table: NameTable,
    unread: Iterable[Unread],
    target: Mapping[str, Tensor],
    derived: Iterable[Derived] = (),
) -> dict[str, Tensor]:
    """Translate our tensors into the foreign names and layouts; what no action reads is written as
    zeros.
    """
    layers: dict[str, dict[int, Tensor]] = defaultdict(dict)
    released: dict[str, Tensor] = {}

    def put(path: str, layer: int | None, tensor: Tensor) -> None:
        if layer is None:
            released[path] = tensor.contiguous()
        else:
            layers[path][layer] = tensor

    example = next(iter(target.values()))
    for name, pieces in table.items():
        parts: Sequence[Tensor] = [target[name]]
        if len(pieces) > 1:
            parts = target[name].split([piece.rows() for piece in pieces])
        for piece, part in zip(pieces, parts, strict=True):
            put(piece.path, piece.layer, piece.to_source(part))
    for gap in unread:
        put(gap.path, gap.layer, example.new_zeros(gap.shape))
    for path, by_layer in layers.items():
        released[path] = torch.stack([by_layer[i] for i in sorted(by_layer)])
    for constant in derived:
        released[constant.path] = constant.make()
    return released


@dataclass(frozen=True)
class Adapter:
    """How a foreign format names and lays out the tensors of one policy.

    table: our name → the foreign tensors it is made of.
    unread: foreign tensors, or layers of them, that no action reads: dropped when read, zeros when
        written.
    tied: foreign name → the foreign name it repeats: optional when read, written as a copy.
    derived: foreign constants that follow from the configuration: dropped when read, recomputed
        when written.
    fresh: our names that a checkpoint to start from may lack, beside the memory's: heads that are
        trained anew.
    of_memory: pattern of the foreign names of a memory's tensors. A start from a checkpoint leaves
        them behind where the policy has no place for them.
    """

    table: NameTable
    unread: list[Unread] = field(default_factory=list)
    tied: Mapping[str, str] = field(default_factory=dict)
    derived: list[Derived] = field(default_factory=list)
    fresh: frozenset[str] = frozenset()
    of_memory: str | None = None

    def needed(self) -> set[str]:
        """Foreign names without which the policy cannot be filled."""
        paths = set()
        for pieces in self.table.values():
            paths |= {piece.path for piece in pieces}
        return paths

    def export(self, target: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Write our tensors in the foreign names and layouts, the three lists included."""
        unnamed = sorted(set(target) - set(self.table))
        if unnamed:
            raise UserError(
                f"This format has no name for {counted(len(unnamed), 'tensor')}:"
                f" {', '.join(unnamed)}. It holds memoryless policies without adapters: convert"
                " another policy, merge the adapters first, or choose another format."
            )
        released = write(self.table, self.unread, target, self.derived)
        return released | {name: released[original] for name, original in self.tied.items()}

    def shapes(self, target: Mapping[str, Tensor]) -> dict[str, tuple[int, ...]]:
        """Every foreign name but the derived ones, with its shape, where ours have the shapes of
        `target`.
        """
        on_meta = {name: torch.empty_like(target[name], device="meta") for name in self.table}
        released = write(self.table, self.unread, on_meta)
        released |= {name: released[original] for name, original in self.tied.items()}
        return {name: tuple(tensor.shape) for name, tensor in released.items()}

    def translate(
        self, released: Mapping[str, Tensor], target: Mapping[str, Tensor], source: str
    ) -> dict[str, Tensor]:
        """Read foreign tensors into our names; `target` gives the shapes they must have."""
        self.check_fit(released, target, source)
        for constant in self.derived:
            if constant.path not in released:
                continue
            # What a checkpoint stores of them must be what this configuration gives.
            stored = released[constant.path].real.float().cpu()
            expected = constant.make().real.float().cpu()
            is_equal = stored.shape == expected.shape and torch.allclose(
                stored, expected, rtol=1e-2, atol=1e-2
            )
            if not is_equal:
                raise UserError(
                    f"The checkpoint's {constant.path} {tuple(stored.shape)} is not the constant"
                    f" this configuration gives {tuple(expected.shape)}: it was trained with other"
                    " sizes or rates; set the same here."
                )
        return read(self.table, released)

    def check_fit(
        self, released: Mapping[str, Tensor], target: Mapping[str, Tensor], source: str
    ) -> None:
        """Compare names and shapes alone, so that foreign tensors may still be on meta: not read
        yet.
        """
        shapes = self.shapes(target)
        derived = {constant.path for constant in self.derived}
        tensors = {name: tensor for name, tensor in released.items() if name not in derived}
        check_fit(tensors, shapes, source, optional=set(shapes) - self.needed())


def pi05_of(policy: Policy) -> Pi05Backbone:
    """The policy's backbone, where it is π0.5: the only one these formats hold."""
    backbone = getattr(policy, "backbone", None)
    if not isinstance(backbone, Pi05Backbone):
        raise UserError(
            "Checkpoints of LeRobot's π0.5, openpi and the released trees hold π0.5; this policy's"
            f" backbone is {type(backbone or policy).__name__}."
        )
    return backbone


def wrong_policy(policy: Policy, contents: str, change: str) -> UserError:
    """Make the error for a policy that a format does not hold.

    contents: the methods it holds.
    change: what to set instead.
    """
    name = PolicySections.of(policy.config).name or "this"
    return UserError(
        f"This format holds {contents}; {name} is a {type(policy).__name__}. Set {change}."
    )


def memory_parameters(policy: Policy) -> set[str]:
    """Names of the tensors a policy has beyond memoryless π0.5: memory, integration, and the
    memory's own expert.
    """
    component_of = policy.finetune_spec.component_of
    return {name for name in policy.state_dict() if component_of(name) == "memory"}
