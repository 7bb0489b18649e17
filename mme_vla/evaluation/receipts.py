"""Receipts: what a third person needs to check a score, in one JSON beside each file of records."""

import hashlib
import lzma
import platform
import re
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from mme_vla.config.naming import digest, flat
from mme_vla.envs.base import environment
from mme_vla.errors import UserError, brief, require
from mme_vla.evaluation.records import EpisodeRecord, count_outcomes
from mme_vla.evaluation.store import RUN_FILE, read_records, read_run
from mme_vla.policy.base import Policy
from mme_vla.policy.run_folders import STATE
from mme_vla.policy.training_identity import identity_of
from mme_vla.processing.base import STATS_FILE
from mme_vla.processing.normalise import NormStats
from mme_vla.utils import Sums, file_sum, read_json, to_json, verified, with_checksum, write_json

_SIMULATOR, _LIBRARIES = ("mani_skill", "sapien", "robomme"), ("torch", "numpy")
_OF_TRAINING = ("raw.", "raw-", "optimizer", STATE)  # Files of a checkpoint that no policy is loaded from
_FEW = 5  # differences of one kind that are listed


def receipt_file(records: Path) -> Path:
    """The receipt of `episodes.jsonl` is `receipt.json`, that of `episodes-0of4.jsonl` `receipt-0of4.json`."""
    return records.with_name(records.name.replace("episodes", "receipt")).with_suffix(".json")


@contextmanager
def receipt(records: Path, policy: Policy, run: Mapping[str, Any], source: str | None, renders: bool) -> Iterator[None]:
    """Write the receipt of a file of records before and after episodes are added to it.

    A run that was continued on another machine, or after an update, lists the conditions of each part.

    Args:
        records: the file. run: what `run.json` holds. source: where the weights are from. renders: whether the
            simulator of this library renders.
    """
    path = receipt_file(records)
    earlier = read_receipt(path)["conditions"] if path.exists() else []
    here = to_json({**_conditions(policy.device.type == "cuda", renders), **_checkpoint(policy, source)})
    conditions = earlier if here in earlier else [*earlier, here]
    trained = identity_of(policy.config)
    facts = {
        "settings": run["settings"], "training": None if trained is None else asdict(trained), "conditions": conditions
    }  # fmt: skip

    def write() -> None:
        write_json(path, with_checksum(to_json({**facts, **_score(records, run["settings"])})))

    write()  # a process that is killed has named its conditions
    try:
        yield
    finally:
        write()


def read_receipt(path: Path) -> dict[str, Any]:
    """Read a receipt."""
    content: dict[str, Any] = verified(read_json(path, "a receipt"), str(path))
    missing = [key for key in ("settings", "conditions", "records", "scenes", "score") if key not in content]
    require(not missing, f"{path} is no receipt of an evaluation: it has no {', '.join(missing)}.")
    return content


def verify(path: Path, checkpoint: Path | None = None) -> tuple[list[str], list[str]]:
    """Check a receipt offline: recompute the digests of the files that are here, compare versions of what is installed.

    Args:
        path: of the receipt; its records, or these as `.xz`, and `run.json` are beside it.
        checkpoint: where the checkpoint is, if not at the place that the receipt names.

    Returns:
        What differs, and what could not be compared or is another machine's.
    """
    content, folder = read_receipt(path), path.parent
    settings, differences, notes = content["settings"], list[str](), list[str]()
    if (folder / RUN_FILE).is_file():
        differences += _differences("settings", settings, read_run(folder)["settings"])
    else:
        notes.append(f"{RUN_FILE} is not beside the receipt: the settings are the receipt's word alone.")
    records = folder / content["records"]["file"]
    records = records if records.is_file() else records.with_name(f"{records.name}.xz")
    if records.is_file():
        score = to_json(_score(records, settings))
        for key in ("records", "score", "scenes"):
            differences += _differences(key, content[key], score[key])
        if why := _unknown_scenes(read_records(records), settings):
            notes.append(f"scenes: not compared. {why}")
        else:
            differences += _other_scenes(read_records(records), settings)
    else:
        differences.append(f"records: {content['records']['file']} is not beside the receipt, nor {records.name}.")
    for part in content["conditions"]:
        here = _conditions(part["hardware"]["gpu"] is not None, part["renderer"] is not None)
        for key in ("code", "simulator", "renderer", "libraries"):
            differences += _differences(key, part[key], here[key])
        notes += _differences("hardware", part["hardware"], here["hardware"])
        place = checkpoint or Path(part["checkpoint"]["folder"] or "")
        if not part["checkpoint"]["files"]:
            notes.append("checkpoint: no file of it was on the machine of the run, so none is compared.")
        elif not place.is_dir():
            notes.append(f"checkpoint: {place} is not here. Name its folder with --checkpoint.")
        else:
            files = part["checkpoint"]["files"]
            differences += _differences("checkpoint", files, _sums(place, files))
            if (place / STATS_FILE).is_file():
                statistics = digest(NormStats.load(place / STATS_FILE).to_dict(), 64)
                differences += _differences("statistics", part["statistics"], statistics)
    return list(dict.fromkeys(differences)), list(dict.fromkeys(notes))


def _score(records: Path, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Outcomes of each task, and digests of the records, uncompressed, and of their scenes."""
    lines = read_records(records) if records.exists() else []
    name, total = records.name.removesuffix(".xz"), None
    if records.exists():
        content = records.read_bytes()
        content = lzma.decompress(content) if records.suffix == ".xz" else content
        total = hashlib.sha256(content).hexdigest()
    tasks = dict.fromkeys(record.task for record in lines)
    return {
        "records": {"file": name, "sha256": total},
        "scenes": _scenes(lines, settings["split"]),
        "score": {task: count_outcomes(line for line in lines if line.task == task) for task in tasks},
    }


def _scenes(records: Iterable[EpisodeRecord], split: str) -> str:
    """Digest of what makes the scenes: task, number, seed and difficulty; and the file of a split that is one."""
    scenes: dict[str, Any] = {f"{r.task} {r.episode}": [r.seed, r.difficulty] for r in records}
    return digest({"split": file_sum(Path(split)) if Path(split).is_file() else split, "scenes": scenes}, 64)


def _unknown_scenes(records: Iterable[EpisodeRecord], settings: Mapping[str, Any]) -> str | None:
    """Why there are no scenes here to compare with: an environment or a task of a plugin that is not loaded."""
    try:
        env = environment(settings["env"])
        for task in {record.task for record in records}:
            env.check_task(task)
    except UserError as error:
        return str(error)
    return None


def _other_scenes(records: Iterable[EpisodeRecord], settings: Mapping[str, Any]) -> list[str]:
    """Episodes whose seed or difficulty is not the one that the environment gives them here."""
    env, lines = environment(settings["env"]), list[str]()
    for record in records:
        spec = env.episode(record.task, record.split, record.episode)
        here = f"{spec.seed}, {spec.difficulty}"
        lines += _differences(f"scene {record.task} {record.episode}", f"{record.seed}, {record.difficulty}", here)
    return lines


def _conditions(on_gpu: bool, renders: bool) -> dict[str, Any]:
    """Code, simulator, renderer, libraries and hardware of this process."""
    import torch

    package = Path(__file__).resolve().parents[1]
    code = {path.relative_to(package).as_posix(): file_sum(path) for path in sorted(package.rglob("*.py"))}
    return {
        "code": {"mme-vla": version("mme-vla"), "files": digest(code, 64)},
        "simulator": {name: _version(name) for name in _SIMULATOR},
        "renderer": _renderer() if renders else None,
        "libraries": {name: _version(name) for name in _LIBRARIES},
        "hardware": {
            "cpu": _cpu(), "gpu": torch.cuda.get_device_name() if on_gpu and torch.cuda.is_available() else None
        },
    }  # fmt: skip


def _checkpoint(policy: Policy, source: str | None) -> dict[str, Any]:
    """Digests of the files that the weights are from, and of the statistics in use."""
    folder = None if source is None or not Path(source).is_dir() else Path(source).resolve()
    files: Mapping[str, str | None] = {}
    if folder is not None:
        # Those of the table were compared with the files when they were loaded.
        files = Sums(folder).table or _sums(folder, [path.name for path in folder.iterdir() if path.is_file()])
    statistics = digest(policy.require_processor().require_stats().to_dict(), 64)
    selected = {name: value for name, value in sorted(files.items()) if not name.startswith(_OF_TRAINING)}
    return {
        "checkpoint": {"folder": str(source if folder is None else folder), "files": selected}, "statistics": statistics
    }  # fmt: skip


def _sums(folder: Path, names: Iterable[str]) -> dict[str, str | None]:
    return {name: file_sum(folder / name) if (folder / name).is_file() else None for name in names}


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
