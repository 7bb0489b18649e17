"""`python -m mme_vla.nano task=VideoUnmask model=framesamp_modul`: from nothing to a page of results on two cores."""

import re
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import count, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig

from mme_vla.cli.command import cli
from mme_vla.config.composition import command_trees, config_dir, resolved
from mme_vla.errors import UserError, brief, require
from mme_vla.utils import read_json, write_json

if TYPE_CHECKING:
    from mme_vla.embodiment import Embodiment
    from mme_vla.envs.recording.frames import FrameChoice
    from mme_vla.evaluation.records import EpisodeRecord
    from mme_vla.nano.demonstrations import Scene

SEEDS_APART = 100_000  # first seeds of two difficulties
RETRIES = 20  # scenes in a row that no demonstration succeeds in


def main() -> None:
    """Run the command with the task's own settings, where it has a file of them."""
    if sys.argv[1:2] == ["board"]:  # a command of its own, which runs this one to add a row
        from mme_vla.cli import board

        return board.main(sys.argv[2:], main, with_settings)
    sys.argv[1:] = with_settings(sys.argv[1:])
    command()


def with_settings(words: Sequence[str]) -> list[str]:
    """The words of a command line, and the choice of the task's file in configs/nano; what is typed counts more.

    `nano=null` does without it. `model=…` would be a choice for a tree that holds one model; here it names the first of
    several. `model=a,b` and `budget=4,16` are lists of one run, which shares demonstrations and has one table, without
    the further models of the task's file. Other lists of values are sweeps of `--multirun`.
    """
    words = _as_lists([f"with_memory={word.removeprefix('model=')}" if word.startswith("model=") else word
                       for word in words])  # fmt: skip
    if "nano=null" in words:  # without the task's file; Hydra takes no null for a group
        return [word for word in words if word != "nano=null"]
    tasks = [word.removeprefix("task=") for word in words if word.startswith("task=")]
    task_file = config_dir() / "nano" / f"{tasks[-1]}.yaml" if tasks else None
    if task_file is None or not task_file.is_file() or any(word.startswith("nano=") for word in words):
        return list(words)
    return [f"nano={task_file.stem}", *words]


def _as_lists(words: Sequence[str]) -> list[str]:
    """The words with `with_memory=a,b` and `budget=4,16` as lists, without `--multirun` where nothing else is swept."""
    lists = []
    for word in words:
        key, _, value = word.partition("=")
        several = key in ("with_memory", "budget") and "," in value and not value.startswith("[")
        lists.append(f"{key}=[{value}]" if several else word)
    if any(word.startswith("with_memory=[") for word in lists) and not any(w.startswith("also=") for w in lists):
        lists.append("also=[]")
    swept = [word for word in lists if "," in re.sub(r"[\[{(].*[\]})]", "", word.partition("=")[2])]
    return [word for word in lists if swept or lists == list(words) or word not in ("--multirun", "-m")]


@cli("nano")
def command(cfg: DictConfig) -> None:
    """Record, train, evaluate and write the page, each as far as it is not there."""
    from mme_vla.envs.make import check_names, require_simulator

    config = resolved(cfg)
    check_names(config["task"], "waypoint", None, None)
    check_counts(config["demonstrations"])
    require(
        isinstance(config["trainings"], int) and config["trainings"] >= 1,
        f"trainings={brief(config['trainings'])}: must be a whole number from 1 on.",
    )
    require_simulator()
    run(config, command_trees()[1:])


def run(config: Mapping[str, Any], extra_dirs: Sequence[Path] = ()) -> Path:
    """All stages of a run; the path of its page; of a folder, where other commands are to continue there.

    config: as configs/nano.yaml. extra_dirs: trees of the user's own models, as `--config-dir` adds them.
    """
    from mme_vla.embodiment import Embodiment
    from mme_vla.envs.recording.frames import DECISIONS, FrameChoice
    from mme_vla.nano.evaluating import NAME as PLANNER
    from mme_vla.nano.evaluating import record_videos, run_episodes
    from mme_vla.nano.fitting import compose_policy, train_all
    from mme_vla.nano.page import write_page

    folder = Path(config["output"])
    folder.mkdir(parents=True, exist_ok=True)
    words = ["backbone=nano", f"embodiment={config['embodiment']}", "policy.augment=false", f"seed={config['seed']}"]
    words += config["overrides"]
    first = as_list(config["with_memory"])
    models = list(dict.fromkeys([*first, *config["beside"], *config["also"]]))
    how = (config["memories"], words, extra_dirs, config["plugins"])
    composed: dict[str, dict[str, Any]] = {}
    fewer: set[str] = set()  # rows that are evaluated on fewer episodes
    for model in models:
        for budget in as_list(config["budget"]):
            each = compose_policy(model, *how, budget=budget)
            row = model if budget is None or each["memory"] is None else f"{model}@{budget}"
            composed[row] = each
            fewer |= {row} if model in config["also"] else set()
    render_for = [model for model in config["drawn_for"] if model not in models]
    minutes = _Minutes(folder / "minutes.json")
    with minutes.of("demonstrations"):
        others = [compose_policy(model, *how) for model in render_for]
        memories = [each["memory"] for each in (*composed.values(), *others)]
        robot = Embodiment.from_dict(next(iter(composed.values()))["embodiment"])
        execute = robot.action.execute
        choices = [FrameChoice(DECISIONS, memory, execute) for memory in [None, *filter(None, memories)]]
        files = record_all(config, folder / "demonstrations", choices, robot)
    if config["record_only"]:
        return folder / "demonstrations"
    records: dict[str, list[EpisodeRecord]] = {}
    videos: list[Path] = []
    for row, each in composed.items():
        recipe = (config["train"], folder / row, files, config["learning"])
        with minutes.of(f"training {row}"):
            checkpoints = train_all(each, *recipe, trainings=config["trainings"])
        with minutes.of(f"evaluation {row}"):
            records[row] = []
            for checkpoint in checkpoints:
                records[row] += run_episodes(
                    checkpoint, checkpoint.parent.parent / config["split"], config["task"], split=config["split"],
                    episodes=config["also_episodes" if row in fewer else "episodes"],
                    seeds=config["policy_seeds"], workers=config["workers"], max_steps=config["max_steps"],
                    shard=config["shard"],
                )  # fmt: skip
        if row == next(iter(composed)) and config["films"] and config["shard"] is None:
            with minutes.of("films"):
                of_first = records[row][: len(records[row]) // len(checkpoints)]
                videos = record_videos(checkpoints[0], folder / "films", of_first)
    if config["shard"] is not None:
        return folder
    if config["planner"]:
        with minutes.of("evaluation planner"):
            records[PLANNER] = plan_all(config, folder / "planner" / config["split"])
    blind = [model for model, each in composed.items() if each["memory"] is None and not each["subgoal_text"]]
    page = write_page(folder, config, records, next(iter(blind), None), minutes.spent, videos)
    print(page)
    return page


def as_list(value: Any) -> list[Any]:
    """A value of a configuration that may be one or several."""
    return list(value) if isinstance(value, list | tuple) else [value]


def plan_all(config: Mapping[str, Any], folder: Path) -> "list[EpisodeRecord]":
    """The oracle bracket: the demonstrator's motions on every episode, unless `folder` has its record; all records."""
    from mme_vla.cli.record import carry_out
    from mme_vla.envs.episodes import choose_episodes
    from mme_vla.evaluation.store import RecordLog, read_records
    from mme_vla.nano.evaluating import Replay, replay

    file = folder / "episodes.jsonl"
    known = {record.episode for record in (read_records(file) if file.is_file() else ())}
    specs = choose_episodes(config["task"], config["episodes"], config["split"])
    missing = [Replay(spec, config["max_steps"]) for spec in specs if spec.episode not in known]
    with RecordLog(file) as log:
        for record in carry_out(missing, replay, config["workers"]):
            log.append(record)
    numbers = {spec.episode for spec in specs}
    return [record for record in read_records(file) if record.episode in numbers]


def check_counts(counts: Any) -> None:
    """Make sure that demonstrations are asked for as difficulty: how many."""
    levels = ("easy", "medium", "hard")
    fits = isinstance(counts, Mapping) and all(isinstance(n, int) and n >= 0 for n in counts.values())
    if not fits or not set(counts) <= set(levels) or sum(counts.values()) < 2:
        raise UserError(
            f"demonstrations={brief(counts)}: write how many of each difficulty ({', '.join(levels)}), such as "
            "{easy: 100}; it takes two, to learn from and to measure by."
        )


def record_all(
    config: Mapping[str, Any], folder: Path, choices: "Sequence[FrameChoice]", robot: "Embodiment"
) -> list[Path]:
    """Demonstrate until there are as many as wanted, each in a file of its own; the files in their order.

    choices: what the memories that will train on them read. robot: the one that does.
    """
    from mme_vla.data.console import progress
    from mme_vla.nano.demonstrations import Scene

    folder.mkdir(parents=True, exist_ok=True)
    cameras = tuple(robot.camera_names)
    counts: dict[str, int] = config["demonstrations"]
    files: list[Path] = []
    with progress("record", sum(counts.values()), unit="demonstrations") as advance:
        for number, (level, n_required) in enumerate(counts.items()):
            first = int(config["first_seed"]) + number * SEEDS_APART
            how = (cameras, tuple(choices), config["carried_out"], robot.action)
            scene = Scene(config["task"], first, level, folder, *how)
            scenes = (replace(scene, seed=seed) for seed in count(first))
            files += demonstrate(scenes, n_required, config["workers"], advance)
    return files


def demonstrate(
    scenes: "Iterator[Scene]", count: int, workers: int = 1, advance: Callable[[int], None] = lambda _: None
) -> list[Path]:
    """The files of the first demonstrations of these scenes that succeed; existing ones are not made again."""
    from mme_vla.cli.record import carry_out
    from mme_vla.nano.demonstrations import demonstrated

    files: list[Path] = []
    failed = 0
    while len(files) < count:
        some = list(islice(scenes, min(RETRIES - failed, count - len(files))))
        missing = [scene for scene in some if not scene.tried]
        advance(sum(scene.path.is_file() for scene in some if scene.tried))
        for made in carry_out(missing, demonstrated, workers):
            advance(int(made))
        new = [scene.path for scene in some if scene.path.is_file()]
        files += new
        failed = 0 if new else failed + len(some)
        if failed >= RETRIES:
            last = some[-1]
            raise UserError(
                f"{last.task}: {failed} {last.difficulty} scenes in a row, to seed {last.seed}, cannot be demonstrated."
            )
    return files


class _Minutes:
    """Minutes of each stage, added up over interrupted runs: on the clock, and of processors for this process."""

    def __init__(self, path: Path) -> None:
        self._path = path

    @property
    def spent(self) -> dict[str, list[float]]:
        """Stage → minutes on the clock, and of this process; other runs of the command may add to them meanwhile."""
        return read_json(self._path, "minutes of a run") if self._path.is_file() else {}

    @contextmanager
    def of(self, stage: str) -> Iterator[None]:
        """Time what happens inside; a stage that had nothing to do counts its moment."""
        begun = time.perf_counter(), time.process_time()
        try:
            yield
        finally:
            now = time.perf_counter(), time.process_time()
            spent = self.spent
            before = spent.get(stage, [0.0, 0.0])
            spent[stage] = [old + (b - a) / 60 for old, a, b in zip(before, begun, now, strict=True)]
            write_json(self._path, spent)
