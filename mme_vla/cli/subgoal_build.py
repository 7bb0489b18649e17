"""`mme-vla subgoal-build input=… output=…`: training data of the subgoal predictors."""

from pathlib import Path
from typing import Any

from omegaconf import DictConfig, ListConfig

from mme_vla.cli.command import cli
from mme_vla.config.sections import read_section
from mme_vla.errors import UserError
from mme_vla.subgoal.finetuning.collecting import build, open_input
from mme_vla.subgoal.finetuning.rows import SETS, RowOptions
from mme_vla.subgoal.finetuning.training import write_arguments


@cli("subgoal_build")
def main(cfg: DictConfig) -> dict[str, int]:
    """Build what configs/subgoal_build.yaml and the command line say."""
    inputs = [cfg.input] if isinstance(cfg.input, str) else _list(cfg, "input", str)
    tasks = None if cfg.tasks is None else Path(str(cfg.tasks))
    numbers = None if cfg.episodes is None else set(_list(cfg, "episodes", int))
    sets = _list(cfg, "sets", str)
    for name in sets:
        if name not in SETS:
            raise UserError(f"sets: there is no {name!r}; known: {', '.join(SETS)}.")
    noise = None if cfg.noise is None else tuple(_list(cfg, "noise", int))
    options = read_section(RowOptions, cfg.rows, "rows", noise=noise, seed=cfg.seed)
    episodes = [episode for entry in inputs for episode in open_input(entry, tasks)]
    episodes = [episode for episode in episodes if numbers is None or episode.number in numbers]
    output = Path(cfg.output)
    counts = build(episodes, output, sets, options)
    for name, count in counts.items():
        write_arguments(output, name)
        print(f"{output / name}.jsonl: {count} rows of {len(episodes)} episodes")
    return counts


def _list(cfg: DictConfig, key: str, kind: type) -> list[Any]:
    """A key that is a list of whole numbers or of words."""
    value = cfg[key]
    if not isinstance(value, ListConfig) or any(not isinstance(v, kind) or isinstance(v, bool) for v in value):
        expected, example = ("whole numbers", "[0,1]") if kind is int else ("words", f"[{value}]")
        raise UserError(f"{key}={value} must be a list of {expected}, such as {key}={example}.")
    return list(value)
