"""What every model costs at full size, as counted by `mme_vla.evaluation.analyses.cost`; reading it needs no torch."""

import csv
from dataclasses import asdict, dataclass, fields
from functools import cache
from pathlib import Path

REPLAN = 16
"""Frames that pass between two chunks of an episode."""
_COUNTED = Path(__file__).resolve().parent.parent / "assets" / "cost.csv"


@dataclass(frozen=True)
class ModelCost:
    """One model's cost; all but `prompt` (tokens) and `parameters` in FLOPs.

    forward: the loss of one training sample. chunk: memory, prefix and ten Euler steps. memory: of these, encoding the
    memory tokens from scratch. streamed: instead, a recurrent memory's update by one frame (None for others). frames:
    the vision tower on those of `REPLAN` passing frames that the memory stores.
    """

    model: str
    prompt: int
    parameters: int
    forward: int
    chunk: int
    memory: int
    streamed: int | None
    frames: int


@cache
def counted() -> dict[str, ModelCost]:
    """The shipped counts of every model at full size, made by `python -m mme_vla.analyse cost`."""
    with _COUNTED.open(newline="") as file:
        rows = list(csv.DictReader(file))
    numbers = [{key: int(text) if text else None for key, text in row.items() if key != "model"} for row in rows]
    return {row["model"]: ModelCost(row["model"], **of) for row, of in zip(rows, numbers, strict=True)}  # type: ignore


def chunk_flops() -> dict[str, float]:
    """FLOPs of a sampled chunk at full size, by model."""
    return {model: float(cost.chunk) for model, cost in counted().items()}


def write_costs(costs: list[ModelCost], path: Path) -> None:
    """Write counts as CSV."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, [member.name for member in fields(ModelCost)], lineterminator="\n")
        writer.writeheader()
        writer.writerows(asdict(cost) for cost in costs)
