"""`python -m mme_vla.nano task=VideoUnmask model=framesamp_modul`: from nothing to a page of results on two cores."""

import os
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig, OmegaConf

from mme_vla.config.composition import cli, config_dir
from mme_vla.errors import UserError, brief, did_you_mean
from mme_vla.files import read_json, write_json

if TYPE_CHECKING:
    from mme_vla.memory.base import Memory
    from mme_vla.nano.demonstrations import Looks

# Threads that wait asleep leave their cores to others; it counts only when set before PyTorch is imported.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
SEEDS_APART = 100_000  # first seeds of two difficulties
RETRIES = 20  # scenes in a row that no demonstration succeeds in


def main() -> None:
    """Run the command with the task's own settings, where it has a file of them."""
    sys.argv[1:] = with_settings(sys.argv[1:])
    command()


def with_settings(words: Sequence[str]) -> list[str]:
    """The words of a command line, after them what the task's file in configs/nano says; what is typed counts more."""
    tasks = [word.removeprefix("task=") for word in words if word.startswith("task=")]
    own = config_dir() / "nano" / f"{tasks[-1]}.yaml" if tasks else None
    if own is None or not own.is_file() or any(word.startswith("nano=") for word in words):
        return list(words)
    return [*words, f"nano={own.stem}"]


@cli("nano")
def command(cfg: DictConfig) -> None:
    """Record, train, evaluate and write the page, each as far as it is not there.

    Raises:
        UserError: anything in the settings or on the machine that cannot work.
    """
    from mme_vla.envs.make import check_names, require_simulator

    config = OmegaConf.to_container(cfg, resolve=True)
    assert isinstance(config, dict)
    check_names(config["task"], "mme_vla", "waypoint", None, None)
    check_counts(config["demonstrations"])
    require_simulator()
    run({str(key): value for key, value in config.items()})


def run(config: Mapping[str, Any]) -> Path:
    """All stages of a run; the path of its page, or the folder of the demonstrations where nothing else is wanted."""
    from mme_vla.nano.evaluating import run_episodes
    from mme_vla.nano.fitting import build, compose_policy, train
    from mme_vla.nano.page import write_page

    folder = Path(config["output"])
    folder.mkdir(parents=True, exist_ok=True)
    words = ["backbone=nano", f"embodiment={config['embodiment']}", "policy.augment=false", f"seed={config['seed']}"]
    models = list(dict.fromkeys([config["model"], *config["beside"]]))
    composed = {model: compose_policy(model, config["memories"], words) for model in models}
    drawn_for = [model for model in config["drawn_for"] if model not in composed]
    minutes = _Minutes(folder / "minutes.json")
    with minutes.of("demonstrations"):
        others = [compose_policy(model, config["memories"], words) for model in drawn_for]
        memories = [build(each).memory for each in (*composed.values(), *others)]
        looks: list[Looks] = [memory_looks(memory) for memory in memories if memory is not None]
        execute = int(composed[config["model"]]["embodiment"]["action"]["execute"])
        files = record_all(config, folder / "demonstrations", looks, execute)
    if config["record_only"]:
        return folder / "demonstrations"
    for model, each in composed.items():
        with minutes.of(f"training {model}"):
            checkpoint = train(each, config["train"], folder / model, files, config["learning"])
        with minutes.of(f"evaluation {model}"):
            run_episodes(
                checkpoint, folder / model / config["split"], config["task"], split=config["split"],
                episodes=config["episodes"], seeds=config["policy_seeds"], workers=config["workers"],
                max_steps=config["max_steps"],
            )  # fmt: skip
    page = write_page(folder, config, models, minutes.spent)
    print(page)
    return page


def memory_looks(memory: "Memory") -> "Looks":
    """Which frames a memory remembers at a step, from the step alone."""

    def look(step: int, exec_start: int) -> list[int]:
        frames: list[int] = memory.frames_read([step], exec_start).tolist()
        return frames

    return look


def check_counts(counts: Any) -> None:
    """Make sure that demonstrations are asked for as difficulty: how many.

    Raises:
        UserError: another form, an unknown difficulty, or fewer than two in all.
    """
    known = ("easy", "medium", "hard")
    if not isinstance(counts, Mapping) or not all(isinstance(n, int) and n >= 0 for n in counts.values()):
        raise UserError(f"demonstrations={brief(counts)}: write how many of each difficulty, such as {{easy: 100}}.")
    for level in counts:
        if level not in known:
            raise UserError(f"Unknown difficulty {brief(level)}. {did_you_mean(str(level), known)}")
    if sum(counts.values()) < 2:
        raise UserError(f"demonstrations={brief(counts)}: it takes two, to learn from and to measure by.")


def record_all(config: Mapping[str, Any], folder: Path, looks: "list[Looks]", execute: int = 1) -> list[Path]:
    """Demonstrate until there are as many as wanted, each in a file of its own; the files in their order.

    Args:
        execute: motions of a chunk that are executed before the policy is asked again.

    Raises:
        UserError: scene after scene without a demonstration that succeeds.
    """
    from mme_vla.data.progress import progress
    from mme_vla.embodiment.robomme import CAMERAS

    folder.mkdir(parents=True, exist_ok=True)
    cameras = [name for name in CAMERAS if name == "front" or "front" not in config["embodiment"]]
    counts: dict[str, int] = config["demonstrations"]
    files: list[Path] = []
    with progress("record", sum(counts.values()), unit="demonstrations") as advance:
        for number, (level, wanted) in enumerate(counts.items()):
            first = int(config["first_seed"]) + number * SEEDS_APART
            for path in demonstrations_of(config["task"], level, first, wanted, folder, looks, cameras, execute):
                files.append(path)
                advance(1)
    return files


def demonstrations_of(
    task: str,
    level: str,
    first_seed: int,
    count: int,
    folder: Path,
    looks: "list[Looks]",
    cameras: Sequence[str],
    execute: int = 1,
) -> Iterator[Path]:
    """The files of `count` demonstrations from this seed on; what is there is not made again, nor tried.

    Raises:
        UserError: scene after scene without a demonstration that succeeds.
    """
    from mme_vla.nano.demonstrations import record

    failed, found, seed = 0, 0, first_seed
    while found < count:
        path = folder / f"{level}-{seed}.npz"
        none = path.with_suffix(".failed")
        if not path.is_file() and not none.is_file():
            made = record(task, seed, level, looks, cameras, execute)
            if made is None:
                none.touch()
            else:
                made.save(path)
        there = path.is_file()
        failed = 0 if there else failed + 1
        if failed >= RETRIES:
            raise UserError(f"{task}: {RETRIES} {level} scenes in a row, to seed {seed}, cannot be demonstrated.")
        seed += 1
        if there:
            found += 1
            yield path


class _Minutes:
    """Wall minutes of each stage, added up over the runs of a command that was interrupted."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self.spent: dict[str, float] = read_json(path, "minutes of a run") if path.is_file() else {}

    @contextmanager
    def of(self, stage: str) -> Iterator[None]:
        """Time what happens inside; a stage that had nothing to do counts its moment."""
        begun = time.perf_counter()
        try:
            yield
        finally:
            self.spent[stage] = self.spent.get(stage, 0.0) + (time.perf_counter() - begun) / 60
            write_json(self._path, self.spent)
