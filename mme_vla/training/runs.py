"""Run folders: which one this run writes to, what it may resume from, and which settings it may
change then.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from typing import Any

from mme_vla.config.naming import flat
from mme_vla.data.lerobot_files import SAMPLE
from mme_vla.data.sources import listed_sources
from mme_vla.errors import UserError, brief, counted, require
from mme_vla.policy.base import Policy
from mme_vla.policy.run_folders import (
    CHECKPOINTS,
    check_output,
    checkpoints_in,
    find_run,
    newest_checkpoint,
    newest_write,
    resolve_checkpoint,
    step_of,
    trainings_in,
)
from mme_vla.policy.training_identity import NONE
from mme_vla.training.checkpoint import read_state
from mme_vla.utils import FolderLock, to_json
from mme_vla.utils.locks import LOCK
from mme_vla.weights import transfer

CONFIG, METRICS, SUMMARY, PLOT = "config.yaml", "metrics.jsonl", "summary.json", "open_loop.png"

MAY_DIFFER = (
    "name",
    "full_size",
    "output",
    "resume",
    "trainings",
    "init_from",
    "logger",
    "train.steps",
    "train.log_every",
    "train.val_every",
    "train.save_every",
    "train.keep",
    "train.parallel",
    "train.prefetch_gb",
    "train.workers",
    "train.open_loop_chunks",
    "train.self_check",
    "train.device",
    "data.cache",
    "data.content",
    "data.side_files",
    "data.narrow_ranges",
    "trust_plugins",
)
"""Keys (and all below them) that a resumed run may change: how long, how often, where; nothing that
changes a loss.

The name is a label alone. `data.content` and `data.side_files`, digests of the datasets, are
compared when they are open (`check_content`), so their places may differ, too. A run's statistics
stay what they are, whatever `data.narrow_ranges` says.
"""


@dataclass(frozen=True)
class Run:
    """Where a run writes, and the checkpoint it continues from with the updates already done (None:
    from nothing).
    """

    folder: Path
    checkpoint: Path | None = None
    step: int = 0

    @property
    def checkpoints(self) -> Path:
        return self.folder / CHECKPOINTS


def claim_run(
    folder: Path, named: bool, resume: str | None, config: Mapping[str, Any]
) -> tuple[Run, FolderLock]:
    """Decide as `open_run`, and hold the run's folder against other processes.

    Args:
        named: whether the user chose `folder`. One that is named after the clock may belong to
            another run that began in the same second: then this run takes the next name,
            `<folder>-2`.
    """
    check_output(folder)
    for number in range(1, 1000):
        place = folder if number == 1 else folder.with_name(f"{folder.name}-{number}")
        try:
            run = open_run(place, resume, config, named)
            lock = FolderLock(run.folder, "training run").acquire()
        except UserError:
            if named or resume is not None or not (_holds_run(place) or (place / LOCK).exists()):
                raise
            continue
        try:
            # what decided may have changed before the folder was held
            again = open_run(place, resume, config, named)
            if again.folder == run.folder:
                return again, lock
            raise UserError(
                f"{run.folder} has just been finished by another process; repeat the command."
            )
        except BaseException:
            lock.release()
            raise
    raise UserError(f"{folder} and the names after it are taken: choose another output.")


def open_run(
    folder: Path, resume: str | None, config: Mapping[str, Any], named: bool = False
) -> Run:
    """Decide where this run writes and where it starts; nothing is written yet.

    Args:
        folder: of a new run.
        resume: None, `auto`, or the path of a run or one of its checkpoints.
        config: the composed configuration, plain.
        named: whether the user chose `folder`: then `auto` means the run in it, and none beside it.
    """
    if resume in (None, "auto"):
        require(
            not any(map(_holds_run, folder.glob("training_*"))),
            f"{folder} holds trainings of one recipe: add trainings=… to continue them, or choose"
            " another output.",
        )
    if resume is None:
        require(
            not _holds_run(folder),
            f"{folder} already holds a training run, which is never overwritten: "
            f"continue it with resume={folder}, or choose another output.",
        )
        return Run(folder)
    if resume == "auto":
        checkpoints = checkpoints_in(folder / CHECKPOINTS)
        newest = checkpoints[-1] if checkpoints else None
        if not checkpoints and not named:
            # The last checkpoint of the run beside it that wrote last, unless that one is finished.
            beside = [
                path for path in folder.parent.glob("*") if checkpoints_in(path / CHECKPOINTS)
            ]
            latest = max(beside, key=newest_write, default=None)
            if latest is not None and not (latest / SUMMARY).is_file():
                newest = checkpoints_in(latest / CHECKPOINTS)[-1]
        if newest is None:
            return Run(folder)
        try:
            return open_run(folder, str(newest), config)
        except UserError as error:
            if checkpoints:
                raise
            raise UserError(
                f"{error}\nresume=auto chose that run, the newest unfinished one in"
                f" {folder.parent}. Leave it out to begin a new one."
            ) from None
    checkpoint = resolve_checkpoint(Path(resume))
    state = read_state(checkpoint)
    check_settings(checkpoint, state["config"], config)
    steps: int = config["train"]["steps"]
    require(
        state["step"] <= steps,
        f"{checkpoint} has done {counted(state['step'], 'step')} already, more than"
        f" train.steps={steps}: give as many or more.",
    )
    newer = [
        path.name for path in checkpoints_in(checkpoint.parent) if step_of(path) > state["step"]
    ]
    require(
        not newer,
        f"{checkpoint.parent} holds newer checkpoints ({', '.join(newer)}), which continuing from "
        f"{checkpoint.name} would overwrite: resume from the newest, or move those away.",
    )
    return Run(checkpoint.parent.parent, checkpoint, state["step"])


def check_settings(checkpoint: Path, then: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Make sure that a resumed run has the settings it began with.

    Args:
        checkpoint: it continues from.
        then, now: plain configurations, of the checkpoint and of the command.
    """
    changed = differing_keys(then, now)
    if not changed:
        return
    if then.get("name") != now.get("name"):
        # A label alone, but most often the reason of all the others: model=… was left out.
        changed = {"name": (then.get("name"), now.get("name")), **changed}
    lines = []
    for key, (old, new) in changed.items():
        lines.append(f"  {brief(key, quote=False)}: {brief(old)} then, {brief(new)} now")
    if len(lines) > 7:
        lines[7:] = [f"  … and {len(lines) - 7:,} more"]
    listing = "\n".join(lines)
    if "train.schedule_steps" in changed:
        listing += "\nA cosine without schedule_steps ends with the run it began in."
    if any(key.startswith("data.sources.") and key.endswith(".name") for key in changed):
        listing += (
            "\nA dataset may lie elsewhere, under the name it had (it decides which episodes are"
            " held out): data.sources=[{root: <folder>, name: <name>}]"
        )
    raise UserError(
        f"{checkpoint} was trained with other settings, so continuing from it would be another"
        f" run:\n{listing}\nRepeat the settings of {checkpoint.parent.parent / CONFIG}, or start"
        f" anew with init_from={checkpoint}."
    )


def check_content(
    checkpoint: Path, content: Sequence[str], side_files: Sequence[Mapping[str, str]] = ()
) -> None:
    """Make sure that a resumed run has the data it began with.

    Args:
        checkpoint: it continues from.
        content, side_files: of `SplitData`.
    """
    names = sorted({name for files in side_files for name in files})
    data = read_state(checkpoint)["config"].get("data", {})
    for key, now, changed in (
        ("content", content, "holds other episodes"),
        ("side_files", side_files, f"has another {' or '.join(names) or 'side file'}"),
    ):
        then = data.get(key)  # earlier versions kept no side files
        if then is None or list(then) == list(now):
            continue
        which = [i for i, (old, new) in enumerate(zip_longest(then, now)) if old != new]
        raise UserError(
            f"The data have changed since {checkpoint} was written: number"
            f" {', '.join(map(str, which))} of data.sources {changed}, so continuing would be"
            f" another run. Bring the data back, or start anew with init_from={checkpoint}."
        )


def differing_keys(old: Mapping[str, Any], new: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    """Dotted keys that a run may not change, with their values in two plain configurations."""
    began_with = (old.get("data") or {}).keys()
    before = flat(_named_sources(to_json(old), began_with))
    after = flat(_named_sources(to_json(new), began_with))
    for values in (before, after):
        # A cosine without an end of its own ends with the run.
        is_cosine = values.get("train.schedule") == "cosine"
        if is_cosine and values.get("train.schedule_steps") is None:
            values["train.schedule_steps"] = values.get("train.steps")
    differing: dict[str, tuple[Any, Any]] = {}
    for key in sorted(before.keys() | after.keys()):
        may_differ = any(f"{key}.".startswith(f"{free}.") for free in MAY_DIFFER)
        if not may_differ and before.get(key) != after.get(key):
            differing[key] = (before.get(key), after.get(key))
    return differing


def _named_sources(config: dict[str, Any], began_with: Collection[str]) -> dict[str, Any]:
    """A plain configuration in which `data.sources` are numbered, spelled in one way, and without
    the places whose content `check_content` compares.

    Args:
        began_with: the keys of `data` that the run began with; earlier versions kept no digests.
    """
    data = config.get("data") or {}
    if "sources" not in data:
        return config
    sources = {}
    for number, entry in enumerate(listed_sources(data["sources"])):
        source = {"name": entry.short_name}
        root = SAMPLE if entry.root == "sample" else Path(entry.root).expanduser().resolve()
        # the embedded sample holds out an episode of its own
        if "content" not in began_with or root == SAMPLE:
            source["root"] = str(root)
        if "side_files" not in began_with and entry.exec_starts is not None:
            source["exec_starts"] = str(Path(entry.exec_starts).resolve())
        sources[str(number)] = source
    return {**config, "data": {**data, "sources": sources}}


def _holds_run(folder: Path) -> bool:
    return any((folder / name).exists() for name in (CHECKPOINTS, METRICS, SUMMARY))


def open_trainings(folder: Path, resume: str | None, count: int, named: bool) -> Path:
    """Decide where several trainings of one recipe lie, as `open_run` does for a single one.

    Args:
        folder: of new ones. With `auto`, unless the user named it, the newest folder beside it that
            holds trainings of which fewer than `count` are finished comes first.
    """
    if resume == "auto" and not named:
        beside = [path for path in folder.parent.glob("*") if trainings_in(path)]
        newest = max(beside, key=newest_write, default=folder)
        finished = [run for run in trainings_in(newest) if (run / SUMMARY).is_file()]
        if len(finished) < count:
            folder = newest
    elif resume not in (None, "auto"):
        folder = find_run(Path(resume))
        require(folder.is_dir(), f"resume={resume}: there is no such folder of trainings.")
    # Where a single run and several are in one folder, commands take different policies from it.
    require(
        not _holds_run(folder),
        f"{folder} holds a single run: leave trainings=… out to continue it with"
        f" resume={folder}, or choose another output.",
    )
    return folder


def check_finished(trainings: Sequence[Path]) -> None:
    """Make sure that all trainings of a recipe are finished, so that their last checkpoints are
    alike.
    """
    lacking = [run for run in trainings if not (run / SUMMARY).is_file()]
    require(
        not lacking,
        f"{', '.join(map(str, lacking))}: not finished. Repeat the command that trains, with"
        f" trainings=… and resume={lacking[0].parent if lacking else ''}, or evaluate one that is"
        " finished.",
    )


def weights_to_start_from(init_from: str | None) -> str | None:
    """What `init_from` names; None for random weights."""
    require(
        init_from != "ask",
        "This recipe starts from trained weights: give init_from=<checkpoint> "
        "(docs/train/weights.md lists the formats). "
        "To train the whole network from random weights, say so: init_from=none.",
    )
    return None if init_from in (None, NONE) else init_from


def start_from(policy: Policy, source: str) -> str:
    """Copy every weight that `source` holds into a freshly built policy; only its memory's own may
    be new.

    Args:
        source: a checkpoint of any format (`mme_vla.weights`), or one of this library's run
            folders, which means its newest checkpoint.

    Returns:
        A sentence that says what was taken, what is new and what was left behind.
    """
    newest = newest_checkpoint(Path(source))
    if newest != Path(source):
        source = str(newest)
    return f"weights from {source}: {transfer(policy, source)}"
