"""Sharding groups: which weights processes gather together, and in what precision."""

from collections.abc import Iterator
from typing import NamedTuple

from torch import nn


class ShardGroup(NamedTuple):
    """A module whose weights are gathered before its forward and freed after it.

    module: its weights are read in its forward alone, and it returns tensors or collections of
        them.
    full: gather in float32 instead of bfloat16: modules that compute in float32, and towers that
        hold such layers without calling them.
    """

    module: nn.Module
    full: bool = False


def stacked_layers(module: nn.Module) -> Iterator[nn.Module]:
    """The layers of a network: members of a `ModuleList` of at least two of one class, of nested
    ones the outermost.

    They run one after the other, so that one layer's weights are needed at a time.
    """
    for child in module.children():
        inside = list(child.children())
        alike = len({type(layer) for layer in inside}) == 1 and not isinstance(
            inside[0], nn.ModuleList
        )
        if isinstance(child, nn.ModuleList) and len(inside) > 1 and alike:
            yield from inside
        else:
            yield from stacked_layers(child)


def float32_modules(group: nn.Module) -> list[nn.Module]:
    """The modules inside a group that compute in float32: norms, and those with `keeps_float32`."""
    if getattr(group, "keeps_float32", False):
        return [group]
    children = list(group.children())
    local = list(group.parameters(recurse=False))
    if not children:
        return [group] if local and all(parameter.ndim < 2 for parameter in local) else []
    return [module for child in children for module in float32_modules(child)]
