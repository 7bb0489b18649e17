"""A receipt agrees with the run it is of, and names what differs from it."""

import json
import lzma
import shutil
from pathlib import Path

import pytest

from helpers.rollout_fakes import quick_policy
from mme_vla import UserError
from mme_vla.cli.results import main
from mme_vla.envs.base import environment
from mme_vla.evaluation import receipts
from mme_vla.evaluation.records import EpisodeRecord
from mme_vla.evaluation.rollout.evaluation import checkpoint_label, facts_of, run_settings
from mme_vla.evaluation.rollout.settings import RolloutSettings
from mme_vla.evaluation.store import RecordLog, claim_run, fingerprint
from mme_vla.policy.base import Policy


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("policy") / "step_000003"
    quick_policy("framesamp_modul").save_pretrained(folder)
    return folder


def run(folder: Path, checkpoint: Path, episodes: range = range(3), execute: int | None = None) -> Path:
    """Records of these episodes, every second one solved, with their receipt."""
    policy = Policy.from_pretrained(checkpoint)
    settings = RolloutSettings(execute=execute)
    facts = facts_of(policy, None, str(checkpoint), settings, None)
    claimed = claim_run(folder, run_settings(policy, facts, settings, None, str(checkpoint)))
    path = folder / "episodes.jsonl"
    with RecordLog(path) as log, receipts.receipt(path, policy, claimed, str(checkpoint), renders=False):
        for number in episodes:
            spec = environment("mme_vla").episode("VideoUnmask", "test", number)
            outcome = "success" if number % 2 else "fail"
            log.append(
                EpisodeRecord(
                    facts.model, checkpoint_label(str(checkpoint)), 42, spec.task, number, spec.seed, spec.difficulty,
                    outcome, 9,
                )
            )  # fmt: skip
    return folder / "receipt.json"


def test_a_receipt_agrees_with_its_run(checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = run(tmp_path, checkpoint)
    assert receipts.verify(path) == ([], [])
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
    assert receipts.verify(path) == ([], []), "as records are published"


@pytest.mark.parametrize("name", ["model.safetensors", "norm_stats.json"])
def test_a_changed_byte_of_a_checkpoint_is_named(name: str, checkpoint: Path, tmp_path: Path) -> None:
    path = run(tmp_path / "run", checkpoint)
    copy = shutil.copytree(checkpoint, tmp_path / "copy")
    content = bytearray((copy / name).read_bytes())
    content[-1] ^= 1 if name == "model.safetensors" else ord("\n") ^ ord(" ")
    (copy / name).write_bytes(content)
    differences, _ = receipts.verify(path, copy)
    assert len(differences) == 1 and differences[0].startswith(f"checkpoint.{name}: ")


def test_another_simulator_is_named(
    checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = run(tmp_path, checkpoint)
    installed = receipts.version
    monkeypatch.setattr(receipts, "version", lambda name: "0.0.1" if name == "sapien" else installed(name))
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
    differences, _ = receipts.verify(other)
    assert "settings.execute: 16 in the receipt, 8 here" in differences


def test_changed_records_scenes_and_receipts_are_named(checkpoint: Path, tmp_path: Path) -> None:
    path = run(tmp_path, checkpoint)
    records = tmp_path / "episodes.jsonl"
    lines = records.read_text().splitlines()
    first = EpisodeRecord.from_json(lines[0])
    changed = {**json.loads(lines[0]), "outcome": "success", "seed": first.seed + 1}
    changed.pop("crc32")
    records.write_text("\n".join([json.dumps(changed), *lines[1:]]) + "\n")
    differences, _ = receipts.verify(path)
    starts = [line.split(":")[0] for line in differences]
    assert {"records.sha256", "score.VideoUnmask.success", "scenes", "scene VideoUnmask 0"} <= set(starts)
    other = tmp_path / "receipt-of-something-else.json"
    other.write_text(json.dumps({"settings": {}}))
    with pytest.raises(UserError, match="is no receipt of an evaluation: it has no conditions, records"):
        receipts.verify(other)
    path.write_text(path.read_text().replace('"success": 1', '"success": 3'))
    with pytest.raises(UserError, match="is not what was written"):
        receipts.verify(path)


def test_scenes_of_an_environment_that_is_not_here_are_a_note(checkpoint: Path, tmp_path: Path) -> None:
    path = run(tmp_path, checkpoint)
    for name in ("receipt.json", "run.json"):
        content = json.loads((tmp_path / name).read_text())
        content.pop("crc32")
        content["settings"]["env"] = "of_a_plugin"
        if name == "run.json":
            content["fingerprint"] = fingerprint(content["settings"])
        (tmp_path / name).write_text(json.dumps(content))
    differences, notes = receipts.verify(path)
    assert not differences and any(note.startswith("scenes: not compared") for note in notes)
