"""The command itself: killed in the middle and resumed, it continues exactly where it was."""

import io
import json
import shlex
import shutil
import signal
import subprocess
import time
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf

from helpers import commands
from mme_vla import MMEPolicy, UserError
from mme_vla.cli.train import main
from mme_vla.config.composition import compose
from mme_vla.processing.base import STATS_FILE
from mme_vla.processing.normalise import NormStats
from mme_vla.training.logging import read_metrics
from mme_vla.utils import write_sums

STEPS, SAVE_EVERY = 9, 4
SMALL = [
    "model=tokendrop_expert",
    "backbone.depth=1",
    "backbone.vision.depth=1",
    "backbone.vision.image_size=32",
    "backbone.vision.patch_size=2",
    "memory.budget=64",
    f"train.steps={STEPS}",
    f"train.save_every={SAVE_EVERY}",
    "train.log_every=1",
    "train.val_every=3",
    "train.val_samples=2",
    "train.batch_size=2",
    "train.open_loop_chunks=2",
    "train.device=cpu",
]


def start(cache: Path, *overrides: str) -> "subprocess.Popen[str]":
    words = ["mme_vla.train", *SMALL, f"data.cache.root={cache}", *overrides]
    return commands.start(*words, cwd=cache, env={"OMP_NUM_THREADS": str(torch.get_num_threads())})


def finish(process: "subprocess.Popen[str]") -> str:
    done = commands.finish(process)
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


def numbers(folder: Path) -> list[dict[str, Any]]:
    """What was logged, without what only tells time and memory."""
    return [
        {key: value for key, value in line.items() if not key.startswith(("speed/", "memory/"))}
        for line in read_metrics(folder)
    ]


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The runs `whole`, which nothing interrupts, and `killed`: the folder above them, and what the
    first printed.
    """
    base = tmp_path_factory.mktemp("runs")
    killed = start(base, "output=killed", "train.steps=500")
    deadline = time.monotonic() + 200
    while not any(line["step"] > SAVE_EVERY + 1 for line in read_metrics(base / "killed")):
        assert killed.poll() is None, commands.finish(killed).stderr[-3000:]
        assert time.monotonic() < deadline
        time.sleep(0.02)
    killed.kill()
    assert commands.finish(killed).returncode == -signal.SIGKILL
    printed = io.StringIO()
    with redirect_stdout(printed):
        # in this process, which has imported everything: the same numbers, sooner
        main(compose("train", [*SMALL, f"data.cache.root={base}", f"output={base / 'whole'}"]))
    return base, printed.getvalue()


@pytest.mark.slow
def test_a_killed_run_resumes_with_the_same_losses(runs: tuple[Path, str]) -> None:
    straight, killed = runs[0] / "whole", runs[0] / "killed"
    # The killed run may have come further than one checkpoint: continue from the first.
    for late in sorted((killed / "checkpoints").glob("step_*"))[1:]:
        late.rename(runs[0] / f"late_{late.name}")
    printed = finish(start(runs[0], f"resume={killed}", "output=unused"))
    assert f"continuing from {killed / 'checkpoints' / f'step_{SAVE_EVERY:06d}'}" in printed
    assert numbers(killed) == numbers(straight)
    assert not (runs[0] / "unused").exists()
    resumed_run, straight_run = (
        json.loads((folder / "summary.json").read_text()) for folder in (killed, straight)
    )
    assert resumed_run["open_loop"] == straight_run["open_loop"]


@pytest.mark.slow
def test_a_run_that_is_stopped_prints_the_command_that_continues_it(tmp_path: Path) -> None:
    stopped = start(tmp_path, "output=run one", "train.steps=500")
    deadline = time.monotonic() + 200
    while not read_metrics(tmp_path / "run one"):
        assert stopped.poll() is None and time.monotonic() < deadline
        time.sleep(0.02)
    stopped.send_signal(signal.SIGTERM)
    done = commands.finish(stopped)
    assert done.returncode == 128 + signal.SIGTERM, done.stderr[-3000:]
    step = int(done.stdout.split("Stopped at step ")[1].split()[0])
    command, *words = shlex.split(done.stdout.splitlines()[-1])
    assert (command, words[0], words[-1]) == ("mme-vla", "train", f"resume={tmp_path / 'run one'}")
    printed = finish(commands.start("mme_vla", *words, f"train.steps={step + 1}", cwd=tmp_path))
    assert f"continuing from {tmp_path / 'run one' / 'checkpoints'}" in printed


@pytest.mark.slow
def test_a_resumed_run_names_the_weights_that_it_began_with(runs: tuple[Path, str]) -> None:
    base = runs[0]
    words = [*SMALL, f"data.cache.root={base}", "train.save_every=1", f"output={base / 'tuned'}"]
    main(compose("train", [*words, "train.steps=1", f"init_from={base / 'whole'}"]))
    main(compose("train", [*words, "train.steps=2", f"resume={base / 'tuned'}"]))
    assert OmegaConf.load(base / "tuned" / "config.yaml")["init_from"] == str(base / "whole")


@pytest.mark.slow
def test_a_run_keeps_its_statistics_and_stays_the_same_training(tmp_path: Path) -> None:
    others = ("model=", "memory.", "train.steps=", "train.save_every=")
    small = ["model=pi05", *(word for word in SMALL if not word.startswith(others))]
    small += ["train.save_every=1", "train.steps=2", "train.keep.last=2"]
    folder = tmp_path / "run"
    main(compose("train", [*small, f"output={folder}"]))
    first, second = (folder / "checkpoints" / f"step_00000{i}" for i in (1, 2))
    shutil.rmtree(second)
    stats = NormStats.load(first / STATS_FILE)
    stats.actions.q01[0], stats.actions.q99[0] = -1e-6, 1e-6
    stats.save(first / STATS_FILE)
    write_sums(first, [STATS_FILE], keep=True)
    main(compose("train", [*small, f"resume={folder}", "data.narrow_ranges=warn"]))
    assert OmegaConf.load(folder / "config.yaml")["data"]["narrow_ranges"] is None
    identities = [
        json.loads((place / "config.json").read_text())["training"] for place in (first, second)
    ]
    assert identities[0] == identities[1]
    assert NormStats.load(second / STATS_FILE).actions.q99[0] == 1e-6


@pytest.mark.slow
def test_a_finished_run_holds_everything(runs: tuple[Path, str]) -> None:
    folder, printed = runs[0] / "whole", runs[1]
    checkpoint = folder / "checkpoints" / f"step_{STEPS:06d}"
    assert checkpoint.name in printed
    assert "joint 1" in printed
    assert (folder / "open_loop.png").stat().st_size > 20_000
    assert list((folder / "tensorboard").glob("events*"))
    assert (folder / "config.yaml").is_file()
    lines = read_metrics(folder)
    assert [line["step"] for line in lines if "train/loss" in line] == list(range(1, STEPS + 1))
    assert [line["step"] for line in lines if "val/loss" in line] == [3, 6, 9]
    assert MMEPolicy.from_pretrained(checkpoint).require_processor().stats is not None


@pytest.mark.slow
@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["output=whole"], "never overwritten"),
        (["resume=whole", "train.steps=20", "train.lr=0.5"], r"train\.lr: 0.003 then, 0.5 now"),
        (["resume=nowhere"], "No checkpoint at nowhere"),
        (
            ["output=new", "train.batch_size=3", "train.accumulate=2"],
            r"multiple of train\.accumulate=2",
        ),
        (["output=new", "train.batch_size=4000"], r"fewer than train\.batch_size=4000"),
        (["output=new", "data.sources=[missing]"], "No LeRobot dataset at 'missing'"),
        (["output=new", "init_from=nowhere"], "No checkpoint at nowhere"),
    ],
)
def test_what_cannot_work_is_refused_before_training(
    runs: tuple[Path, str], monkeypatch: pytest.MonkeyPatch, overrides: list[str], message: str
) -> None:
    base, before = runs[0], numbers(runs[0] / "whole")
    monkeypatch.chdir(base)
    with pytest.raises(UserError, match=message):
        main(compose("train", [*SMALL, f"data.cache.root={base}", *overrides]))
    assert numbers(base / "whole") == before
    assert not (base / "new").exists()
