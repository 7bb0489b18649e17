"""`mme-vla subgoal-build input=… output=…`: training data of the subgoal predictors."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from omegaconf import DictConfig

from mme_vla.config.composition import resolved
from mme_vla.config.sections import NonNegativeInt, PathText, read_section
from mme_vla.errors import counted
from mme_vla.subgoal.finetuning.collecting import build, open_input
from mme_vla.subgoal.finetuning.rows import RowOptions
from mme_vla.subgoal.finetuning.training import write_arguments


@dataclass(frozen=True)
class BuildSettings:
    """The keys of configs/subgoal_build.yaml."""

    input: str | tuple[str, ...]
    output: PathText
    sets: tuple[Literal["simple", "grounded", "memer", "memer_simple"], ...]
    episodes: tuple[NonNegativeInt, ...] | None
    tasks: PathText | None
    noise: tuple[int, int] | None
    rows: Mapping[str, Any]
    seed: NonNegativeInt


def main(cfg: DictConfig) -> dict[str, int]:
    """Build what configs/subgoal_build.yaml and the command line say."""
    settings = read_section(BuildSettings, resolved(cfg), others=True)
    options = read_section(
        RowOptions, settings.rows, "rows", noise=settings.noise, seed=settings.seed
    )
    inputs = (settings.input,) if isinstance(settings.input, str) else settings.input
    tasks = None if settings.tasks is None else Path(settings.tasks)
    episodes = []
    for entry in inputs:
        for episode in open_input(entry, tasks):
            if settings.episodes is None or episode.number in settings.episodes:
                episodes.append(episode)
    output = Path(settings.output)
    counts = build(episodes, output, settings.sets, options)
    for name, count in counts.items():
        write_arguments(output, name)
        of = counted(len(episodes), "episode")
        print(f"{output / name}.jsonl: {counted(count, 'row')} of {of}")
    return counts
