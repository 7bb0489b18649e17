"""How many frames a token budget holds, checked without PyTorch."""

from collections.abc import Mapping
from typing import Any

from mme_vla.errors import check_sizes, require

LEAST_FRAMES = {"framesamp": 1, "retrieval": 1, "anchors": 2, "events": 2, "keyframes": 3}
"""The memories whose budget is a whole number of frames, each with the fewest that it needs."""


def budget_frames(budget: int, grid: int, at_least: int = 1) -> int:
    """How many frames of grid×grid tokens a budget holds; raises `UserError` unless it holds whole
    ones, and enough.
    """
    check_sizes("memory", budget=budget, grid=grid)
    least = max(budget // grid**2, at_least) * grid**2
    require(
        budget == least,
        f"memory.budget={budget} is not a whole number of {grid}×{grid}-token frames, at least"
        f" {at_least}: choose a multiple of {grid**2}, such as {least}.",
    )
    return budget // grid**2


def check_budget(memory: Any) -> None:
    """Check the budget of the section `memory` of a configuration, where it is one of whole frames
    and both sizes are given.
    """
    if not isinstance(memory, Mapping):
        return
    least = LEAST_FRAMES.get(str(memory.get("name")))
    if least is not None and "budget" in memory and "grid" in memory:
        budget_frames(memory["budget"], memory["grid"], least)
