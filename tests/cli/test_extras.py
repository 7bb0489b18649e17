"""Each extra suffices alone: every command runs where the packages of all other extras cannot be
imported.

Which packages those are follows from pyproject.toml and from what is installed. A command that
needs an extra names it, and the words that install it.
"""

import json
import subprocess
import sys
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from typing import NamedTuple

import pytest

from helpers import command_series
from helpers.h5_files import write_file
from helpers.installed import is_installed, modules_beyond, needs, without_modules
from helpers.tiers import slow_or_nightly
from mme_vla.cli import commands
from mme_vla.errors import UserError
from mme_vla.evaluation.store import find_records, read_folders

NEW = "uv sync --inexact --extra {}"
LONGEST = 1200
"""Seconds that the commands of one set of extras may take: less than the time limit of a test."""
NOT_FINISHED = -1
"""Exit code of a command whose process ended before it did."""


class Case(NamedTuple):
    """A command, the extras that are there, and how it ends: `says` is a text it prints."""

    extras: tuple[str, ...]
    words: str
    says: str
    code: int = 0
    wait: str = ""  # stop the command once it has printed this
    draws: bool = False  # it needs a Vulkan driver


TINY = "backbone.vision.depth=1 backbone.vision.image_size=16 backbone.vision.patch_size=1"
TRAIN = (
    f"mme_vla.train model=pi05 {TINY} train.steps=1 train.val_samples=1 train.open_loop_chunks=1"
)
PLAY = "mme_vla.play task=StopCube episodes=1 max_choices=1 output=played"
STEP = "run/checkpoints/step_000001"
NANO_WORDS = (
    "mme_vla.nano task=VideoUnmask model=framesamp_modul demonstrations.easy=2"
    " demonstrations.medium=0 demonstrations.hard=0 train.steps=20 train.batch_size=4"
    " train.val_every=10 episodes=2 max_steps=20 beside=[] also=[] rendered_for=[] output=nano"
)
NANO = Case(("sim",), NANO_WORDS, "page", draws=True)
"""The whole way of nanoMME, small: two demonstrations, twenty updates, two episodes."""

# In this order: some read what an earlier one wrote.
SUFFICE = [
    Case((), f"{TRAIN} output=run", "checkpoint"),
    Case((), "mme_vla.inspect dataset=sample episode=0 step=20", ".png"),
    Case((), f"mme_vla cache model=framesamp_modul {TINY} data.cache.root=kept", "frames"),
    Case(
        (),
        "mme_vla convert input=record_dataset_Alpha.h5 output=converted images=png",
        "2 episodes",
    ),
    Case((), "mme_vla exec-starts input=record_dataset_Alpha.h5 output=starts.json", "2 episodes"),
    Case((), f"mme_vla weights {STEP} lerobot --to lerobot", ""),
    Case((), "mme_vla subgoal-build input=sample output=rows sets=[simple]", "simple"),
    Case((), "mme_vla.results --demo --brief", "Made-up records"),
    Case((), "mme_vla.analyse selection --output kept.mp4 --every 128", "wrote kept.mp4"),
    Case((), "mme_vla train-tokenizer run", "tokenizer.model"),
    Case((), "mme_vla sample --help", "full"),
    Case(
        (),
        f"mme_vla.probe model=framesamp_modul backbone=tiny {TINY} recordings=sample recorded=1"
        " with=[shuffle] draws=2 moments=1 scan=false output=probed",
        "shuffle",
    ),
    Case(("docs",), "mme_vla docs --build --output site", "index.html"),
    Case(("serve",), "mme_vla.serve model=pi05 backbone=tiny port=0", "stopped", wait="ready at"),
    Case(("harness",), "mme_vla harness --help", "--args.flow_steps"),
    Case(("orbax",), f"mme_vla weights {STEP} jax --to released", ""),
    Case(
        ("baselines",),
        "mme_vla.train model=diffusion_policy train.steps=1 train.batch_size=1 train.val_samples=0 "
        "train.open_loop_chunks=0 output=diffused",
        "checkpoint",
    ),
    Case(
        ("viz",), "mme_vla.analyse selection --output seen.mp4 --every 64 --rerun seen.rrd", "seen"
    ),
    Case(
        ("vlm",),
        "mme_vla subgoal-train rows=rows/simple.jsonl vlm=tiny output=tuned steps=1 workers=0"
        " device=cpu batch=1 per_device_batch=1 gradient_checkpointing=false",
        "",
    ),
    Case(
        ("sweep",),
        "mme_vla.evaluate model=pi05 launcher=joblib --cfg hydra",
        "hydra_joblib_launcher",
    ),
    Case(
        ("sim",),
        f"mme_vla.evaluate model=pi05 backbone=tiny {TINY} tasks=[StopCube] episodes=1 max_steps=1 "
        "workers=1 render=false output=evaluated execute=1 flow_steps=1",
        "timeout",
    ),
    Case(
        ("sim",),
        f"mme_vla audit model=pi05 backbone=tiny {TINY} task=StopCube episodes=1 max_steps=1"
        " workers=1 render=false execute=1 flow_steps=1 output=audited",
        "audit.html",
    ),
    Case(
        ("sim", "mikasa"),
        f"mme_vla.evaluate model=pi05 backbone=tiny {TINY} env=mikasa tasks=[RememberColor3]"
        " episodes=1 workers=1 execute=16 flow_steps=1 output=remembered",
        "timeout",
        draws=True,
    ),
    NANO,
    Case(
        ("sim",),
        "mme_vla vision-pretrain tasks=StopCube scenes=2 held_out=1 arrangements=1 steps=1 "
        "batch_size=1 output=tower",
        "nano_tower.safetensors",
        draws=True,
    ),
    Case(
        ("sim",),
        "mme_vla record task=PatternLock episodes=1 frames=[0] workers=1 output=recorded",
        "recorded: 1 episode",
        draws=True,
    ),
    Case(
        ("sim",),
        "mme_vla gallery task=StopCube episodes=1 tiles=2 output=shown",
        "shown/README.md: 1 episode",
        draws=True,
    ),
    Case(("sim",), f"{PLAY} player=random", "records:"),
    Case(("sim", "play"), f"{PLAY}2 port=0", "open http", wait="ready at http"),
]

NEED = [
    Case((), "mme_vla.evaluate model=pi05 backbone=tiny", "sim", 2),
    Case((), "mme_vla audit model=pi05 backbone=tiny task=StopCube output=audited2", "sim", 2),
    Case(("sim",), "mme_vla.evaluate model=pi05 backbone=tiny env=mikasa", "mikasa", 2),
    Case((), "mme_vla record task=PickXtimes episodes=1 output=recorded2", "sim", 2),
    Case((), "mme_vla gallery task=PickXtimes", "sim", 2),
    Case((), f"{PLAY} player=random", "sim", 2),
    Case(("play",), PLAY, "sim", 2),
    Case(("sim",), PLAY, "play", 2),
    Case((), f"{PLAY} player=qwenvl", "vlm", 2),
    Case((), f"{PLAY} player=gemini", "openai", 2),
    Case(("openai",), f"{PLAY} player=gemini", "sim", 2),
    Case((), f"{PLAY} player=openai", "openai", 2),
    Case((), "mme_vla.serve model=pi05 backbone=tiny", "serve", 2),
    Case((), "mme_vla harness --help", "harness", 2),
    Case((), "mme_vla docs", "docs", 2),
    Case((), f"mme_vla weights {STEP} jax2 --to released", "orbax", 2),
    Case((), "mme_vla subgoal-train rows=rows/simple.jsonl vlm=tiny output=tuned2", "vlm", 2),
    Case((), f"{TRAIN} output=run2 finetune=lora", "vlm", 2),
    Case((), f"{TRAIN} output=run3 logger=wandb", "wandb", 2),
    Case((), "mme_vla.train model=diffusion_policy output=run4", "baselines", 2),
    Case((), "mme_vla.analyse selection --output seen2.mp4 --rerun seen2.rrd", "viz", 2),
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Where the commands are run."""
    folder = tmp_path_factory.mktemp("extras")
    write_file(folder / "record_dataset_Alpha.h5", [9, 7])
    return folder


@pytest.fixture(scope="module")
def outcomes(folder: Path) -> Callable[[Case], tuple[int, str]]:
    """Exit code and output of a case.

    One process runs all commands of a set of extras in their order. Those without an extra come
    first, since others read what they wrote.
    """
    finished: dict[Case, tuple[int, str]] = {}

    def outcome(case: Case) -> tuple[int, str]:
        if not all(is_installed(extra) for extra in case.extras):
            pytest.skip(f"not installed: {NEW.format(' --extra '.join(case.extras))}")
        if case.draws and not can_draw():
            pytest.skip("no Vulkan driver: scripts/install_vulkan.sh installs one")
        for extras in ((), case.extras):
            series = [other for other in SUFFICE + NEED if other.extras == extras]
            if series[0] in finished:
                continue
            for waiting in [other for other in series if other.wait]:
                finished[waiting] = run_until(waiting, folder)
            remaining = [o for o in series if not o.wait and (can_draw() or not o.draws)]
            finished.update(zip(remaining, run_series(remaining, folder), strict=True))
        return finished[case]

    return outcome


def environment(extras: Sequence[str]) -> dict[str, str]:
    """The variables of a process that finds the packages of these extras alone."""
    present = set().union(*(needs()[extra] for extra in ("", *extras)))
    offline = {"HF_HUB_OFFLINE": "1", "GEMINI_API_KEY": "none", "OPENAI_API_KEY": "none"}
    return {**without_modules(modules_beyond(present)), **offline}


def run_series(cases: Sequence[Case], folder: Path) -> list[tuple[int, str]]:
    """Run cases of one set of extras in one process; those that it did not finish end with
    `NOT_FINISHED`.
    """
    if not cases:
        return []
    results = folder / "results.json"
    results.write_text("[]")
    try:
        process = subprocess.run(
            [sys.executable, "-W", "ignore", command_series.__file__, str(results)],
            input=json.dumps([case.words for case in cases]), env=environment(cases[0].extras),
            cwd=folder, capture_output=True, text=True, timeout=LONGEST,
        )  # fmt: skip
        reason = process.stderr[-3000:]
    except subprocess.TimeoutExpired:
        reason = f"The commands took more than {LONGEST} s."
    finished = [(code, printed) for code, printed in json.loads(results.read_text())]
    # The process ended in the command after these.
    return finished + [(NOT_FINISHED, reason)] * (len(cases) - len(finished))


def run_until(case: Case, folder: Path) -> tuple[int, str]:
    """Run a case in a process of its own, and stop it once it has printed what it waits for."""
    process = subprocess.Popen(
        [sys.executable, "-W", "ignore", "-m", *case.words.split()], env=environment(case.extras),
        cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    with process:
        printed = ""
        for line in process.stdout:
            printed += line
            if case.wait in line:
                process.terminate()
    return process.returncode, printed


@cache
def can_draw() -> bool:
    from mme_vla.envs.rendering import render_backend

    try:
        render_backend()
    except (UserError, ImportError):
        return False
    return True


def name_of(case: Case) -> str:
    command = case.words.split()[0].removeprefix("mme_vla.")
    return f"{'+'.join(case.extras) or 'none'}:{command}:{case.says}"


def needs_no_extra(case: Case) -> bool:
    """Each set of extras is a process: without any is a slow test, the other sets are nightly."""
    return case.extras == ()


@pytest.mark.parametrize("case", slow_or_nightly(SUFFICE, needs_no_extra, name_of))
def test_the_command_runs_with_this_extra_alone(
    outcomes: Callable[[Case], tuple[int, str]], case: Case
) -> None:
    code, output = outcomes(case)
    assert code == case.code and case.says in output, output[-3000:]


@pytest.mark.nightly
def test_nano_run_again_computes_nothing_twice(
    outcomes: Callable[[Case], tuple[int, str]], folder: Path
) -> None:
    outcomes(NANO)
    nano = folder / "nano"
    records = read_folders(find_records([nano / "further" / "framesamp_modul"]))
    assert sorted(record.episode for record in records) == [0, 1]
    assert {record.action_space for record in records} == {"waypoint"}
    page = (nano / "page.md").read_text()
    assert "| framesamp_modul" in page and "| planner" in page
    assert (nano / "learning.png").is_file()
    videos = list(nano.glob("videos/failure/**/*.mp4"))
    assert len(videos) == 1 and videos[0].name in page

    saved = {path: path.stat().st_mtime_ns for path in nano.rglob("*.npz")}
    ((code, _),) = run_series([NANO], folder)
    assert code == 0
    assert {path: path.stat().st_mtime_ns for path in nano.rglob("*.npz")} == saved
    assert len(read_folders(find_records([nano / "further" / "framesamp_modul"]))) == 2


@pytest.mark.parametrize("case", slow_or_nightly(NEED, needs_no_extra, name_of))
def test_a_command_names_the_extra_that_it_needs(
    outcomes: Callable[[Case], tuple[int, str]], case: Case
) -> None:
    code, output = outcomes(case)
    assert code == case.code and "Traceback" not in output, output[-3000:]
    assert f"extra `{case.says}`" in output and NEW.format(case.says) in output


def test_every_command_is_among_the_cases() -> None:
    words = [case.words.split() for case in SUFFICE]
    assert {w[1] if w[0] == "mme_vla" else w[0].removeprefix("mme_vla.") for w in words} == set(
        commands()
    )


def test_each_extra_is_among_the_cases() -> None:
    # The services of the others need a key.
    assert {e for case in SUFFICE for e in case.extras} == set(needs()) - {
        "",
        "dev",
        "openai",
        "wandb",
    }
