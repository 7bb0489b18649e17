"""Files that an earlier version wrote are still read, and still mean the same.

`scripts/make_compatibility_files.py` wrote them. Everything is opened through `mme_vla` and the
published commands, so that modules may move. Files that cannot be read any more are not to be
written again: users have such files too.
"""

import json
import shutil
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from safetensors.torch import load_file

import mme_vla
from helpers import REPOSITORY

pytestmark = pytest.mark.filterwarnings("ignore")
FOLDER = Path("tests", "data", "compatibility")
EXPECTED = json.loads((REPOSITORY / FOLDER / "expected.json").read_text())
TOLERANCE = 1e-5


@pytest.fixture(autouse=True)
def in_the_repository(monkeypatch: pytest.MonkeyPatch) -> None:
    """Paths of the folder are relative to the repository: runs keep the end of their checkpoint's
    path.
    """
    monkeypatch.chdir(REPOSITORY)
    monkeypatch.syspath_prepend(REPOSITORY / "scripts")


def contents(folder: Path) -> dict[str, bytes]:
    """All files below a folder but locks."""
    files = [
        path
        for path in sorted(folder.rglob("*"))
        if path.is_file() and not path.name.startswith(".")
    ]
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def copied(place: str, target: Path) -> Path:
    shutil.copytree(FOLDER / place, target)
    return target


def assert_rows_equal(rows: list[dict[str, str]], expected: list[dict[str, str]]) -> None:
    """Rows of a table: numbers within the tolerance, all else the same."""
    assert len(rows) == len(expected)
    for row, required in zip(rows, expected, strict=True):
        for key, value in required.items():
            try:
                assert float(row[key]) == pytest.approx(float(value), abs=1e-3), (key, required)
            except ValueError:
                assert row[key] == value, (key, required)


@pytest.mark.parametrize(
    "place", [name for name in EXPECTED["actions"] if not name.startswith("names/")]
)
def test_checkpoint_loads_and_acts_as_before(place: str) -> None:
    from make_compatibility_files import actions

    policy = mme_vla.Policy.from_pretrained(FOLDER / place)
    np.testing.assert_allclose(
        actions(policy), EXPECTED["actions"][place], atol=TOLERANCE, rtol=TOLERANCE
    )


@pytest.mark.parametrize(
    "place", [name for name in EXPECTED["actions"] if name.startswith("names/")]
)
def test_checkpoint_with_generated_weights_acts_as_before(place: str, tmp_path: Path) -> None:
    from make_compatibility_files import actions, load_named

    policy = load_named(FOLDER / place, tmp_path)
    chunks = actions(policy, depth=place.endswith("sam2act_plus"))
    np.testing.assert_allclose(
        chunks, EXPECTED["actions"][place], atol=10 * TOLERANCE, rtol=10 * TOLERANCE
    )


def test_vision_tower_of_nano_is_the_same() -> None:
    from make_compatibility_files import nano_tower

    assert nano_tower() == EXPECTED["nano_tower"]


@pytest.mark.parametrize("name", EXPECTED["losses"])
def test_training_resumes_with_the_same_losses_and_the_same_cache(
    name: str, tmp_path: Path
) -> None:
    from make_compatibility_files import resumed_losses

    losses = resumed_losses(FOLDER, name, EXPECTED["words"][name], tmp_path)
    assert losses == pytest.approx(EXPECTED["losses"][name], rel=TOLERANCE)
    assert contents(tmp_path / "cache") == contents(FOLDER / "cache"), (
        "the vision cache was computed again"
    )


def test_cache_command_finds_every_episode(tmp_path: Path) -> None:
    from make_compatibility_files import command, places

    cache = copied("cache", tmp_path / "cache")
    selection = [
        word
        for word in EXPECTED["words"]["framesamp"]
        if word.startswith(("model=", "backbone.", "memory."))
    ]
    start = f"init_from={FOLDER / 'training' / 'framesamp'}"
    assert ": 0 episodes encoded, 2 in all" in command(
        "cache", *selection, "data=lerobot", *places(FOLDER, cache), start
    )


@pytest.mark.parametrize("dataset", ["dataset", "dataset_video"])
def test_dataset_is_intact_and_begins_where_it_began(dataset: str) -> None:
    from make_compatibility_files import dataset_figures

    assert dataset_figures(FOLDER, dataset) == EXPECTED["datasets"][dataset]


@pytest.mark.parametrize("format", ["lerobot", "openpi", "released"])
def test_export_converts_back_to_the_same_weights(format: str, tmp_path: Path) -> None:
    if format == "released":
        pytest.importorskip("tensorstore", reason="needs the extra orbax")
    from make_compatibility_files import command

    source = FOLDER / "pretrained" / "pi05_past_actions"
    command("weights", FOLDER / "exports" / format, tmp_path / "ours", *EXPECTED["export_words"])
    tensors, expected = (
        load_file(folder / "model.safetensors") for folder in (tmp_path / "ours", source)
    )
    assert tensors.keys() == expected.keys()
    for name, tensor in expected.items():
        assert tensor.equal(tensors[name]), name


@pytest.mark.parametrize("name", EXPECTED["results"])
def test_results_have_the_same_figures(name: str, tmp_path: Path) -> None:
    from make_compatibility_files import FINISHED, result_rows

    assert_rows_equal(
        result_rows(FOLDER / "evaluation" / name, FINISHED[name], tmp_path),
        EXPECTED["results"][name],
    )


def test_finished_run_is_recognised_from_python(tmp_path: Path) -> None:
    from make_compatibility_files import evaluate_scripted

    run = copied("evaluation/scripted", tmp_path / "run")
    before = contents(run)
    assert evaluate_scripted(FOLDER, run).success_rate == EXPECTED["success_rate"]
    assert contents(run) == before


@pytest.mark.skipif(
    find_spec("mani_skill") is None, reason="needs the simulator: uv sync --inexact --extra sim"
)
@pytest.mark.parametrize("name", EXPECTED["evaluations"])
def test_finished_run_is_recognised_by_the_command(name: str, tmp_path: Path) -> None:
    from make_compatibility_files import command

    run = copied(f"evaluation/{name}", tmp_path / "run")
    before = contents(run)
    command("evaluate", *EXPECTED["evaluations"][name], f"output={run}")
    after = contents(run)
    if "claims.jsonl" in after:  # the process joined the run
        assert after.pop("claims.jsonl").startswith(before.pop("claims.jsonl"))
    assert after == before


def test_probe_has_the_same_table_and_is_recognised(tmp_path: Path) -> None:
    from make_compatibility_files import probe, probe_figures

    assert probe_figures(FOLDER / "probe") == EXPECTED["probe"]
    folder = copied("probe", tmp_path / "probe")
    probe(FOLDER, folder)
    lines = Path("offline", "offline.jsonl")
    assert (folder / lines).read_bytes() == (FOLDER / "probe" / lines).read_bytes()


@pytest.mark.parametrize("name", EXPECTED["losses"])
def test_run_is_inspected(name: str) -> None:
    from make_compatibility_files import command

    printed = command("inspect", f"checkpoint={FOLDER / 'training' / name}")
    assert "step_000002" in printed
