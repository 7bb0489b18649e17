"""Receipts: what a third person needs to check a score, in one JSON beside each file of records."""

import hashlib
import platform
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, NamedTuple

from mme_vla.config.naming import digest, flat
from mme_vla.envs.base import environment
from mme_vla.envs.make import ROBOMME
from mme_vla.envs.scene_hash import NO_VALUES, NOT_BUILT
from mme_vla.errors import UserError, brief, require
from mme_vla.evaluation.records import EpisodeRecord, count_outcomes
from mme_vla.evaluation.store import RUN_FILE, read_records, read_run
from mme_vla.policy.base import Policy
from mme_vla.policy.run_folders import STATE
from mme_vla.policy.training_identity import identity_of
from mme_vla.processing.base import STATS_FILE
from mme_vla.processing.normalise import NormStats
from mme_vla.utils import (
    SUMS,
    Sums,
    file_sum,
    inside,
    read_json,
    read_unpacked,
    to_json,
    verified,
    with_checksum,
    write_json,
)

CODE = (
    "backbone",
    "embodiment",
    "envs",
    "evaluation/rollout",
    "extras/methods",
    "extras/nano",
    "integration",
    "memory",
    "policy",
    "processing",
    "speed",
    "subgoal",
)
"""Packages of this library that can change a result: policies, scenes, rollouts. Their source is
digested.
"""
SIMULATOR = (
    "mani_skill",
    "sapien",
    "robomme",
    "gymnasium",
    "trimesh",
    "scipy",
    "ompl",
    "pin",
    "toppra",
)
"""Packages that decide scenes and motions."""
LIBRARIES = ("torch", "numpy", "pillow", "safetensors", "sentencepiece", "timm", "transformers")
"""Packages that decide what a policy computes."""
MOTIONS = ("waypoint", "multi_choice")
"""Action spaces of RoboMME whose actions are motions of many steps: the last one may go beyond the
step limit.
"""
_MARGIN = 2  # steps beyond its limit that the benchmark counts
# Files of a checkpoint that no policy is loaded from, and endings of those that one may be
_OF_TRAINING = ("raw.", "raw-", "optimizer", "shards/", STATE, SUMS)
_LOADED = (".safetensors", ".json", ".model", ".pt", ".pth", ".bin")
_IDENTITY = {
    "model": "model",
    "checkpoint": "checkpoint",
    "seed": "model_seed",
    "split": "split",
    "max_steps": "max_steps",
}
"""Setting of `run.json` → field of its records."""
_CONDITIONS = (
    "code",
    "simulator",
    "renderer",
    "libraries",
    "hardware",
    "checkpoint",
    "statistics",
)
# Part of every receipt, and of its conditions → kind
_PARTS = {"settings": dict, "conditions": list, "records": dict, "scenes": str, "score": dict}
_PARTS_OF_CONDITIONS = dict.fromkeys(
    ("code", "simulator", "libraries", "hardware", "checkpoint"), dict
)
_FEW = 5  # differences of one kind that are listed


class Verification(NamedTuple):
    """The result of checking a receipt, a line each.

    differences: what is another here than in the receipt. not_compared: what there was nothing to
    compare with, which is no agreement. notes: what may be another without any weight, such as the
    type of CPU.
    """

    differences: list[str]
    not_compared: list[str]
    notes: list[str]

    @property
    def word(self) -> str:
        """`differs`, `not compared` where nothing differs and something was not compared, or
        `agrees`.
        """
        if self.differences:
            return "differs"
        return "not compared" if self.not_compared else "agrees"

    def compare(self, what: str, then: Any, here: Any) -> None:
        """Compare a value of a receipt with the same here."""
        self.differences.extend(_differences(what, then, here))


def receipt_file(records: Path) -> Path:
    """The receipt of `episodes.jsonl` is `receipt.json`, that of `episodes-0of4.jsonl.xz`
    `receipt-0of4.json`.
    """
    name = records.name.removesuffix(".xz").replace("episodes", "receipt")
    return records.with_name(name).with_suffix(".json")


@contextmanager
def receipt(
    records: Path, policy: Policy, run: Mapping[str, Any], source: str | None, renders: bool
) -> Iterator[None]:
    """Write the receipt of a file of records before and after episodes are added to it.

    A run that was continued on another machine, or after an update, lists the conditions of each
    part.

    Args:
        records: the file. run: what `run.json` holds. source: where the weights are from. renders:
            whether the simulator of this library renders.
    """
    path = receipt_file(records)
    conditions: list[Any] = []
    if path.exists():
        conditions = read_receipt(path)["conditions"]
    here = to_json(
        {**_conditions(policy.device.type == "cuda", renders), **_checkpoint(policy, source)}
    )
    if here not in conditions:
        conditions.append(here)
    trained = identity_of(policy.config)
    facts = {
        "settings": run["settings"],
        "training": None if trained is None else asdict(trained),
        "conditions": conditions,
    }

    def write() -> None:
        write_json(path, with_checksum(to_json({**facts, **_score(records, run["settings"])})))

    write()  # a process that is killed has named its conditions
    try:
        yield
    finally:
        write()


def read_receipt(path: Path) -> dict[str, Any]:
    """Read a receipt.

    Raises:
        UserError: it is damaged, lacks a part, or a part is of another kind.
    """
    content: dict[str, Any] = verified(read_json(path, "a receipt"), str(path))
    fault = f"{path} is no receipt of an evaluation"
    missing = [key for key in _PARTS if content.get(key) is None]
    require(not missing, f"{fault}: it has no {', '.join(missing)}.")
    _check_kinds(fault, content, _PARTS)
    _check_kinds(fault, content["settings"], {"env": str, "event": str})
    _check_kinds(fault, content["records"], {"file": str})
    for part in content["conditions"]:
        _check_kinds(fault, part, _PARTS_OF_CONDITIONS)
        _check_kinds(fault, part.get("checkpoint") or {}, {"files": dict, "folder": str})
    return content


def _check_kinds(fault: str, section: Any, kinds: Mapping[str, type]) -> None:
    require(isinstance(section, dict), f"{fault}: {brief(section)} is no object.")
    for key, kind in kinds.items():
        value = section.get(key)
        is_of_kind = value is None or isinstance(value, kind)
        require(is_of_kind, f"{fault}: {key} is {brief(value)}, and must be a {kind.__name__}.")


def verify(path: Path, checkpoint: Path | None = None, build: bool = True) -> Verification:
    """Check a receipt offline: recompute the digests of the files that are here, compare versions
    of what is installed.

    Args:
        path: of the receipt; its records, or these as `.xz`, and `run.json` are beside it.
        checkpoint: where the checkpoint is, if not at the place that the receipt names.
        build: whether the scenes are built here, without images, and compared: about 0.1 s a scene.

    Raises:
        UserError: the file is no receipt, or a name in it leads outside of the folder that it is
            of.
    """
    content = read_receipt(path)
    settings, name, folder = content["settings"], content["records"].get("file"), path.parent
    result = Verification([], [], [])
    if (folder / RUN_FILE).is_file():
        result.compare("settings", settings, read_run(folder)["settings"])
    else:
        result.not_compared.append(f"settings: {RUN_FILE} is not beside the receipt.")

    # The records may have been compressed since.
    files = []
    if isinstance(name, str):
        files = [inside(folder, name, "records"), inside(folder, f"{name}.xz", "records")]
    here = [file for file in files if file.is_file()]
    if here:
        records = read_records(here[0])
        for key, value in to_json(_score(here[0], settings)).items():
            if key in content or value:
                result.compare(key, content.get(key), value)
        _compare_identity(result, records, content)
        _compare_steps(result, records, settings)
        _compare_scenes(result, records, settings, build)
    elif files:
        result.differences.append(f"records: neither {name} nor {name}.xz is beside the receipt.")
    else:
        result.not_compared.append("records: the receipt names no file of them.")

    for part in content["conditions"] or [{}]:
        _compare_conditions(result, part, checkpoint)
    return Verification(*(list(dict.fromkeys(lines)) for lines in result))


# The records and their settings -------------------------------------------------------------------


def _score(path: Path, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Outcomes of each task, digests of the records, uncompressed, and of their scenes, and those
    scenes built.
    """
    records, total = list[EpisodeRecord](), None
    if path.exists():
        records = read_records(path)
        total = hashlib.sha256(read_unpacked(path, "episode records")).hexdigest()
    split = str(settings.get("split"))
    if Path(split).is_file():  # a split may be a file of rows, which then names the scenes
        split = file_sum(Path(split))
    seeds = {f"{r.task} {r.episode}": [r.seed, r.difficulty] for r in records}
    tasks = dict.fromkeys(record.task for record in records)
    return {
        "records": {"file": path.name.removesuffix(".xz"), "sha256": total},
        "scenes": digest({"split": split, "scenes": seeds}, 64),
        "scene_digests": {f"{r.task} {r.episode}": r.scene for r in records if r.scene},
        "score": {task: count_outcomes(r for r in records if r.task == task) for task in tasks},
    }


def _compare_identity(
    result: Verification, records: Sequence[EpisodeRecord], content: Mapping[str, Any]
) -> None:
    """Whether every record is of the settings and of the training."""
    settings = content["settings"]
    subgoal = settings.get("subgoal")
    expected = {
        "event": settings.get("event"),
        "subgoal": subgoal.get("name") if isinstance(subgoal, Mapping) else subgoal,
        "env": settings.get("env"),
    }
    for key, field in _IDENTITY.items():
        if key in settings:
            expected[field] = settings[key]
        else:
            result.not_compared.append(f"settings.{key}: the receipt does not name it.")
    if "training" in content:
        expected["training"] = content["training"]
    for record in records[:1]:  # a run has one policy and one robot
        expected |= {"composition": record.composition, "action_space": record.action_space}
    values_of: dict[str, set[str]] = {field: set() for field in expected}
    for record in records:
        training = record.training and asdict(record.training)
        env = record.extra.get("env", expected["env"])  # not every record names its own
        values = {**vars(record), "training": training, "env": env}
        for field in expected:
            values_of[field].add(str(values[field]))
    for field, value in expected.items():
        for here in sorted(values_of[field]):
            result.compare(f"records.{field}", str(value), here)


def _compare_steps(
    result: Verification, records: Sequence[EpisodeRecord], settings: Mapping[str, Any]
) -> None:
    """Whether no episode is longer than its limit, by which the time that events hold the robot
    counts as well.
    """
    from mme_vla.evaluation.rollout.events import read_events

    try:
        hold_steps = sum(placed.event.hold for placed in read_events(settings.get("event")))
        limit = int(settings["max_steps"]) + _MARGIN + hold_steps
    except (KeyError, TypeError, ValueError) as error:  # UserError is a ValueError
        result.not_compared.append(f"steps: the settings name no limit of them ({error}).")
        return
    for record in records:
        # A motion of RoboMME may end beyond the limit.
        is_motion = settings.get("env") == ROBOMME and record.action_space in MOTIONS
        if record.steps < 0 or (record.steps > limit and not is_motion):
            result.compare("records.steps", f"0 to {limit}", record.steps)


def _compare_scenes(
    result: Verification,
    records: Sequence[EpisodeRecord],
    settings: Mapping[str, Any],
    build: bool,
) -> None:
    """Seeds and difficulties of the episodes, and the scenes' digests, for which they are built."""
    not_compared = result.not_compared
    try:
        require(records, "there is no record.")
        env = environment(str(settings.get("env")))
        for record in records:
            env.check_task(record.task)
            spec = env.episode(record.task, record.split, record.episode)
            name = f"scene {record.task} {record.episode}"
            then, here = f"{record.seed}, {record.difficulty}", f"{spec.seed}, {spec.difficulty}"
            result.compare(name, then, here)
            if record.scene is None:
                not_compared.append(
                    "scenes: records do not name them, as those of earlier versions."
                )
            elif record.scene == NO_VALUES:
                not_compared.append("scenes: the environment gave no values of some.")
            elif not build:
                not_compared.append("scenes: they were not built here, as was asked.")
            elif record.scene == NOT_BUILT:
                not_compared.append("scenes: some episodes ended before theirs was built.")
            elif (built := env.scene_digest(spec)) == NO_VALUES:
                not_compared.append("scenes: the environment gives no values of some here.")
            else:
                result.compare(name, record.scene, built)
    except UserError as error:  # of a plugin that is not loaded, or without the simulator
        not_compared.append(f"scenes: {error}")


# The conditions -----------------------------------------------------------------------------------


def _conditions(on_gpu: bool, renders: bool) -> dict[str, Any]:
    """Code, simulator, renderer, libraries and hardware of this process."""
    import torch

    cpu, renderer = platform.processor() or platform.machine(), None
    info = Path("/proc/cpuinfo")
    if info.is_file() and (model := re.search(r"model name\s*:\s*(.+)", info.read_text())):
        cpu = model[1]
    if renders and _version("sapien") is not None:
        import sapien

        from mme_vla.envs.rendering import render_backend

        devices = re.findall(r"GPU:\s*(.+?)\s*\n", str(sapien.render.get_device_summary()))
        renderer = f"{render_backend()}: {', '.join(devices)}"
    gpu = torch.cuda.get_device_name() if on_gpu and torch.cuda.is_available() else None
    return {
        "code": {"mme-vla": version("mme-vla"), **{name: _code(name) for name in CODE}},
        "simulator": {name: _version(name) for name in SIMULATOR},
        "renderer": renderer,
        "libraries": {name: _version(name) for name in LIBRARIES},
        "hardware": {"cpu": cpu, "gpu": gpu},
    }


@cache
def _code(package: str) -> str:
    """Digest of the source files of a package of this library, read once in a process."""
    root = Path(__file__).resolve().parents[1]
    files = sorted((root / package).rglob("*.py"))
    return digest({path.relative_to(root).as_posix(): file_sum(path) for path in files}, 64)


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


# The checkpoint -----------------------------------------------------------------------------------


def _checkpoint(policy: Policy, source: str | None) -> dict[str, Any]:
    """Digests of the files that the weights are from, and of the statistics in use."""
    folder, files = str(source), dict[str, str | None]()
    if source is not None and Path(source).is_dir():
        place = Path(source).resolve()
        folder = str(place)
        # Those of the table were compared with the files when they were loaded; a file beside it
        # may be loaded too.
        table = Sums(place).table
        files = _sums(place, [name for name in _loaded(place) if name not in table])
        files |= {name: table[name] for name in table if not name.startswith(_OF_TRAINING)}
    return {
        "checkpoint": {"folder": folder, "files": files},
        "statistics": digest(policy.require_processor().require_stats().to_dict(), 64),
    }


def _loaded(folder: Path) -> list[str]:
    """Files of a checkpoint that a policy may be loaded from."""
    names = (path.name for path in folder.iterdir() if path.suffix in _LOADED and path.is_file())
    return sorted(name for name in names if not name.startswith(_OF_TRAINING))


def _sums(folder: Path, names: Iterable[str]) -> dict[str, str | None]:
    """SHA-256 of files of a folder, None of one that is not there.

    Raises:
        UserError: a name leads outside of the folder.
    """
    paths = {name: inside(folder, name) for name in names}
    return {name: file_sum(path) if path.is_file() else None for name, path in paths.items()}


def _compare_conditions(
    result: Verification, part: Mapping[str, Any], checkpoint: Path | None
) -> None:
    """Compare what both the receipt and this machine name of code, packages, checkpoint, …."""
    named = part.get("checkpoint") or {}
    files, place = named.get("files") or {}, checkpoint or Path(named.get("folder") or "no folder")
    on_gpu = (part.get("hardware") or {}).get("gpu") is not None
    then = {**part, "checkpoint": files}
    here = _conditions(on_gpu, renders=part.get("renderer") is not None)
    if (place / "config.json").is_file():
        here["checkpoint"] = _sums(place, {*files, *_loaded(place)})
        if files:  # a file beside those that were loaded is a difference
            then["checkpoint"] = {**dict.fromkeys(_loaded(place)), **files}
        if (place / STATS_FILE).is_file():
            here["statistics"] = digest(NormStats.load(place / STATS_FILE).to_dict(), 64)

    for what in _CONDITIONS:
        old, new = then.get(what, {}), here.get(what)
        # Another type of CPU or GPU has no weight.
        sink = result._replace(differences=result.notes) if what == "hardware" else result
        if what == "renderer" and old is None:
            continue  # nothing was rendered
        if not old:
            result.not_compared.append(f"{what}: the receipt does not name it.")
        elif new is None:
            hint = f"{brief(str(place), 200, quote=False)}: name its folder with --checkpoint"
            result.not_compared.append(f"{what}: there is no checkpoint in {hint}.")
        elif not isinstance(new, dict):
            sink.compare(what, old, new)
        else:
            for name in sorted({*old, *new}):
                key = f"{what}.{brief(name, quote=False)}"
                if name in old and name in new:
                    sink.compare(key, old[name], new[name])
                elif name in old:
                    result.not_compared.append(f"{key}: there is nothing here to compare.")
                elif new[name] is not None:
                    result.not_compared.append(f"{key}: the receipt does not name it.")


def _differences(what: str, then: Any, now: Any) -> list[str]:
    """What differs between a value of a receipt and the same here, in a line each."""
    old, new = flat({what: then}), flat({what: now})
    lines = []
    for key in sorted({*old, *new}):
        if old.get(key) != new.get(key):
            values = brief(old.get(key), 20), brief(new.get(key), 20)
            lines.append(f"{key}: {values[0]} in the receipt, {values[1]} here")
    if len(lines) > _FEW:
        lines[_FEW:] = [f"{what}: {len(lines) - _FEW} more"]
    return lines
