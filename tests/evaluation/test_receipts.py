"""A receipt agrees with the run it is of, and names what differs from it."""

import json
import lzma
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("mani_skill", reason="scenes are built, which needs the extra 'sim'")

from helpers.nano_policies import nano
from helpers.rollout_fakes import quick_policy
from mme_vla import UserError, registry
from mme_vla.cli.results import main
from mme_vla.config import plugins
from mme_vla.envs.base import environment
from mme_vla.envs.scene_hash import NOT_BUILT
from mme_vla.evaluation import receipts
from mme_vla.evaluation.records import EpisodeRecord, RecordLog
from mme_vla.evaluation.rollout.evaluation import facts_of, run_settings
from mme_vla.evaluation.rollout.settings import RolloutSettings
from mme_vla.evaluation.store import begin_run, fingerprint, read_records
from mme_vla.policy.base import Policy
from mme_vla.policy.identity import checkpoint_label
from mme_vla.policy.training_identity import TrainingIdentity
from mme_vla.utils import to_json, with_checksum


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("policy") / "step_000003"
    quick_policy("framesamp_modul").save_pretrained(folder)
    return folder


NAMES_OF_CODE = receipts._code.__wrapped__


@pytest.fixture(autouse=True)
def committed_code(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every folder has a name, whether this checkout is a clone and without changes or not."""
    monkeypatch.setattr(receipts, "_code", lambda names: {f"git {name}": "0" for name in names})


def run(
    folder: Path,
    checkpoint: Path,
    episodes: range = range(3),
    execute: int | None = None,
    errors: int = 0,
) -> Path:
    """Records of these episodes, every second one solved, with their receipt.

    errors: tries of episode 1 before that ended in an error.
    """
    policy = Policy.from_pretrained(checkpoint)
    settings = RolloutSettings(execute=execute)
    facts = facts_of(policy, None, str(checkpoint), settings, None)
    claimed = begin_run(folder, run_settings(policy, facts, settings, None, str(checkpoint)))
    path = folder / "episodes.jsonl"
    with (
        RecordLog(path) as log,
        receipts.receipt(path, policy, claimed, str(checkpoint), renders=False),
    ):
        for index, number in enumerate((*[1] * errors, *episodes)):
            spec = environment("mme_vla").episode("VideoUnmask", "test", number)
            outcome = "success" if number % 2 else "fail"
            scene = environment("mme_vla").scene_digest(spec)
            if index < errors:
                outcome, scene = "error", NOT_BUILT
            log.append(
                EpisodeRecord(
                    facts.model,
                    checkpoint_label(str(checkpoint)),
                    42,
                    spec.task,
                    number,
                    spec.seed,
                    spec.difficulty,
                    outcome,
                    9,
                    scene=scene,
                )
            )
    return folder / "receipt.json"


@pytest.mark.slow
def test_a_receipt_agrees_with_its_run(
    checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = run(tmp_path, checkpoint)
    assert receipts.verify(path) == ([], [], [])
    content = receipts.read_receipt(path)
    assert content["score"] == {"VideoUnmask": {"success": 1, "fail": 2, "timeout": 0, "error": 0}}
    assert (content["settings"]["execute"], content["settings"]["flow_steps"]) == (16, 10)
    assert {"model.safetensors", "config.json", "norm_stats.json"} <= set(
        content["conditions"][0]["checkpoint"]["files"]
    )
    main(["verify", str(tmp_path)])
    assert "agrees" in capsys.readouterr().out
    records = tmp_path / "episodes.jsonl"
    records.with_name("episodes.jsonl.xz").write_bytes(lzma.compress(records.read_bytes()))
    records.unlink()
    assert receipts.verify(path) == ([], [], []), "as records are published"


def test_an_episode_that_was_tried_again_counts_once(checkpoint: Path, tmp_path: Path) -> None:
    path = run(tmp_path, checkpoint, range(1, 2), errors=1)
    counts = {"success": 1, "fail": 0, "timeout": 0, "error": 0}
    assert receipts.read_receipt(path)["score"] == {"VideoUnmask": counts}
    assert receipts.verify(path).word == "agrees"
    # as earlier versions counted
    rewrite(path, lambda content: content["score"]["VideoUnmask"].update(error=1))
    assert receipts.verify(path).word == "agrees"
    rewrite(path, lambda content: content["score"]["VideoUnmask"].update(error=2))
    assert receipts.verify(path).differences == [
        "score.VideoUnmask.error: 2 in the receipt, 0 here"
    ]


def test_an_episode_whose_every_try_failed_is_one_error(checkpoint: Path, tmp_path: Path) -> None:
    path = run(tmp_path, checkpoint, range(0), errors=2)
    counts = {"success": 0, "fail": 0, "timeout": 0, "error": 1}
    assert receipts.read_receipt(path)["score"] == {"VideoUnmask": counts}
    result = receipts.verify(path)
    assert result.word == "not compared" and "ended before" in result.not_compared[0]


@pytest.mark.parametrize("name", ["model.safetensors", "norm_stats.json"])
def test_a_changed_byte_of_a_checkpoint_is_named(
    name: str, checkpoint: Path, tmp_path: Path
) -> None:
    path = run(tmp_path / "run", checkpoint)
    copy = shutil.copytree(checkpoint, tmp_path / "copy")
    content = bytearray((copy / name).read_bytes())
    content[-1] ^= 1 if name == "model.safetensors" else ord("\n") ^ ord(" ")
    (copy / name).write_bytes(content)
    differences, *_ = receipts.verify(path, copy)
    assert len(differences) == 1 and differences[0].startswith(f"checkpoint.{name}: ")


def test_another_simulator_is_named(
    checkpoint: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    path = run(tmp_path, checkpoint)
    installed = receipts.version
    monkeypatch.setattr(
        receipts, "version", lambda name: "0.0.1" if name == "sapien" else installed(name)
    )
    with pytest.raises(SystemExit):
        main(["verify", str(path)])
    output = capsys.readouterr().out
    assert "differs" in output and "simulator.sapien: " in output and "'0.0.1' here" in output
    run(tmp_path, checkpoint, range(3, 4))  # the rest of the run, under the other one
    assert len(receipts.read_receipt(path)["conditions"]) == 2


def test_another_chunk_length_is_named(checkpoint: Path, tmp_path: Path) -> None:
    path = run(tmp_path / "sixteen", checkpoint)
    other = run(tmp_path / "eight", checkpoint, execute=8)
    other.write_bytes(path.read_bytes())
    differences, *_ = receipts.verify(other)
    assert "settings.execute: 16 in the receipt, 8 here" in differences


def test_changed_records_scenes_and_receipts_are_named(checkpoint: Path, tmp_path: Path) -> None:
    path = run(tmp_path, checkpoint)
    records = tmp_path / "episodes.jsonl"
    lines = records.read_text().splitlines()
    first = EpisodeRecord.from_json(lines[0])
    changed = {**json.loads(lines[0]), "outcome": "success", "seed": first.seed + 1}
    changed.pop("crc32")
    records.write_text("\n".join([json.dumps(changed), *lines[1:]]) + "\n")
    differences, *_ = receipts.verify(path)
    starts = [line.split(":")[0] for line in differences]
    assert {"records.sha256", "score.VideoUnmask.success", "scenes", "scene VideoUnmask 0"} <= set(
        starts
    )
    other = tmp_path / "receipt-of-something-else.json"
    other.write_text(json.dumps({"settings": {}}))
    with pytest.raises(
        UserError, match="is no receipt of an evaluation: The file lacks the key 'conditions'"
    ):
        receipts.verify(other)
    path.write_text(path.read_text().replace('"success": 1', '"success": 3'))
    with pytest.raises(UserError, match="is not what was written"):
        receipts.verify(path)


def test_scenes_of_an_environment_that_is_not_here_are_not_compared(
    checkpoint: Path, tmp_path: Path
) -> None:
    path = run(tmp_path, checkpoint)
    for name in ("receipt.json", "run.json"):
        content = json.loads((tmp_path / name).read_text())
        content.pop("crc32")
        content["settings"]["env"] = "of_a_plugin"
        if name == "run.json":
            content["fingerprint"] = fingerprint(content["settings"])
        (tmp_path / name).write_text(json.dumps(content))
    result = receipts.verify(path)
    assert not result.differences and result.word == "not compared"
    assert any(line.startswith("scenes: ") for line in result.not_compared)


@pytest.fixture
def of_a_plugin(finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The folder of a run in an environment of the module `foreign_env`, which lies there."""
    for path in (finished, finished.with_name("run.json")):
        rewrite(path, lambda content: content["settings"].update(env="of_a_plugin"))
    (tmp_path / "foreign_env.py").write_text(
        "from mme_vla.envs.benchmark import RoboMME\nfrom mme_vla.registry import ENVS\n\n\n"
        "@ENVS.register('of_a_plugin')\nclass Foreign(RoboMME):\n    pass\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setattr(plugins, "_imported", {})
    yield tmp_path
    sys.modules.pop("foreign_env", None)
    registry.ENVS._entries.pop("of_a_plugin", None)


def test_an_environment_of_a_plugin_is_verified_with_its_module(of_a_plugin: Path) -> None:
    assert verified_by_command(of_a_plugin) == 3
    assert verified_by_command(of_a_plugin, "--trust-plugins") == 3, "the receipt names no module"
    assert "foreign_env" not in sys.modules
    assert verified_by_command(of_a_plugin, "--plugins", "foreign_env") == 0


@pytest.mark.parametrize("option", ["--trust-plugins", "trust_plugins=true"])
def test_installed_code_that_a_receipt_names_needs_trust(
    option: str,
    of_a_plugin: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    extension = registry.Extension(parts={"env": {"of_a_plugin": "foreign_env"}})
    for module in (plugins, registry):
        monkeypatch.setattr(module, "installed_extensions", lambda: (extension,))
    monkeypatch.syspath_prepend(of_a_plugin)
    assert verified_by_command(of_a_plugin) == 3
    assert "scenes: env=of_a_plugin needs the plugin foreign_env" in capsys.readouterr().out
    assert "foreign_env" not in sys.modules
    assert verified_by_command(of_a_plugin, option) == 0


def test_a_receipt_is_named_after_its_records_packed_or_not() -> None:
    names = {"episodes.jsonl": "receipt.json", "episodes.jsonl.xz": "receipt.json"}
    names |= {
        "episodes-0of4.jsonl": "receipt-0of4.json",
        "episodes-0of4.jsonl.xz": "receipt-0of4.json",
    }
    assert {name: receipts.receipt_file(Path(name)).name for name in names} == names


# Absence is no agreement --------------------------------------------------------------------------


def rewrite(path: Path, change: Callable[[dict[str, Any]], None]) -> None:
    """Change a receipt or `run.json` as a forger does, who brings its checksum and fingerprint in
    order.
    """
    content = json.loads(path.read_text())
    content.pop("crc32")
    change(content)
    if "fingerprint" in content:
        content["fingerprint"] = fingerprint(content["settings"])
    path.write_text(json.dumps(with_checksum(content)))


def rewrite_records(path: Path, **fields: Any) -> None:
    """Change every record, and bring the receipt's digests and score in order."""
    records = path.with_name("episodes.jsonl")
    lines = [
        replace(EpisodeRecord.from_json(line), **fields)
        for line in records.read_text().splitlines()
    ]
    records.write_text("".join(line.to_json() + "\n" for line in lines))
    done = read_records(records)
    rewrite(
        path,
        lambda content: content.update(
            to_json(receipts._score(records, done, content["settings"]))
        ),
    )


def first(content: dict[str, Any]) -> dict[str, Any]:
    return content["conditions"][0]


def named(part: str, names: Iterable[str]) -> set[str]:
    """The lines on the parts of a condition that are here."""
    return {f"{part}.{name}" for name in names if part == "code" or receipts._version(name)}


CODE = named("code", [f"git {folder}" for folder in receipts.CODE])
SIMULATOR = named("simulator", receipts.SIMULATOR)
LIBRARIES = named("libraries", receipts.LIBRARIES)
ABSENCES: dict[str, tuple[Callable[[dict[str, Any]], object], set[str]]] = {
    "no condition": (
        lambda c: c.update(conditions=[]),
        {"code.mme-vla", "renderer", "hardware.cpu", "checkpoint", *CODE, *SIMULATOR, *LIBRARIES},
    ),
    "no files of the checkpoint": (
        lambda c: first(c)["checkpoint"].update(files={}),
        {"checkpoint"},
    ),
    "no checkpoint": (lambda c: first(c).pop("checkpoint"), {"checkpoint"}),
    "another folder": (
        lambda c: first(c)["checkpoint"].update(folder="nowhere"),
        {"checkpoint"},
    ),
    "no folder": (lambda c: first(c)["checkpoint"].update(folder=""), {"checkpoint"}),
    "no code": (lambda c: first(c).pop("code"), {"code.mme-vla", *CODE}),
    "code of nothing": (
        lambda c: first(c).update(code={"mme-vla": first(c)["code"]["mme-vla"]}),
        CODE,
    ),
    "no version of the library": (lambda c: first(c)["code"].pop("mme-vla"), {"code.mme-vla"}),
    "no simulator": (lambda c: first(c).update(simulator={}), SIMULATOR),
    "no PyTorch": (lambda c: first(c)["libraries"].pop("torch"), {"libraries.torch"}),
    "no renderer": (lambda c: first(c).pop("renderer"), {"renderer"}),
    "no hardware": (lambda c: first(c).update(hardware={}), {"hardware.cpu"}),
    "no scenes": (lambda c: c.pop("scenes"), {"scenes"}),
    "no file of records": (lambda c: c.update(records={}), {"records"}),
}


@pytest.mark.slow
@pytest.mark.parametrize("change, expected", ABSENCES.values(), ids=ABSENCES)
def test_what_a_receipt_lacks_is_not_compared(
    change: Callable[[dict[str, Any]], object],
    expected: set[str],
    finished: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    rewrite(finished, lambda content: (change(content), None)[1])
    result = receipts.verify(finished, build=True)
    assert {line.split(":")[0] for line in result.not_compared} == expected
    assert (result.differences, result.word) == ([], "not compared")
    with pytest.raises(SystemExit) as ended:
        main(["verify", str(finished)])
    assert ended.value.code == 3 and "not compared: " in capsys.readouterr().out


@pytest.fixture
def finished(checkpoint: Path, tmp_path: Path) -> Path:
    """A receipt that agrees."""
    return run(tmp_path, checkpoint, range(1))


def test_a_missing_run_and_scenes_that_are_not_built_are_not_compared(finished: Path) -> None:
    result = receipts.verify(finished, build=False)
    assert result.word == "not compared" and [line[:7] for line in result.not_compared] == [
        "scenes:"
    ]
    finished.with_name("run.json").unlink()
    assert [line.split(":")[0] for line in receipts.verify(finished).not_compared] == ["settings"]


@pytest.mark.parametrize(
    "scene, reason",
    [(None, "earlier versions"), ("no values", "gave no values"), ("not built", "ended before")],
)
def test_episodes_whose_scene_is_not_named_are_not_compared(
    scene: str | None, reason: str, finished: Path
) -> None:
    rewrite_records(finished, scene=scene)
    result = receipts.verify(finished)
    assert result.word == "not compared" and reason in result.not_compared[0]


def verified_by_command(path: Path, *options: str) -> int:
    """Exit code of the command."""
    try:
        main(["verify", str(path), *options])
    except SystemExit as ended:
        return int(str(ended.code))
    return 0


@pytest.mark.parametrize("name", ["episodes-1of2.jsonl", "episodes-1of2.jsonl.xz"])
def test_records_that_no_receipt_names_are_not_compared(
    name: str, finished: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    further = finished.with_name(name)
    shutil.copy(finished.with_name("episodes.jsonl"), further)
    line = f"records: no receipt names {name}."
    assert receipts.verify(finished) == ([], [line], [])
    # a receipt of the same name that is of the other file
    shutil.copy(finished, receipts.receipt_file(further))
    assert receipts.verify(finished) == ([], [line], [])
    below = finished.parent / "below"
    below.mkdir()
    further.rename(below / name)
    assert receipts.verify(finished).word == "agrees"
    assert verified_by_command(finished.parent) == 3
    assert f"{below / name}: not compared" in capsys.readouterr().out


def test_records_and_others_under_the_same_name_compressed_are_both_compared(
    finished: Path,
) -> None:
    records = finished.with_name("episodes.jsonl")
    packed = finished.with_name("episodes.jsonl.xz")
    packed.write_bytes(lzma.compress(records.read_bytes()))
    assert receipts.verify(finished).word == "agrees"
    forged = EpisodeRecord.from_json(records.read_text())
    packed.write_bytes(lzma.compress(replace(forged, outcome="success").to_json().encode() + b"\n"))
    assert receipts.verify(finished).word == "differs"


def test_a_receipt_of_a_killed_process_is_not_compared_with_its_records(
    checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write, files = receipts.write_json, []
    monkeypatch.setattr(receipts, "write_json", lambda *file: files.append(file))
    path = run(tmp_path, checkpoint, range(1))
    begun, ended = files
    write(*begun)  # all that a killed process writes
    line = "records: their process was killed before it wrote their score."
    assert receipts.verify(path) == ([], [line], [])
    write(*ended)
    assert receipts.verify(path).word == "agrees"
    write(*begun)
    records = tmp_path / "episodes.jsonl"
    other = replace(EpisodeRecord.from_json(records.read_text()), max_steps=9)
    records.write_text(other.to_json() + "\n")
    assert receipts.verify(path).word == "differs", "the settings are compared as of any other"


def test_tasks_that_are_not_here_are_not_compared(finished: Path) -> None:
    rewrite_records(finished, task="NoTaskOfThisName")
    result = receipts.verify(finished)
    assert result.word == "not compared" and "NoTaskOfThisName" in result.not_compared[0]


# Records that contradict their settings, and other scenes -----------------------------------------


def test_a_changed_file_of_scenes_is_noticed_without_building_any(
    finished: Path, tmp_path: Path
) -> None:
    scenes = tmp_path / "scenes.jsonl"
    scenes.write_text("{}\n")
    rewrite(finished, lambda content: content["settings"].update(split=str(scenes)))
    rewrite_records(finished)
    assert not differing(finished, "scenes")
    scenes.write_text("{ }\n")
    assert differing(finished, "scenes")


def differing(path: Path, name: str) -> bool:
    lines = receipts.verify(path, build=False).differences
    return any(line.startswith(f"{name}:") for line in lines)


def test_another_scene_of_the_same_seed_is_noticed(finished: Path) -> None:
    """Records, receipt and digests fit each other: only building the scene tells that it was
    another.
    """
    rewrite_records(finished, scene="0123456789abcdef")
    result = receipts.verify(finished)
    assert result.word == "differs"
    assert [line.split(":")[0] for line in result.differences] == ["scene VideoUnmask 0"]
    rewrite(finished, lambda content: content.update(scene_digests={}))
    assert any(line.startswith("scene_digests") for line in receipts.verify(finished).differences)


@pytest.mark.parametrize(
    "fields, name",
    [
        ({"model": "another"}, "model"),
        ({"model_seed": 43}, "model_seed"),
        ({"max_steps": 9999}, "max_steps"),
        ({"steps": 5000}, "steps"),
        ({"checkpoint": 7}, "checkpoint"),
        ({"event": "pause:64"}, "event"),
        ({"subgoal": "oracle"}, "subgoal"),
        ({"env": "another"}, "env"),
        ({"training": TrainingIdentity(1, "r", "d", "w")}, "training"),
    ],
    ids=str,
)
def test_records_of_other_settings_are_noticed(
    fields: dict[str, Any], name: str, finished: Path
) -> None:
    rewrite_records(finished, **fields)
    assert [line.split(":")[0] for line in receipts.verify(finished).differences] == [
        f"records.{name}"
    ]


@pytest.mark.parametrize(
    "key, value", [("seed", 43), ("max_steps", 1200), ("model", "another"), ("split", "val")]
)
@pytest.mark.parametrize("with_run", [True, False])
def test_settings_that_were_changed_everywhere_but_in_the_records_are_noticed(
    key: str, value: Any, with_run: bool, finished: Path
) -> None:
    beside = finished.with_name("run.json")
    for path in (finished, beside):
        rewrite(path, lambda content: content["settings"].update({key: value}))
    if not with_run:
        beside.unlink()
    field = {"seed": "model_seed"}.get(key, key)
    assert f"records.{field}" in [
        line.split(":")[0] for line in receipts.verify(finished).differences
    ]


def test_records_of_two_policies_in_one_run_are_noticed(checkpoint: Path, tmp_path: Path) -> None:
    path = run(tmp_path, checkpoint, range(2))
    records = tmp_path / "episodes.jsonl"
    one, other = map(EpisodeRecord.from_json, records.read_text().splitlines())
    lines = [one.to_json(), replace(other, composition="another").to_json()]
    records.write_text("".join(line + "\n" for line in lines))
    differences = receipts.verify(path, build=False).differences
    assert any(line.startswith("records.composition: ") for line in differences)


def test_the_time_that_events_hold_the_robot_is_added_to_the_limit(finished: Path) -> None:
    for path in (finished, finished.with_name("run.json")):
        rewrite(path, lambda content: content["settings"].update(event="pause:100"))
    rewrite_records(finished, event="pause:100", steps=1402)
    assert receipts.verify(finished).differences == []
    rewrite_records(finished, event="pause:100", steps=1403)
    assert [line.split(":")[0] for line in receipts.verify(finished).differences] == [
        "records.steps"
    ]


def test_a_file_beside_those_that_were_loaded_is_noticed(
    finished: Path, checkpoint: Path, tmp_path: Path
) -> None:
    copy = shutil.copytree(checkpoint, tmp_path / "copy")
    (copy / "notes.md").write_text("not read")
    assert receipts.verify(finished, copy).word == "agrees"
    (copy / "model.safetensors.index.json").write_text("{}")
    differences = receipts.verify(finished, copy).differences
    assert (
        len(differences) == 1
        and "model.safetensors.index.json: None in the receipt" in differences[0]
    )


@pytest.mark.parametrize("change", [
    lambda c: first(c)["checkpoint"]["files"].update({"../../secret": "0"}),
    lambda c: first(c)["checkpoint"]["files"].update({"/etc/passwd": "0"}),
    lambda c: c["records"].update(file="/etc/passwd"),
    lambda c: c["records"].update(file="../episodes.jsonl"),
])  # fmt: skip
def test_names_that_lead_outside_are_refused(
    change: Callable[[dict[str, Any]], None], finished: Path
) -> None:
    rewrite(finished, change)
    with pytest.raises(UserError, match="lies outside of it"):
        receipts.verify(finished)


@pytest.mark.parametrize(
    "change",
    [
        lambda c: c.update(conditions="abc"),
        lambda c: c.update(conditions=[1]),
        lambda c: c.update(settings=[]),
        lambda c: c.update(records="x"),
        lambda c: c.update(score=5),
        lambda c: c.update(settings=None),
        lambda c: c["settings"].update(event=5),
        lambda c: c["settings"].update(env=["mme_vla"]),
        lambda c: c["settings"].update(max_steps="1300"),
        lambda c: c["settings"].update(subgoal="oracle"),
        lambda c: c["records"].update(file=5),
        lambda c: c.update(scenes=5),
        lambda c: first(c).update(hardware="x"),
        lambda c: first(c)["checkpoint"].update(folder=5),
        lambda c: first(c)["checkpoint"].update(files=["x"]),
    ],
)
def test_parts_of_another_kind_are_refused(
    change: Callable[[dict[str, Any]], None], finished: Path
) -> None:
    rewrite(finished, change)
    with pytest.raises(UserError, match="is no receipt of an evaluation"):
        receipts.verify(finished)


def test_records_of_several_streams_are_read_whole(checkpoint: Path, tmp_path: Path) -> None:
    path = run(tmp_path, checkpoint, range(2))
    records = tmp_path / "episodes.jsonl"
    parts = records.read_bytes().splitlines(keepends=True)
    records.with_name("episodes.jsonl.xz").write_bytes(b"".join(map(lzma.compress, parts)))
    records.unlink()
    assert receipts.verify(path) == ([], [], [])


# The code -----------------------------------------------------------------------------------------


def test_the_code_that_can_change_a_result_is_named_by_git_and_no_source_is_read(
    checkpoint: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(receipts, "file_sum", lambda path: pytest.fail(f"{path} was read"))
    root = Path(receipts.__file__).parents[1]
    assert all((root / part).is_dir() for part in receipts.CODE), "a package was moved"
    names = NAMES_OF_CODE(frozenset({*receipts.CODE, "extras/nano"}))
    assert set(names) <= {f"git {folder}" for folder in (*receipts.CODE, "extras/nano")}
    assert all(re.fullmatch(r"[0-9a-f]{40}(\+[0-9a-f]{12})?", name) for name in names.values())
    assert receipts._extras_of(quick_policy("framesamp_modul")) == set()
    assert receipts._extras_of(nano()) == {"extras/nano"}


def test_the_content_of_a_new_file_is_part_of_the_codes_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    package = tmp_path / "mme_vla"
    (package / "memory").mkdir(parents=True)
    (package / "evaluation").mkdir()
    (package / "memory" / "old.py").write_text("old = 1\n")
    git = ["git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=a@b.example"]
    for words in (["init", "-q"], ["add", "."], ["commit", "-qm", "a"]):
        subprocess.run([*git, *words], check=True)
    monkeypatch.setattr(receipts, "__file__", str(package / "evaluation" / "receipts.py"))
    names = [NAMES_OF_CODE(frozenset({"memory"}))["git memory"]]
    for content in ("new = 1\n", "new = 2\n"):
        (package / "memory" / "new.py").write_text(content)
        names.append(NAMES_OF_CODE(frozenset({"memory"}))["git memory"])
    assert len(set(names)) == 3


def test_digests_of_the_code_that_earlier_versions_wrote_are_not_compared(finished: Path) -> None:
    earlier = {"mme-vla": first(receipts.read_receipt(finished))["code"]["mme-vla"]}
    for code in ({"files": "0" * 64}, {"memory": "0" * 64}):
        rewrite(finished, lambda content, code=code: first(content).update(code=earlier | code))
        result = receipts.verify(finished)
        assert result.word == "not compared"
        assert any(line.startswith("code.git memory: ") for line in result.not_compared)
