"""What an earlier version recorded is still read, computed and answered: `tests/net/record.py`
wrote `tests/data/net`.

Everything goes through `mme_vla`, `mme_vla.testing` and the commands, so that modules may move.
"""

import json
import lzma
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mme_vla
from helpers import REPOSITORY
from mme_vla.config.trees import library_files
from net import formats, models, replies, runs, times
from net.archives import command, unpack

pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]
NET = REPOSITORY / "tests" / "data" / "net"
TOLERANCE = 1e-5
HISTORY_TOLERANCE = 1e-3
"""Of the actions of a policy with memory. Stored history tokens and RMT's attention are bfloat16:
where another CPU rounds one of them to its neighbour, actions move by about 1e-4.
"""
NEEDS = {
    "diffusion_policy": ("diffusers", "baselines"),
    "memoryvla": ("transformers", "baselines"),
    "openvla": ("transformers", "baselines"),
    "sam2act_plus": ("transformers", "baselines"),
    "simplememvla": ("transformers", "vlm"),
    "lora": ("peft", "vlm"),
    "serve": ("uvicorn", "serve"),
    "harness": ("vla_eval", "harness"),
    "released": ("tensorstore", "orbax"),
    "evaluate": ("mani_skill", "sim"),
    "probe": ("mani_skill", "sim"),
    "simulator": ("mani_skill", "sim"),
}
"""Beginning of the name of a model, run, command or format → a module that it needs, and the extra
that brings it.
"""


def skip_without_extra(name: str) -> None:
    """Skip a test whose extra the environment lacks."""
    for start, (module, extra) in NEEDS.items():
        if name.startswith(start):
            reason = f"{name} needs the extra {extra}: pip install 'mme-vla[{extra}]'"
            pytest.importorskip(module, reason=reason)


def read(name: str) -> Any:
    """A recorded JSON file."""
    data = (NET / name).read_bytes()
    return json.loads(lzma.decompress(data) if name.endswith(".xz") else data)


MODELS, REPLIES, RUNS, FORMATS, TIMES = (read(f"{name}.json{end}") for name, end in (
    ("models", ".xz"), ("replies", ""), ("runs", ".xz"), ("formats", ""), ("times", ""),
))  # fmt: skip


@pytest.fixture(scope="session")
def checkpoints(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The saved policies, by the names of their models."""
    return unpack(NET / "models.tar.xz", tmp_path_factory.mktemp("models"))


@pytest.mark.parametrize("model", MODELS)
def test_saved_policy_gives_the_same_loss_and_actions(
    model: str, checkpoints: Path, tmp_path: Path
) -> None:
    skip_without_extra(model)
    folder = shutil.copytree(checkpoints / model, tmp_path / model)
    models.restore(folder)
    policy = mme_vla.Policy.from_pretrained(folder)
    figures = models.figures(policy)
    (folder / "model.safetensors").unlink()  # as large as 45 MB
    if MODELS[model]["loss"] is not None:  # else a run records it, below
        assert figures["loss"] == pytest.approx(MODELS[model]["loss"], rel=TOLERANCE)
    assert_same_actions(policy, figures["actions"], MODELS[model]["actions"])


def assert_same_actions(policy: mme_vla.Policy, actual: Any, expected: Any) -> None:
    """Equal actions, to the tolerance of what the policy stores."""
    tolerance = TOLERANCE if policy.memory is None else HISTORY_TOLERANCE
    np.testing.assert_allclose(actual, expected, rtol=tolerance, atol=tolerance)


def test_every_model_has_a_saved_policy() -> None:
    assert set(library_files("model")) >= set(MODELS), "a model is gone"


# Replies


@pytest.fixture(scope="session")
def mistaken(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the files that the mistakes name."""
    return replies.prepare(tmp_path_factory.mktemp("mistakes") / "here", NET / "models.tar.xz")


@pytest.mark.parametrize("line", REPLIES)
def test_reply_to_a_mistake_says_no_less(line: str, mistaken: Path) -> None:
    skip_without_extra(line)
    current = replies.reply(line, mistaken)
    changes = replies.difference(REPLIES[line]["text"], current["text"])
    assert current["code"] == REPLIES[line]["code"], changes
    assert not replies.missing(REPLIES[line], current["text"]), changes


# Datasets, runs and what was measured


@pytest.fixture
def at_runs(tmp_path: Path, checkpoints: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the recorded runs, as the current folder."""
    unpack(NET / "runs.tar.xz", tmp_path)
    shutil.copytree(checkpoints / runs.POLICY, tmp_path / "policy")
    models.restore(tmp_path / "policy")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def assert_close(actual: Any, expected: Any, place: str = "") -> None:
    """Equal structures, floats to the tolerance."""
    if isinstance(expected, dict):
        assert set(actual) >= set(expected), place
        for key in expected:
            assert_close(actual[key], expected[key], f"{place}.{key}")
    elif isinstance(expected, list):
        assert len(actual) == len(expected), place
        for number, (here, then) in enumerate(zip(actual, expected, strict=True)):
            assert_close(here, then, f"{place}[{number}]")
    elif isinstance(expected, float):
        assert actual == pytest.approx(expected, rel=TOLERANCE, abs=TOLERANCE), place
    else:
        assert actual == expected, place


@pytest.mark.parametrize("run", runs.RUNS)
def test_policy_of_a_run_acts_as_before(run: str, at_runs: Path) -> None:
    skip_without_extra(run)
    policy = mme_vla.Policy.from_pretrained(Path("training", run))
    assert_same_actions(policy, models.figures(policy)["actions"], RUNS["actions"][run])


def test_dataset_has_the_same_frames_goals_and_statistics(at_runs: Path) -> None:
    assert_close(runs.dataset(), RUNS["dataset"])


def test_cache_is_complete(at_runs: Path) -> None:
    assert runs.cached()


def contents(folder: Path) -> dict[Path, bytes]:
    """All files below a folder but locks."""
    files = [file for file in folder.rglob("[!.]*") if file.is_file()]
    return {file: file.read_bytes() for file in files}


@pytest.mark.parametrize("run", runs.RUNS)
def test_run_resumes_with_the_same_losses_and_keeps_the_vision_cache(
    run: str, at_runs: Path
) -> None:
    skip_without_extra(run)
    before = contents(Path("cache"))
    assert_close(runs.resume(run), RUNS["resumed"][run])
    assert contents(Path("cache")) == before


@pytest.mark.parametrize("model", RUNS["first_loss"])
def test_saved_policy_has_the_same_loss_on_the_dataset(
    model: str, at_runs: Path, checkpoints: Path
) -> None:
    skip_without_extra(model)
    shutil.copytree(checkpoints / model, "saved")
    models.restore(Path("saved"))
    assert_close(runs.first_loss(model, Path("saved")), RUNS["first_loss"][model])


def test_results_have_the_same_figures(at_runs: Path) -> None:
    assert_close(runs.result_rows(), RUNS["results"])


def test_finished_evaluation_is_recognised(at_runs: Path) -> None:
    skip_without_extra("simulator")
    before = contents(Path("evaluation"))
    command("evaluate", *runs.EVALUATE)
    assert contents(Path("evaluation")) == before


@pytest.mark.parametrize("run", runs.RUNS)
def test_run_is_inspected(run: str, at_runs: Path) -> None:
    skip_without_extra(run)
    assert "step_000002" in command("inspect", f"checkpoint=training/{run}")


def test_receipt_is_verified(at_runs: Path) -> None:
    assert not runs.verified()


def test_probe_has_the_same_table(at_runs: Path) -> None:
    assert runs.probed() == RUNS["probe"]


def test_finished_probe_is_not_measured_again(at_runs: Path) -> None:
    lines = Path("probe", "offline", "offline.jsonl")
    before = lines.read_bytes()
    command("probe", *runs.PROBE)
    assert lines.read_bytes() == before


@pytest.fixture
def at_earlier(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs of version 0.1.0, as the current folder."""
    monkeypatch.chdir(unpack(NET / "earlier.tar.xz", tmp_path))


def test_shards_with_claims_are_recognised_and_joined(at_earlier: None) -> None:
    skip_without_extra("simulator")
    before = contents(runs.SHARDS)
    command("evaluate", *runs.SHARD)
    after = contents(runs.SHARDS)
    claims = runs.SHARDS / "claims.jsonl"  # the process joined the run
    assert after.pop(claims, before[claims]).startswith(before.pop(claims))
    assert after == before
    figures = [",".join(row.values()) for row in runs.result_rows(runs.SHARDS)]
    assert any("average,0.0000,,0.0000,65.7620,1,1,2,2" in row for row in figures), figures


def test_finished_run_is_recognised_from_python(at_earlier: None) -> None:
    before = contents(runs.SCRIPTED)
    assert runs.evaluate_scripted().success_rate == 1.0
    assert contents(runs.SCRIPTED) == before


def test_report_card_is_the_same(at_runs: Path) -> None:
    skip_without_extra("simulator")
    card, recorded = runs.card(), RUNS["card"]
    assert set(card["notes"]) >= set(recorded["notes"])  # a later version may add one
    assert_close(card, {**recorded, "notes": card["notes"]})


def test_board_ranks_the_rows_as_before(at_runs: Path) -> None:
    assert runs.board() == RUNS["board"]


# Formats of others, and videos


@pytest.fixture
def at_formats(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A copy of the recorded exports and videos, as the current folder."""
    monkeypatch.chdir(unpack(NET / "formats.tar.xz", tmp_path))


@pytest.mark.parametrize("target", formats.FORMATS)
def test_export_converts_back_to_the_same_weights(target: str, at_formats: None) -> None:
    skip_without_extra(target)
    assert not formats.converted_back(target)


def test_dataset_of_videos_is_intact_and_begins_where_it_began(at_formats: None) -> None:
    assert formats.inspected() == FORMATS["inspected"]


def test_vision_tower_of_nano_is_the_same() -> None:
    assert formats.nano_tower() == FORMATS["nano_tower"]


@pytest.mark.parametrize("name", times.COMMANDS)
def test_no_more_modules_are_imported(name: str) -> None:
    measured = times.measure(times.COMMANDS[name])
    assert measured["modules"] <= 1.1 * TIMES[name]["modules"], "an import became heavier"
