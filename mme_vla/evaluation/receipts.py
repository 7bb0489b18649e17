"""Receipts: what a third person needs to check a score, in one JSON beside each file of records."""

import hashlib
import platform
import re
import subprocess
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, NamedTuple, NotRequired, TypedDict

from pydantic import StrictBool, StrictInt

from mme_vla.config.naming import digest, flat
from mme_vla.config.plugins import import_trusted
from mme_vla.envs.base import environment
from mme_vla.envs.make import ROBOMME
from mme_vla.envs.scene_hash import NO_VALUES, NOT_BUILT
from mme_vla.errors import UserError, brief
from mme_vla.evaluation.records import EpisodeRecord, count_outcomes, read_records
from mme_vla.evaluation.rollout.events import read_events
from mme_vla.evaluation.store import RUN_FILE, read_run
from mme_vla.policy.base import Policy
from mme_vla.policy.run_folders import STATE
from mme_vla.policy.training_identity import identity_of
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
from mme_vla.utils.validation import validated

CODE = (
    "backbone",
    "embodiment",
    "envs",
    "evaluation/rollout",
    "integration",
    "memory",
    "policy",
    "processing",
    "speed",
    "subgoal",
)
"""Folders of this library that can change a result, beside the extras that the policy is of."""
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
# Setting of `run.json` → field of its records
_IDENTITY = {
    "model": "model",
    "checkpoint": "checkpoint",
    "seed": "model_seed",
    "split": "split",
    "max_steps": "max_steps",
}
# Scene of a record → why it is not compared
_UNNAMED_SCENES = {
    None: "scenes: records do not name them, as those of earlier versions.",
    NO_VALUES: "scenes: the environment gave no values of some.",
    NOT_BUILT: "scenes: some episodes ended before theirs was built.",
}
_FEW = 5  # differences of one kind that are listed


# What a receipt must be, as far as the code trusts it
_Section = dict[str, Any] | None


class _Settings(TypedDict, total=False):
    env: str | None
    event: str | None
    subgoal: _Section
    max_steps: StrictInt


class _Files(TypedDict, total=False):
    folder: str | None
    files: _Section


class _Conditions(TypedDict, total=False):
    code: _Section
    simulator: _Section
    libraries: _Section
    hardware: _Section
    checkpoint: _Files | None


class _Receipt(TypedDict):
    settings: _Settings
    conditions: list[_Conditions]
    records: dict[str, str | None]
    scenes: NotRequired[str]
    ended: NotRequired[StrictBool]
    score: dict[str, Any]


class Verification(NamedTuple):
    """The result of checking a receipt, a line each.

    differences: what is another here than in the receipt.
    not_compared: what there was nothing to compare with, which is no agreement.
    notes: what may be another without any weight, such as the type of CPU.
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

    def compare(self, what: str, then: Any, here: Any, absent_differs: bool = True) -> None:
        """Compare a value of a receipt with the same here, part by part.

        absent_differs: whether a part that only one of them has is a difference; else it is not
            compared.
        """
        old, new = flat({what: then}), flat({what: here})
        differences = []
        for key in sorted({*old, *new}):
            name = brief(key, 200, quote=False)
            if absent_differs or (key in old and key in new):
                if old.get(key) != new.get(key):
                    values = brief(old.get(key), 20), brief(new.get(key), 20)
                    differences.append(f"{name}: {values[0]} in the receipt, {values[1]} here")
            elif key in old:
                self.not_compared.append(f"{name}: there is nothing here to compare.")
            elif new[key] is not None:
                self.not_compared.append(f"{name}: the receipt does not name it.")
        self.differences.extend(differences[:_FEW])
        if len(differences) > _FEW:
            self.differences.append(f"{what}: {len(differences) - _FEW} more")


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
        records: the file.
        run: what `run.json` holds.
        source: where the weights are from.
        renders: whether the simulator of this library renders.
    """
    path = receipt_file(records)
    here = _conditions(policy.device.type == "cuda", renders, _extras_of(policy))
    here["checkpoint"] = _checkpoint(source)
    if policy.info.server is not None:
        here["server"] = dict(policy.info.server)
    conditions: list[dict[str, Any]] = []
    if path.exists():
        conditions = read_receipt(path)["conditions"]
    if to_json(here) not in conditions:
        conditions.append(here)
    trained = identity_of(policy.config)
    if policy.info.identity is not None:
        trained = policy.info.identity.training
    facts = {
        "settings": run["settings"],
        "training": None if trained is None else asdict(trained),
        "conditions": conditions,
    }

    def write(ended: bool) -> None:
        score = _score(records, read_records(records), run["settings"])
        write_json(path, with_checksum(to_json(facts | score | {"ended": ended})))

    write(ended=False)  # a process that is killed has named its conditions
    try:
        yield
    finally:
        if policy.info.server is not None:
            here["server"] = dict(policy.info.server)  # its times are known now
        if records.exists():  # the run's folder may have been removed
            write(ended=True)


def read_receipt(path: Path) -> dict[str, Any]:
    """Read a receipt.

    Raises:
        UserError: it is damaged, lacks a part, or a part is of another kind.
    """
    content: dict[str, Any] = verified(read_json(path, "a receipt"), str(path))
    try:
        validated(_Receipt, content, "The file")
    except UserError as error:
        raise UserError(f"{path} is no receipt of an evaluation: {error}") from None
    return content


def verify(
    path: Path, checkpoint: Path | None = None, build: bool = True, trust_plugins: bool = False
) -> Verification:
    """Check a receipt offline: compare it with the files and the versions that are here.

    Args:
        path: of the receipt; its records, or these as `.xz`, and `run.json` are beside it.
        checkpoint: where the checkpoint is, if not at the place that the receipt names.
        build: whether the scenes are built here, without images, and compared: about 0.1 s a scene.
        trust_plugins: import the parts of installed packages that receipt and records name.

    Raises:
        UserError: the file is no receipt, or a name in it leads outside of the folder that it is
            of.
    """
    content = read_receipt(path)
    result = Verification([], [], [])
    if path.with_name(RUN_FILE).is_file():
        result.compare("settings", content["settings"], read_run(path.parent)["settings"])
    else:
        result.not_compared.append(f"settings: {RUN_FILE} is not beside the receipt.")

    folder = path.parent
    names = {content["records"].get("file")}
    names |= {read_receipt(other)["records"].get("file") for other in folder.glob("receipt*.json")}
    for file in sorted([*folder.glob("episodes*.jsonl"), *folder.glob("episodes*.jsonl.xz")]):
        if file.name.removesuffix(".xz") not in names:
            result.not_compared.append(f"records: no receipt names {file.name}.")
    name = content["records"].get("file")
    if name is None:
        result.not_compared.append("records: the receipt names no file of them.")
    else:
        # The records may have been compressed since. Results read both files where there are two.
        files = [inside(folder, end, "records") for end in (name, f"{name}.xz")]
        present = [file for file in files if file.is_file()]
        if not present:
            missing = f"records: neither {name} nor {name}.xz is beside the receipt."
            result.differences.append(missing)
        for file in present:
            records = read_records(file)
            for key, value in to_json(_score(file, records, content["settings"])).items():
                if not content.get("ended", True):
                    unwritten = "records: their process was killed before it wrote their score."
                    result.not_compared.append(unwritten)
                elif key == "scenes" and key not in content:
                    result.not_compared.append("scenes: the receipt does not name them.")
                elif key != "score" or content["score"] != _outcomes(records):
                    # Receipts of earlier versions count every try of an episode.
                    result.compare(key, content.get(key, {}), value)
            _compare_records(result, records, content, trust_plugins)
            _compare_scenes(result, records, content, build, trust_plugins)

    for part in content["conditions"] or [{}]:
        _compare_conditions(result, part, checkpoint)
    return Verification(*(list(dict.fromkeys(lines)) for lines in result))


# The records --------------------------------------------------------------------------------------


def _score(
    path: Path, records: Sequence[EpisodeRecord], settings: Mapping[str, Any]
) -> dict[str, Any]:
    """Outcomes of each task, of each episode the one that results count, and digests: of the file
    of records, uncompressed, of the choice of scenes (a file of scenes counts with its content) and
    of every scene that was built.
    """
    digest_of_file = None
    if path.exists():
        digest_of_file = hashlib.sha256(read_unpacked(path, "episode records")).hexdigest()
    split = str(settings.get("split"))
    if Path(split).is_file():
        split = file_sum(Path(split))
    seeds: dict[str, list[Any]] = {}
    scenes: dict[str, str] = {}
    ended: dict[str, EpisodeRecord] = {}
    for record in records:
        name = f"{record.task} {record.episode}"
        # The first try that ended by itself counts, else the last one.
        if name not in ended or ended[name].outcome == "error":
            ended[name] = record
        seeds[name] = [record.seed, record.difficulty]
        if record.scene:
            scenes[name] = record.scene
    return {
        "records": {"file": path.name.removesuffix(".xz"), "sha256": digest_of_file},
        "scenes": digest({"split": split, "scenes": seeds}, 64),
        "scene_digests": scenes,
        "score": _outcomes(list(ended.values())),
    }


def _outcomes(records: Sequence[EpisodeRecord]) -> dict[str, Mapping[str, int]]:
    tasks: dict[str, list[EpisodeRecord]] = {}
    for record in records:
        tasks.setdefault(record.task, []).append(record)
    return {task: count_outcomes(members) for task, members in tasks.items()}


def _compare_records(
    result: Verification,
    records: Sequence[EpisodeRecord],
    content: Mapping[str, Any],
    trust_plugins: bool,
) -> None:
    """Whether every record is of the settings and of the training, and no longer than its limit."""
    settings = content["settings"]
    expected: dict[str, Any] = {name: settings.get(name) for name in ("event", "env")}
    expected["subgoal"] = (settings.get("subgoal") or {}).get("name")
    for key, field in _IDENTITY.items():
        if key in settings:
            expected[field] = settings[key]
        else:
            result.not_compared.append(f"settings.{key}: the receipt does not name it.")
    if "training" in content:
        expected["training"] = content["training"]
    # Of other environments each task may have a limit of its own, and the settings have the most.
    of_robomme = expected["env"] in (None, ROBOMME)
    most = expected.get("max_steps", float("inf"))
    if not of_robomme:
        expected.pop("max_steps", None)

    limit = settings.get("max_steps", float("inf")) + _MARGIN
    try:
        # The time for which events hold the robot counts as well.
        words = re.split("[:@+]", str(expected["event"]))
        import_trusted({"event": words}, f"event={expected['event']}", trust_plugins)
        limit += sum(event.perturbation.hold for event in read_events(expected["event"]))
    except UserError as error:
        limit = float("inf")
        result.not_compared.append(f"steps: the receipt's event cannot be read ({error}).")

    for record in records:
        values = asdict(record)
        values["env"] = record.env or expected["env"]  # not every record names its own
        for field in ("composition", "action_space"):  # a run has one policy and one robot
            expected.setdefault(field, values[field])
        for field, value in expected.items():
            result.compare(f"records.{field}", str(value), str(values[field]))
        if not of_robomme and record.max_steps > most:
            result.compare("records.max_steps", f"at most {most}", record.max_steps)
        # A motion of RoboMME may end beyond the limit.
        is_motion = expected["env"] == ROBOMME and record.action_space in MOTIONS
        if record.steps < 0 or (record.steps > limit and not is_motion):
            result.compare("records.steps", f"0 to {limit}", record.steps)


def _compare_scenes(
    result: Verification,
    records: Sequence[EpisodeRecord],
    content: Mapping[str, Any],
    build: bool,
    trust_plugins: bool,
) -> None:
    """Seeds and difficulties of the episodes, and the scenes' digests, for which they are built."""
    if not records:
        result.not_compared.append("scenes: there is no record.")
    try:
        source = str(content["settings"].get("env"))
        parts = {"env": source, "tasks": [record.task for record in records]}
        import_trusted(parts, f"env={source}", trust_plugins)
        env = environment(source)
        # A try that ended before its scene was built does not count beside one that names it.
        named = {record.key for record in records if record.named_scene is not None}
        for record in records:
            env.check_task(record.task)
            spec = env.episode(record.task, record.split, record.episode)
            name = f"scene {record.task} {record.episode}"
            then = f"{record.seed}, {record.difficulty}"
            result.compare(name, then, f"{spec.seed}, {spec.difficulty}")
            if record.scene in _UNNAMED_SCENES:
                if record.key not in named:
                    result.not_compared.append(_UNNAMED_SCENES[record.scene])
            elif build:
                result.compare(name, record.scene, env.scene_digest(spec))
            else:
                result.not_compared.append("scenes: they were not built here, as was asked.")
    except UserError as error:  # of a plugin that is not loaded, or without the simulator
        result.not_compared.append(f"scenes: {error}")


# The conditions -----------------------------------------------------------------------------------


def _conditions(on_gpu: bool, renders: bool, folders: Iterable[str]) -> dict[str, Any]:
    """Code, simulator, renderer, libraries and hardware of this process.

    folders: of this library, beside those of `CODE`.
    """
    import torch

    cpu = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.is_file() and (
        model := re.search(r"model name\s*:\s*(.+)", info.read_text(encoding="utf-8"))
    ):
        cpu = model[1]
    gpu = None
    if on_gpu and torch.cuda.is_available():
        gpu = torch.cuda.get_device_name()
    renderer = None
    if renders and _version("sapien") is not None:
        import sapien

        from mme_vla.envs.rendering import render_backend

        devices = re.findall(r"GPU:\s*(.+?)\s*\n", str(sapien.render.get_device_summary()))
        renderer = f"{render_backend()}: {', '.join(devices)}"
    return {
        "code": {"mme-vla": version("mme-vla"), **_code(frozenset({*CODE, *folders}))},
        "simulator": {name: _version(name) for name in SIMULATOR},
        "renderer": renderer,
        "libraries": {name: _version(name) for name in LIBRARIES},
        "hardware": {"cpu": cpu, "gpu": gpu},
    }


@cache
def _code(folders: frozenset[str]) -> dict[str, str]:
    """The names that git has for the source of each folder, in a clone; no source is read for them.

    Changes that are not committed are part of the name. Of an installed package the version names
    the code.
    """
    names = {}
    try:
        status = _git("status", "--porcelain", ".")
        for line in _git("ls-tree", "-rd", "HEAD", "."):
            tree, _, folder = line.partition("\t")
            if folder not in folders:
                continue
            names[f"git {folder}"] = tree.split()[2]
            changes = [change for change in status if f"mme_vla/{folder}/" in change]
            if changes:
                changes += _git("diff", "HEAD", "--", folder)
                new_files = _git("ls-files", "--others", "--exclude-standard", "--", folder)
                if new_files:
                    changes += _git("hash-object", "--", *new_files)
                names[f"git {folder}"] += f"+{digest({'changes': changes}, 12)}"
    except (OSError, subprocess.CalledProcessError):  # no clone, or no git
        return {}
    return names


def _git(*words: str) -> list[str]:
    command = ["git", "-C", str(Path(__file__).parents[1]), *words]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()


def _extras_of(policy: Policy) -> set[str]:
    """The extras that the policy's classes are from, such as `extras/nano`."""
    extras = set()
    for part in (*policy.modules(), policy.processor):
        names = type(part).__module__.split(".")
        if names[:2] == ["mme_vla", "extras"]:
            extras.add("/".join(names[1:3]))
    return extras


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _compare_conditions(
    result: Verification, part: Mapping[str, Any], checkpoint: Path | None
) -> None:
    """Compare what both the receipt and this machine name of code, packages, checkpoint, …."""
    folders = [name.partition(" ")[2] for name in part.get("code") or {} if " " in name]
    on_gpu = (part.get("hardware") or {}).get("gpu") is not None
    renders = part.get("renderer", "not named") is not None
    for what, here in _conditions(on_gpu, renders, folders).items():
        then = part.get(what, {})
        if what == "hardware":  # another type of CPU or GPU has no weight
            result._replace(differences=result.notes).compare(what, then, here, False)
        else:
            result.compare(what, then, here, False)

    named = part.get("checkpoint") or {}
    files = named.get("files")
    folder = checkpoint or Path(named.get("folder") or "no folder")
    if not files:
        result.not_compared.append("checkpoint: the receipt does not name it.")
    elif (folder / "config.json").is_file():
        loaded = _loaded(folder)  # a file beside those of the receipt is a difference
        then = {**dict.fromkeys(loaded), **files}
        result.compare("checkpoint", then, _sums(folder, then))
    else:
        hint = f"{brief(str(folder), 200, quote=False)}: name its folder with --checkpoint"
        result.not_compared.append(f"checkpoint: there is no checkpoint in {hint}.")


# The checkpoint -----------------------------------------------------------------------------------


def _checkpoint(source: str | None) -> dict[str, Any]:
    """Digests of the files that the weights are from."""
    if source is None or not Path(source).is_dir():
        return {"folder": str(source), "files": {}}
    folder = Path(source).resolve()
    # Those of the table were compared with the files when they were loaded; a file beside it may be
    # loaded too.
    table = Sums(folder).table
    files = _sums(folder, [name for name in _loaded(folder) if name not in table])
    files |= {name: table[name] for name in table if not name.startswith(_OF_TRAINING)}
    return {"folder": str(folder), "files": files}


def _loaded(folder: Path) -> list[str]:
    """Files of a checkpoint that a policy may be loaded from."""
    names = []
    for path in folder.iterdir():
        is_of_policy = path.suffix in _LOADED and not path.name.startswith(_OF_TRAINING)
        if is_of_policy and path.is_file():
            names.append(path.name)
    return sorted(names)


def _sums(folder: Path, names: Iterable[str]) -> dict[str, str | None]:
    """SHA-256 of files of a folder, None of one that is not there.

    Raises:
        UserError: a name leads outside of the folder.
    """
    sums = {}
    for name in names:
        path = inside(folder, name)
        sums[name] = file_sum(path) if path.is_file() else None
    return sums
