"""Putting backbone, memory and integration together: a memory for a backbone, and whether it can stand in time."""

from collections.abc import Mapping, Set
from typing import Any

from mme_vla.errors import UserError
from mme_vla.integration.base import Integration, doors_of
from mme_vla.memory.base import Memory
from mme_vla.registry import MEMORIES


def build_memory(section: Mapping[str, Any], d_vision: int, grid: int, width: int) -> Memory:
    """The memory of a configuration.

    Args:
        d_vision: width of a vision token. grid: side of a view's token grid. width: of the memory's own tokens.

    Raises:
        UserError: an unknown memory or option, or a grid to which a view's cannot be pooled.
    """
    memory: Memory = MEMORIES.build(section, d_vision=d_vision, width=width)
    memory.check_grid(grid)
    return memory


def check_integrated(
    config: Mapping[str, Any], integration: Integration, memory: Memory | None, hosts: Set[str]
) -> None:
    """Make sure that memory and integration go together, and that the backbone has a place for what they bring.

    Raises:
        UserError: one of them without the other, memory tokens in time that have none, or past views for a tower that
            sees one picture at a time.
    """
    speaks = memory is not None and memory.budget > 0
    if speaks != (integration.memory_width > 0):
        if memory is not None and not speaks:
            raise UserError(
                f"The memory {config['memory']['name']!r} hands over no tokens as it is set, for an integration to "
                "bring to the backbone: choose integration=none, or let it have some (memory.states=true)."
            )
        given = "an integration without a memory" if memory is None else "a memory without an integration"
        raise UserError(f"This configuration names {given}; name both, or neither for the memoryless policy.")
    if memory is None:
        return
    check_past(config, memory, hosts)
    check_positions(config, integration, memory, hosts)


def check_past(config: Mapping[str, Any], memory: Memory, hosts: Set[str]) -> None:
    """Make sure that a memory that gives past views has a backbone whose vision tower looks at them.

    Raises:
        UserError: that of this backbone sees one picture at a time.
    """
    if memory.looks_back is not None and "past" not in hosts:
        raise UserError(
            f"The memory {config['memory']['name']!r} gives the vision tower past views along with the current ones, "
            f"and the tower of the backbone {config['backbone']['name']!r} sees one picture at a time. Take another "
            "memory, a backbone that hosts `past` (pi05), or past states alone (memory.views=false)."
        )


def check_positions(config: Mapping[str, Any], integration: Integration, memory: Memory, hosts: Set[str]) -> None:
    """Make sure that a memory that shall be placed in time can be: its tokens have one, the backbone a place for it."""
    if integration.memory_position != "time":
        return
    if not memory.timed:
        raise UserError(
            f"integration.memory_position=time: the tokens of the memory {config['memory']['name']!r} stand for no one "
            "moment each. Take memory_position=slot, or a memory that says `timed`."
        )
    if "blocks" in doors_of(type(integration)) and "positions" not in hosts:
        raise UserError(
            f"integration.memory_position=time: the backbone {config['backbone']['name']!r} has no place for blocks at "
            "positions of their own. Take memory_position=slot, or integration=modulator where it hosts that."
        )
