"""Receipts: what a third person needs to check a score, in one JSON beside each file of records."""

import hashlib
import platform
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

from mme_vla.config.naming import digest, flat
from mme_vla.envs.base import Environment, environment
from mme_vla.envs.make import ROBOMME
from mme_vla.envs.scene_hash import NO_VALUES, NOT_BUILT
from mme_vla.errors import UserError, brief, listed, require
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
    "integration",
    "memory",
    "methods",
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
_CONFIG = "config.json"  # every checkpoint's
_OF_TRAINING = (
    "raw.",
    "raw-",
    "optimizer",
    "shards/",
    STATE,
)  # Files of a checkpoint that no policy is loaded from
_LOADED = (
    ".safetensors",
    ".json",
    ".model",
    ".pt",
    ".pth",
    ".bin",
)  # and endings of those that one may be
_IDENTITY = {
    "model": "model",
    "checkpoint": "checkpoint",
    "seed": "model_seed",
    "split": "split",
    "max_steps": "max_steps",
}
"""Setting of `run.json` → field of its records."""
_FEW = 5  # differences of one kind that are listed


class Verification(NamedTuple):
    """What came of checking a receipt, a line each.

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

    def once(self) -> "Verification":
        """Without the lines that stand twice."""
        return Verification(*(list(dict.fromkeys(lines)) for lines in self))


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
    earlier = read_receipt(path)["conditions"] if path.exists() else []
    here = to_json(
        {**_conditions(policy.device.type == "cuda", renders), **_checkpoint(policy, source)}
    )
    conditions = earlier if here in earlier else [*earlier, here]
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
    missing = [
        key
        for key in ("settings", "conditions", "records", "scenes", "score")
        if key not in content
    ]
    require(not missing, f"{path} is no receipt of an evaluation: it has no {', '.join(missing)}.")
    for key in ("settings", "records", "score"):
        kind = isinstance(content[key], Mapping)
        require(
            kind,
            f"{path} is no receipt of an evaluation: {key} must hold an object, not"
            f" {brief(content[key])}.",
        )
    parts = content["conditions"]
    kinds = isinstance(parts, list) and all(isinstance(part, Mapping) for part in parts)
    require(
        kinds,
        f"{path} is no receipt of an evaluation: conditions must list objects, not {brief(parts)}.",
    )
    return content


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
    result = Verification([], [], [])
    _compare_settings(result, content["settings"], path.parent)
    _compare_records(result, content, path.parent, build)
    if not content["conditions"]:
        parts = ("code", "simulator", "renderer", "libraries", "checkpoint", "statistics")
        result.not_compared.extend(
            f"{part}: the receipt names no conditions, and has one at least." for part in parts
        )
    for part in content["conditions"]:
        _compare_conditions(result, part)
        _compare_checkpoint(result, part, checkpoint)
    return result.once()


# The records and their settings -------------------------------------------------------------------


def _compare_settings(result: Verification, settings: Mapping[str, Any], folder: Path) -> None:
    if (folder / RUN_FILE).is_file():
        result.differences.extend(_differences("settings", settings, read_run(folder)["settings"]))
    else:
        result.not_compared.append(f"settings: {RUN_FILE} is not beside the receipt.")


def _compare_records(
    result: Verification, content: Mapping[str, Any], folder: Path, build: bool
) -> None:
    """Digests and score of the records, each record with the settings, and their scenes."""
    settings, name = content["settings"], content["records"].get("file")
    if not isinstance(name, str):
        result.not_compared.append("records: the receipt names no file of them.")
        return
    records = inside(folder, name, "records")
    packed = inside(folder, f"{name}.xz", "records")
    records = records if records.is_file() else packed
    if not records.is_file():
        result.differences.append(f"records: {name} is not beside the receipt, nor {packed.name}.")
        return
    here, lines = to_json(_score(records, settings)), read_records(records)
    for key in ("records", "score", "scenes", "scene_digests"):
        if key in content or here[key]:
            result.differences.extend(_differences(key, content.get(key), here[key]))
    if not lines:
        result.not_compared.append("records: the file has no episode.")
    _compare_identity(result, lines, content)
    if not isinstance(settings.get("env"), str):
        result.not_compared.append("scenes: the settings name no environment.")
        return
    try:
        env = environment(settings["env"])
        for task in {record.task for record in lines}:
            env.check_task(task)
        _compare_seeds(result, lines, env)
    except UserError as error:  # an environment or a task of a plugin that is not loaded
        result.not_compared.append(f"scenes: {error}")
        return
    _compare_scenes(result, lines, env, build)


def _compare_identity(
    result: Verification, records: Sequence[EpisodeRecord], content: Mapping[str, Any]
) -> None:
    """Whether every record is of the settings: model, checkpoint, seed, split, step limit, event,
    training.
    """
    settings = content["settings"]
    expected: dict[str, Any] = {}
    for key, field in _IDENTITY.items():
        if key in settings:
            expected[field] = settings[key]
        else:
            result.not_compared.append(
                f"settings.{key}: the receipt does not name it, so no record is compared with it."
            )
    subgoal = settings.get("subgoal")
    expected["subgoal"] = subgoal.get("name") if isinstance(subgoal, Mapping) else subgoal
    expected["event"] = settings.get("event")
    for field, value in expected.items():
        others = [record for record in records if str(getattr(record, field)) != str(value)]
        _add_records(result, others, field, attrgetter(field), value, "settings")
    if "training" in content:
        others = [
            r
            for r in records
            if (None if r.training is None else asdict(r.training)) != content["training"]
        ]
        _add_records(
            result,
            others,
            "training",
            lambda record: record.training,
            content["training"],
            "receipt",
        )
    named = [record for record in records if "env" in record.extra and "env" in settings]
    others = [record for record in named if record.extra["env"] != settings["env"]]
    _add_records(
        result, others, "env", lambda record: record.extra["env"], settings.get("env"), "settings"
    )
    for field in ("composition", "action_space"):
        values = sorted({str(getattr(record, field)) for record in records})
        if len(values) > 1:
            result.differences.append(
                f"records.{field}: several in one run, {', '.join(map(brief, values[:_FEW]))}"
            )
    _compare_steps(result, records, settings)


def _compare_steps(
    result: Verification, records: Sequence[EpisodeRecord], settings: Mapping[str, Any]
) -> None:
    """Whether no episode is longer than its limit, by which the time that events hold the robot
    counts as well.
    """
    from mme_vla.evaluation.rollout.events import read_events

    limit = settings.get("max_steps")
    if not isinstance(limit, int):
        result.not_compared.append("steps: the settings name no step limit.")
        return
    try:
        limit += _MARGIN + sum(placed.event.hold for placed in read_events(settings.get("event")))
    except UserError as error:
        result.not_compared.append(f"steps: {error}")
        return
    motions = settings.get("env") in ROBOMME and any(
        record.action_space in MOTIONS for record in records
    )
    long = [
        record for record in records if record.steps < 0 or (record.steps > limit and not motions)
    ]
    _add_records(result, long, "steps", lambda record: record.steps, f"0 to {limit}", "settings")
    if motions and any(record.steps > limit for record in records):
        result.notes.append(
            "steps: some episodes end beyond their limit, with a last action that is a motion of"
            " many."
        )


def _add_records(
    result: Verification,
    others: Sequence[EpisodeRecord],
    field: str,
    value_of: Callable[[EpisodeRecord], Any],
    expected: Any,
    where: str,
) -> None:
    """One line on all records that have another value in a field than is expected."""
    if others:
        first = others[0]
        more = f", and {len(others) - 1} more" if len(others) > 1 else ""
        result.differences.append(
            f"records.{field}: {brief(value_of(first))} in the record of"
            f" {brief(first.task, quote=False)} {first.episode}{more}; {brief(expected)} by the"
            f" {where}"
        )


def _compare_seeds(
    result: Verification, records: Iterable[EpisodeRecord], env: Environment
) -> None:
    """Episodes whose seed or difficulty is not the one that the environment gives them here."""
    for record in records:
        spec = env.episode(record.task, record.split, record.episode)
        then, here = f"{record.seed}, {record.difficulty}", f"{spec.seed}, {spec.difficulty}"
        result.differences.extend(_differences(f"scene {record.task} {record.episode}", then, here))


def _compare_scenes(
    result: Verification, records: Sequence[EpisodeRecord], env: Environment, build: bool
) -> None:
    """Build the scenes that records name, and compare their digests."""
    unnamed = sum(record.scene is None for record in records)
    valueless = sum(record.scene == NO_VALUES for record in records)
    if unnamed:
        result.not_compared.append(
            f"scenes: {unnamed} records do not name the scene that was built, as those of earlier"
            " versions; seeds and difficulties alone are compared."
        )
    if valueless:
        result.not_compared.append(
            f"scenes: the environment gave no values of {valueless} episodes."
        )
    named = {
        (r.task, r.split, r.episode, r.scene) for r in records if r.scene not in (None, NO_VALUES)
    }
    if named and not build:
        result.not_compared.append(f"scenes: {len(named)} were not built here, as was asked.")
        return
    unbuilt = 0
    for task, split, episode, scene in sorted(named):
        try:
            here = env.scene_digest(env.episode(task, split, episode))
        except UserError as error:
            result.not_compared.append(f"scenes: they cannot be built here. {error}")
            return
        if scene == NOT_BUILT and here != NOT_BUILT:
            unbuilt += 1
        elif here == NO_VALUES:
            result.not_compared.append(f"scenes: the environment gives no values of {task} here.")
        else:
            result.differences.extend(_differences(f"scene {task} {episode}", scene, here))
    if unbuilt:
        result.not_compared.append(
            f"scenes: {unbuilt} episodes ended before their scene was built; it can be here."
        )


def _score(records: Path, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Outcomes of each task, digests of the records, uncompressed, and of their scenes, and those
    scenes built.
    """
    lines, total = list[EpisodeRecord](), None
    if records.exists():
        lines = read_records(records)
        total = hashlib.sha256(read_unpacked(records, "episode records")).hexdigest()
    tasks = dict.fromkeys(record.task for record in lines)
    return {
        "records": {"file": records.name.removesuffix(".xz"), "sha256": total},
        "scenes": _scenes(lines, str(settings.get("split"))),
        "scene_digests": {
            f"{record.task} {record.episode}": record.scene for record in lines if record.scene
        },
        "score": {
            task: count_outcomes(line for line in lines if line.task == task) for task in tasks
        },
    }


def _scenes(records: Iterable[EpisodeRecord], split: str) -> str:
    """Digest of what names the scenes: task, number, seed and difficulty; and the file of a split
    that is one.
    """
    scenes: dict[str, Any] = {f"{r.task} {r.episode}": [r.seed, r.difficulty] for r in records}
    return digest(
        {"split": file_sum(Path(split)) if Path(split).is_file() else split, "scenes": scenes}, 64
    )


# The conditions -----------------------------------------------------------------------------------


def _conditions(on_gpu: bool, renders: bool) -> dict[str, Any]:
    """Code, simulator, renderer, libraries and hardware of this process."""
    return {
        "code": {"mme-vla": version("mme-vla"), "covers": list(CODE), "sha256": _code(CODE)},
        "simulator": {name: _version(name) for name in SIMULATOR},
        "renderer": _renderer() if renders else None,
        "libraries": {name: _version(name) for name in LIBRARIES},
        "hardware": _hardware(on_gpu),
    }


def _code(packages: Iterable[str]) -> str:
    """Digest of the source files of packages of this library."""
    root = Path(__file__).resolve().parents[1]
    files = sorted(path for package in packages for path in (root / package).rglob("*.py"))
    return digest({path.relative_to(root).as_posix(): file_sum(path) for path in files}, 64)


def _hardware(on_gpu: bool) -> dict[str, Any]:
    import torch

    return {
        "cpu": _cpu(),
        "gpu": torch.cuda.get_device_name() if on_gpu and torch.cuda.is_available() else None,
    }


def _compare_conditions(result: Verification, part: Mapping[str, Any]) -> None:
    _compare_code(result, part.get("code"))
    _compare_versions(result, "simulator", part.get("simulator"), SIMULATOR)
    _compare_versions(result, "libraries", part.get("libraries"), LIBRARIES)
    if "renderer" not in part:
        result.not_compared.append("renderer: the receipt does not say what rendered.")
    elif part["renderer"] is not None:
        result.differences.extend(_differences("renderer", part["renderer"], _renderer()))
    hardware = part.get("hardware")
    if isinstance(hardware, Mapping):
        result.notes.extend(
            _differences("hardware", hardware, _hardware(hardware.get("gpu") is not None))
        )
    else:
        result.not_compared.append("hardware: the receipt names none.")


def _compare_code(result: Verification, code: Any) -> None:
    """The source of the packages that the receipt's digest covers, if these are all that can change
    a result.
    """
    if not isinstance(code, Mapping) or not ({"sha256", "files"} & code.keys()):
        result.not_compared.append("code: the receipt has no digest of it.")
        return
    if "mme-vla" in code:
        result.differences.extend(_differences("code.mme-vla", code["mme-vla"], version("mme-vla")))
    else:
        result.not_compared.append("code.mme-vla: the receipt does not name the version.")
    if "sha256" not in code:  # of an earlier version, which digested every file
        if code["files"] != _code([""]):
            result.not_compared.append(
                "code: this receipt's digest is of every file of the library, and some file has"
                " changed since: whether one that can change a result, it cannot tell."
            )
        return
    covers = code.get("covers")
    covered = [package for package in CODE if isinstance(covers, list) and package in covers]
    result.not_compared.extend(
        f"code.{package}: not in the digest." for package in CODE if package not in covered
    )
    others = (
        []
        if not isinstance(covers, list)
        else [package for package in covers if package not in covered]
    )
    if others:
        result.not_compared.append(
            f"code: its digest covers packages that are not compared here, {brief(others)}."
        )
    elif covered:
        result.differences.extend(_differences("code.sha256", code["sha256"], _code(covered)))


def _compare_versions(result: Verification, what: str, then: Any, known: Sequence[str]) -> None:
    """Versions of packages that are named on both sides; the others are not compared."""
    if not isinstance(then, Mapping) or not then:
        result.not_compared.append(f"{what}: the receipt names no version.")
        return
    common = [name for name in known if name in then]
    here = {name: _version(name) for name in common}
    result.differences.extend(_differences(what, {name: then[name] for name in common}, here))
    lacking = [name for name in known if name not in then and _version(name) is not None]
    others = [name for name in then if name not in known]
    if lacking:
        result.not_compared.append(
            f"{what}: the receipt does not name the version of {listed(lacking)}."
        )
    if others:
        result.not_compared.append(
            f"{what}: {listed(others)} of the receipt are no packages that are compared."
        )


# The checkpoint -----------------------------------------------------------------------------------


def _checkpoint(policy: Policy, source: str | None) -> dict[str, Any]:
    """Digests of the files that the weights are from, and of the statistics in use."""
    folder = None if source is None or not Path(source).is_dir() else Path(source).resolve()
    files: dict[str, str | None] = {}
    if folder is not None:
        # Those of the table were compared with the files when they were loaded; a file beside it
        # may be loaded too.
        files = dict(Sums(folder).table)
        names = (
            [path.name for path in folder.iterdir() if path.is_file()]
            if not files
            else _loaded(folder)
        )
        files |= _sums(folder, [name for name in names if name not in files])
    statistics = digest(policy.require_processor().require_stats().to_dict(), 64)
    selected = {
        name: value
        for name, value in sorted(files.items())
        if not name.startswith((*_OF_TRAINING, SUMS))
    }
    return {
        "checkpoint": {"folder": str(source if folder is None else folder), "files": selected},
        "statistics": statistics,
    }


def _loaded(folder: Path) -> list[str]:
    """Files of a checkpoint that a policy may be loaded from."""
    names = (path.name for path in folder.iterdir() if path.suffix in _LOADED and path.is_file())
    return sorted(name for name in names if not name.startswith(_OF_TRAINING))


def _compare_checkpoint(
    result: Verification, part: Mapping[str, Any], checkpoint: Path | None
) -> None:
    """Every file that the policy was loaded from, none beside these, and the statistics."""
    named = part.get("checkpoint")
    files = named.get("files") if isinstance(named, Mapping) else None
    if not isinstance(files, Mapping) or not files:
        result.not_compared.append(
            "checkpoint: no file of it was on the machine of the run, so none is compared."
        )
        files = {}
    folder = named.get("folder") if isinstance(named, Mapping) else None
    place = checkpoint
    if place is None and isinstance(folder, str) and folder:
        place = Path(folder)
    if place is None or not (place / _CONFIG).is_file():
        text = "its folder" if place is None else brief(str(place), 200, quote=False)
        hint = "Name its folder with --checkpoint."
        result.not_compared.append(f"checkpoint: {text} is not here, or has no {_CONFIG}. {hint}")
        result.not_compared.append(f"statistics: not without the checkpoint. {hint}")
        return
    if files:
        here = _sums(place, [*files, *(name for name in _loaded(place) if name not in files)])
        result.differences.extend(_differences("checkpoint", files, here))
    if part.get("statistics") is None:
        result.not_compared.append("statistics: the receipt has no digest of them.")
    elif not (place / STATS_FILE).is_file():
        result.not_compared.append(f"statistics: {place} has no {STATS_FILE}.")
    else:
        statistics = digest(NormStats.load(place / STATS_FILE).to_dict(), 64)
        result.differences.extend(_differences("statistics", part["statistics"], statistics))


def _sums(folder: Path, names: Iterable[str]) -> dict[str, str | None]:
    """SHA-256 of files of a folder, None of one that is not there.

    Raises:
        UserError: a name leads outside of the folder.
    """
    paths = {name: inside(folder, name) for name in names}
    return {name: file_sum(path) if path.is_file() else None for name, path in paths.items()}


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _renderer() -> str | None:
    """The backend that renders, and its device."""
    if _version("sapien") is None:
        return None
    import sapien

    from mme_vla.envs.rendering import render_backend

    devices = re.findall(r"GPU:\s*(.+?)\s*\n", str(sapien.render.get_device_summary()))
    return f"{render_backend()}: {', '.join(devices)}"


def _cpu() -> str:
    info = Path("/proc/cpuinfo")
    model = re.search(r"model name\s*:\s*(.+)", info.read_text()) if info.is_file() else None
    return model[1] if model else platform.processor() or platform.machine()


def _differences(what: str, then: Any, now: Any) -> list[str]:
    """What differs between a value of a receipt and the same here, in a line each."""
    old, new = (flat({what: value}) for value in (then, now))
    lines = [
        f"{key}: {brief(old.get(key), 20)} in the receipt, {brief(new.get(key), 20)} here"
        for key in sorted({*old, *new})
        if old.get(key) != new.get(key)
    ]
    return lines[:_FEW] + [f"{what}: {len(lines) - _FEW} more"] * (len(lines) > _FEW)
