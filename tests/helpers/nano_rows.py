"""Small rows of nanoMME's board: four tasks of three scenes."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from mme_vla.embodiment import ROBOMME_JOINT
from mme_vla.envs.metadata import episodes
from mme_vla.evaluation.records import EpisodeRecord
from mme_vla.evaluation.store import begin_run
from mme_vla.policy.saving import composition_digest
from mme_vla.policy.training_identity import TrainingIdentity
from mme_vla.utils import write_json

TASKS = ("BinFill", "VideoUnmask", "VideoRepick", "MoveCube")
SPLIT, SCENES = "further", 3


def write_training(
    root: Path,
    row: str,
    seed: int,
    won: Mapping[str, int] | int,
    kind: str = "policy",
    action_space: str = "multi_choice",
    **facts: Any,
) -> Path:
    """A folder of a training that solves the first so many scenes of each task."""
    folder = root / row / str(seed)
    model, trained = row.partition("@")[0], facts.pop("trained", True)
    budget = int(row.partition("@")[2] or 32)
    identity = {"recipe": "r", "data": "d", "weights": f"{row}{seed}"} if trained else {}
    identity |= {name: facts.pop(name) for name in identity.keys() & facts.keys()}
    config = {
        "name": model,
        "backbone": {"name": "nano"},
        "memory": {"name": model, "budget": budget},
        "embodiment": ROBOMME_JOINT.to_dict(),
    }
    settings = {"model": model, "checkpoint": 100, "seed": 7, "split": SPLIT, "max_steps": 500}
    begin_run(folder, settings)
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    costs = {
        "parameters": 1_419_194,
        "update_flops": 1.2e10,
        "update_s": 0.13,
        "cpu_minutes": 7.0,
        "budget": budget,
    }
    write_json(
        folder / "trained.json",
        {"row": row, "kind": kind, "trained": trained, "seed": seed, **identity, **costs, **facts},
    )
    records = []
    for task in TASKS:
        count = won if isinstance(won, int) else won.get(task, 0)
        for spec in episodes(task, SPLIT)[:SCENES]:
            outcome = "success" if spec.episode < count else "fail"
            records.append(
                EpisodeRecord(
                    model,
                    100,
                    7,
                    task,
                    spec.episode,
                    spec.seed,
                    spec.difficulty,
                    outcome,
                    9,
                    split=SPLIT,
                    max_steps=500,
                    action_space=action_space,
                    memory_budget=budget,
                    composition=composition_digest(config),
                    training=TrainingIdentity(seed, **identity) if trained else None,
                )
            )
    write_records(folder, records)
    return folder


def write_records(folder: Path, records: list[EpisodeRecord]) -> None:
    (folder / "episodes.jsonl").write_text("".join(record.to_json() + "\n" for record in records))


def records_of(folder: Path) -> list[EpisodeRecord]:
    return [
        EpisodeRecord.from_json(line)
        for line in (folder / "episodes.jsonl").read_text().splitlines()
    ]
