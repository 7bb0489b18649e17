"""Which backbone a configuration names, and building without weights."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor, nn
from torch.overrides import TorchFunctionMode

from mme_vla.backbone.base import Backbone
from mme_vla.errors import UserError
from mme_vla.registry import BACKBONES, LEFTOVER_OPTIONS

_INITIALISERS = {Tensor.normal_, Tensor.uniform_}


@contextmanager
def shapes_only() -> Iterator[None]:
    """Build on `meta`, and leave out initialisation, a third of the time that building
    takes there.
    """
    with torch.device("meta"), _WithoutInit():
        yield


class _WithoutInit(TorchFunctionMode):
    def __torch_function__(
        self,
        func: Callable[..., Any],
        types: Sequence[type],
        args: Sequence[Any] = (),
        kwargs: Mapping[str, Any] | None = None,
    ) -> Any:
        kwargs = kwargs or {}
        if func in _INITIALISERS or getattr(func, "__module__", None) == nn.init.__name__:
            tensor = args[0] if args else kwargs["tensor"]
            if tensor.is_meta:
                return tensor
        return func(*args, **kwargs)


def read_backbone(section: Mapping[str, Any]) -> tuple[type[Backbone], Any]:
    """The class that the section `backbone` names, and its sizes."""
    from mme_vla.config.sections import read_section, without

    kind: type[Backbone] = BACKBONES[str(section.get("name"))]
    sizes = without(section, "name")
    try:
        return kind, read_section(kind.Config, sizes, "backbone")
    except UserError as error:
        if sizes.keys() <= {spec.name for spec in fields(kind.Config)}:
            raise
        raise UserError(f"{error} {LEFTOVER_OPTIONS['backbone']}") from error


def shape_of(section: Mapping[str, Any]) -> Backbone:
    """The backbone of a section without weights (on the device `meta`), for its sizes."""
    shape: tuple[Any, Any] = read_backbone(section)
    try:
        hash(shape)
    except TypeError:  # a dataclass that is not frozen
        return _shape(*shape)
    return _cached_shape(*shape)


def _shape(kind: type[Backbone], sizes: Any) -> Backbone:
    with shapes_only():
        return kind(sizes)


_cached_shape = lru_cache(maxsize=32)(_shape)
