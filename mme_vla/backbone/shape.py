"""From the section `backbone` of a configuration to the class it names, its sizes and its shape."""

from collections.abc import Mapping
from functools import lru_cache
from typing import Any

from mme_vla.backbone.base import Backbone
from mme_vla.backbone.shapes_only import shapes_only
from mme_vla.config.sections import read_section
from mme_vla.registry import BACKBONES


def read_backbone(section: Mapping[str, Any]) -> tuple[type[Backbone], Any]:
    """The class that the section `backbone` names, and its sizes.

    Raises:
        UserError: an unknown backbone or size.
    """
    kind: type[Backbone] = BACKBONES[str(section.get("name"))]
    return kind, read_section(kind.Config, {key: value for key, value in section.items() if key != "name"}, "backbone")


def shape_of(section: Mapping[str, Any]) -> Backbone:
    """The backbone of a section without weights (on the device `meta`), to be asked for its sizes.

    Raises:
        UserError: an unknown backbone or size.
    """
    found: tuple[Any, Any] = read_backbone(section)
    try:
        hash(found)
    except TypeError:  # somebody's dataclass that can be changed
        return _shape(*found)
    return _remembered(*found)


def _shape(kind: type[Backbone], sizes: Any) -> Backbone:
    with shapes_only():
        return kind(sizes)


_remembered = lru_cache(maxsize=32)(_shape)
