"""examples/blink and examples/pick_cube: environments of the user's own in every command, in fresh
processes.
"""

import json
from pathlib import Path

import numpy as np
import pytest

from helpers import REPOSITORY
from helpers.tried_env import SMALL, run, served_chunk, try_commands
from mme_vla.cli.results import main as results
from mme_vla.config.plugins import import_plugins
from mme_vla.evaluation.store import find_records, read_folders
from mme_vla.utils import read_json

BLINK = ("env=blink", "plugins=[blink]")


def variables_of(example: str) -> dict[str, str]:
    """Of processes that find the example's module."""
    return {
        "PYTHONPATH": f"{REPOSITORY}:{REPOSITORY / 'examples' / example}",
        "OMP_NUM_THREADS": "1",
    }


def test_the_example_is_the_one_on_the_page() -> None:
    text = (REPOSITORY / "examples" / "blink" / "blink.py").read_text()
    assert text.strip() in (REPOSITORY / "docs" / "extend" / "environments.md").read_text()


@pytest.mark.nightly
def test_an_environment_of_ones_own_works_in_every_command(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    records = try_commands(tmp_path, variables_of("blink"), BLINK, "tasks=all", "player=random")
    assert [(r.task, r.episode, r.seed, r.env, r.video_frames) for r in records] == [
        ("Blink", 0, 500_000, "blink", 4),
        ("Blink", 1, 500_001, "blink", 4),
    ]
    assert read_json(tmp_path / "data" / "meta" / "info.json", "a dataset")["total_episodes"] == 2
    (saved,) = (tmp_path / "run").rglob("step_000002/config.json")
    assert json.loads(saved.read_text())["embodiment"]["name"] == "blink"
    results([str(tmp_path / "evaluated")])  # this process does not know the environment
    assert "0.0 % of 2 episodes of Blink" in capsys.readouterr().out


@pytest.mark.slow
def test_a_policy_of_an_environment_of_ones_own_is_served(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip(
        "websockets", reason="the server's packages are not installed: the extra `serve` has them"
    )
    monkeypatch.syspath_prepend(REPOSITORY / "examples" / "blink")
    import_plugins(["blink"])
    words = (*BLINK, "model=framesamp_modul", *SMALL)
    chunk = served_chunk(tmp_path, variables_of("blink"), words, "blink", "Blink")
    assert chunk.shape == (4, 1) and np.isfinite(chunk).all()


@pytest.mark.nightly
@pytest.mark.usefixtures("renderer")
def test_maniskills_pick_cube_is_recorded_trained_and_evaluated(tmp_path: Path) -> None:
    words = ("env=pick_cube", "plugins=[pick_cube]")
    variables = variables_of("pick_cube")
    out = run(tmp_path, variables, "record", *words, "tasks=all", "episodes=2", "output=data")
    assert "2 episodes" in out and "0 did not succeed" in out
    run(
        tmp_path,
        variables,
        "train",
        *words,
        "data.sources=[data]",
        "model=pi05",
        "backbone=nano",
        "train=nano",
        "train.steps=2",
        "train.save_every=2",
        "train.val_samples=0",
        "train.batch_size=4",
        "logger=none",
        "output=run",
    )
    run(
        tmp_path,
        variables,
        "evaluate",
        *words,
        "checkpoint=run/checkpoints/step_000002",
        "--trust-plugins",
        "tasks=all",
        "episodes=1",
        "workers=1",
        "max_steps=4",
        "output=evaluated",
    )
    (record,) = read_folders(find_records([tmp_path / "evaluated"]))
    assert (record.task, record.env, record.steps) == ("PickCube-v1", "pick_cube", 4)
