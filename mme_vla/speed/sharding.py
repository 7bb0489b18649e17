"""Which weights processes that share a policy gather together, and in what precision."""

from collections.abc import Iterator
from typing import NamedTuple

from torch import nn


class ShardGroup(NamedTuple):
    """A module whose weights are gathered right before it runs, and let go of after.

    module: it runs by being called, nobody reads its weights but then, and it answers with tensors, or with tuples,
        lists and dictionaries of tensors.
    full: gathered in float32 where all else is gathered in bfloat16: what computes in float32, and towers that hold
        such layers without calling them.
    """

    module: nn.Module
    full: bool = False


def stacked_layers(module: nn.Module) -> Iterator[nn.Module]:
    """The layers of a network: those that stand in a list of at least two of one class; of nested ones the outermost.

    They run one after the other, so that of all their weights one layer's are needed at a time.
    """
    for child in module.children():
        inside = list(child.children())
        alike = len({type(layer) for layer in inside}) == 1 and not isinstance(inside[0], nn.ModuleList)
        if isinstance(child, nn.ModuleList) and len(inside) > 1 and alike:
            yield from inside
        else:
            yield from stacked_layers(child)


def float32_modules(group: nn.Module) -> list[nn.Module]:
    """The modules inside a group that compute in float32: norms, and those that say so (`keeps_float32`)."""
    if getattr(group, "keeps_float32", False):
        return [group]
    children = list(group.children())
    local = list(group.parameters(recurse=False))
    if not children:
        return [group] if local and all(parameter.ndim < 2 for parameter in local) else []
    return [module for child in children for module in float32_modules(child)]
