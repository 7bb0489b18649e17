"""A predictor in a whole run: what `run.json` keeps of it, where it runs, what is told of it at the
end.
"""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from helpers.rollout_fakes import FACTS, JOBS, quick_policy, records
from mme_vla import UserError
from mme_vla.cli.evaluate import choose_subgoals, report, report_usage
from mme_vla.evaluation.records import EpisodeRecord
from mme_vla.evaluation.rollout.evaluation import EvaluationRun, predictor_of, run_settings
from mme_vla.evaluation.rollout.settings import RolloutSettings
from mme_vla.subgoal import BackgroundPredictor, Oracle, Usage, build_predictor


def facts_of(predictor) -> dict:
    return run_settings(quick_policy("simplesg"), FACTS, RolloutSettings(), predictor)["subgoal"]


def test_whatever_decides_what_a_predictor_says_belongs_to_the_run() -> None:
    base = {
        "name": "gemini",
        "client": object(),
        "model": "a",
        "wait": 75,
        "temperature": 0.0,
        "interval": 48,
    }
    facts = facts_of(build_predictor(base))
    assert facts["model"] == "a" and "client" not in facts
    for change in (
        {"model": "b"},
        {"wait": 0},
        {"temperature": 1.0},
        {"interval": 16},
        {"kind": "simple"},
    ):
        assert facts_of(build_predictor({**base, **change})) != facts, change
    other = {
        "workers": 1,
        "cache": "c",
        "key_variable": "K",
        "timeout": 5.0,
        "retries": 0,
        "base_url": "http://127.0.0.1/v1",
    }
    assert facts_of(build_predictor({**base, **other})) == facts
    background = BackgroundPredictor(build_predictor(base))
    assert facts_of(background) == {**facts, "mode": "background"}
    assert facts_of(Oracle()) == {"name": FACTS.subgoal, "kind": "grounded", "interval": 1}


def test_a_model_of_subgoals_is_known_by_the_end_of_its_path() -> None:
    oracle = Oracle()
    oracle.settings = {
        "adapter": "/here/outputs/subgoal/a/adapter",
        "model": "Qwen/Qwen3",
        "hold": True,
        "device": "x",
    }
    there = Oracle()
    there.settings = {
        "adapter": "outputs/subgoal/a/adapter",
        "model": "Qwen/Qwen3",
        "hold": True,
        "device": "cpu",
    }
    assert facts_of(oracle) == facts_of(there)
    there.settings["adapter"] = "outputs/subgoal/b/adapter"
    assert facts_of(oracle) != facts_of(there)


def test_a_checkpoint_saved_as_text_is_the_same_number(tmp_path: Path) -> None:
    facts = FACTS.__class__("tiny", "80000", 42)
    record = EpisodeRecord("tiny", 80000, 42, "PickXtimes", 0, 1, "easy", "success", 5)
    (tmp_path / "episodes.jsonl").write_text(record.to_json() + "\n")
    run = EvaluationRun(quick_policy("pi05"), JOBS[:1], tmp_path, facts, RolloutSettings())
    assert run._records() == [record]


def test_subgoals_and_policies_must_go_together(caplog: pytest.LogCaptureFixture) -> None:
    oracle = {"name": "oracle", "kind": "grounded", "interval": 1}
    assert choose_subgoals(quick_policy("simplesg"), oracle).kind == "simple", (
        "the policy's own kind"
    )
    with pytest.raises(UserError, match="reads no subgoal"):
        choose_subgoals(quick_policy("pi05"), oracle)
    assert choose_subgoals(quick_policy("simplesg"), None) is None
    assert [
        predictor_of(quick_policy(name), "oracle").kind for name in ("simplesg", "groundsg")
    ] == [
        "simple",
        "grounded",
    ], "a name in Python"
    assert "plain prompt" in caplog.text


def test_a_predictor_on_auto_runs_on_the_policys_device(monkeypatch: pytest.MonkeyPatch) -> None:
    import mme_vla.cli.evaluate as module

    devices = []
    monkeypatch.setattr(
        module,
        "build_predictor",
        lambda section: devices.append(section["device"]) or Oracle("simple"),
    )
    for name in ("auto", "cpu"):
        choose_subgoals(
            quick_policy("simplesg"),
            {"name": "qwenvl", "device": name},
            device=torch.device("cuda", 3),
        )
    assert devices == ["cuda:3", "cpu"]


def test_what_a_predictor_did_is_reported_in_one_line(caplog: pytest.LogCaptureFixture) -> None:
    usage = Usage(calls=1200, cached=2, input_tokens=34567)
    usage.problems["malformed"] = 3
    with caplog.at_level("INFO"):
        report_usage(Usage())
        assert caplog.text == ""
        report_usage(usage)
    assert caplog.messages == [
        "subgoals: 1,200 calls, 2 answers from the cache, 34,567 tokens read, 3 malformed answers"
    ]


def test_a_task_named_all_keeps_its_row_beside_that_of_all_episodes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    won, lost = records("test", [1, 0])
    done = SimpleNamespace(
        records=[replace(won, task="all"), replace(lost, task="other")],
        matched=[],
        workload=SimpleNamespace(batches=0),
        output=tmp_path,
    )
    report(done)  # type: ignore[arg-type]
    lines = [line for line in capsys.readouterr().out.splitlines() if " all " in line]
    assert ["100.0 %" in lines[0], "50.0 %" in lines[1], len(lines)] == [True, True, 2]


def test_a_run_ends_with_the_place_of_its_videos_and_the_next_command(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    done = SimpleNamespace(
        records=[], matched=[], workload=SimpleNamespace(batches=0), output=tmp_path
    )
    following = f"next: mme-vla results {tmp_path}"
    with caplog.at_level("INFO", "mme_vla.evaluate"):
        report(done)  # type: ignore[arg-type]
        assert caplog.messages == [following]
        (tmp_path / "videos").mkdir()
        (tmp_path / "videos" / "StopCube_ep0_success.mp4").touch()
        report(done)  # type: ignore[arg-type]
    assert caplog.messages[1:] == [f"videos: {tmp_path / 'videos'}", following]
