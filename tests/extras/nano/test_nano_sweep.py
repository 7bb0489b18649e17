"""A sweep over memories, budgets and trainings is one run: demonstrations and tokens once, one
table.
"""

import re
import shutil
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from helpers.nano_policies import demonstration
from mme_vla.config.composition import compose, resolved
from mme_vla.data.waypoints import Motions
from mme_vla.embodiment import ROBOMME_JOINT
from mme_vla.errors import UserError
from mme_vla.evaluation.records import EpisodeRecord
from mme_vla.extras.nano import evaluating, fitting, runs, tokens
from mme_vla.extras.nano.cli.nano import main, with_settings
from mme_vla.extras.nano.demonstrations import Demonstration
from mme_vla.extras.nano.settings import NanoRun
from mme_vla.policy.mme import MMEPolicy
from mme_vla.policy.training_identity import identity_of
from mme_vla.utils import read_json

FRAMES = tuple(range(0, 160))


def test_models_and_budgets_are_lists_of_one_run() -> None:
    words = with_settings(["--multirun", "model=a,b,c", "budget=4,16", "trainings=2"])
    assert words == [
        "nano=nano16",
        "with_memory=[a,b,c]",
        "budget=[4,16]",
        "trainings=2",
        "also=[]",
    ]
    swept = with_settings(["-m", "task=VideoUnmask", "model=a", "seed=0,1"])
    assert swept[1:] == ["-m", "task=VideoUnmask", "with_memory=a", "seed=0,1", "also=[]"]
    assert "--multirun" in with_settings(["--multirun", "model=a,b", "seed=0,1"])


def test_help_is_of_the_command_and_not_of_the_settings_that_it_begins_with(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for words in (["--help"], ["-h"]):
        monkeypatch.setattr("sys.argv", ["mme-vla nano", *words])
        with pytest.raises(SystemExit) as ended:
            main()
        text = capsys.readouterr().out
        assert ended.value.code == 0
        assert text.startswith("Usage: mme-vla nano") and "\n  rendered_for: " in text
    monkeypatch.setattr("sys.argv", ["mme-vla nano", "--help", "nano=RouteStick"])
    with pytest.raises(SystemExit):
        main()
    assert "nano=RouteStick" in capsys.readouterr().out


@pytest.mark.nightly
def test_a_sweep_shares_demonstrations_and_tokens_and_has_one_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = []
    (tmp_path / "VideoUnmask").mkdir()
    for number in range(2):
        files.append(tmp_path / "VideoUnmask" / f"easy-{number}.npz")
        demonstration(FRAMES).save(files[-1])
    recorded: list[Any] = []
    monkeypatch.setattr(runs, "record_all", lambda *args: recorded.append(args) or files)
    made: list[Any] = []
    original = tokens.tokenize
    monkeypatch.setattr(tokens, "tokenize", lambda *args: made.append(args) or original(*args))

    def episodes(checkpoint: Path, folder: Path, *_: Any, **__: Any) -> list[EpisodeRecord]:
        folder.mkdir(parents=True, exist_ok=True)
        policy = MMEPolicy.from_pretrained(str(checkpoint))
        return [
            EpisodeRecord(
                str(policy.config["name"]),
                2,
                7,
                "VideoUnmask",
                n,
                n,
                "easy",
                "success" if n else "fail",
                9,
                split="further",
                training=identity_of(policy.config),
                memory_budget=policy.require_memory().budget,
            )
            for n in range(2)
        ]

    monkeypatch.setattr(evaluating, "run_checkpoint", episodes)
    words = with_settings(["task=VideoUnmask", "nano=null", "model=framesamp_modul", "budget=2,4"])
    words += ["trainings=2", "beside=[]", "rendered_for=[]", "planner=false", "videos=false"]
    words += ["train.steps=2", "train.val_samples=4", "train.batch_size=2", "train.log_every=1"]
    words += [f"output={tmp_path / 'run'}"]
    page = runs.run(NanoRun.from_config(resolved(compose("nano", words)))).read_text()
    assert len(recorded) == 1 and len(made) == 2, "each frame is encoded once"
    assert all(f"| framesamp_modul | {budget} | 50 ± 0 % (2/4) |" in page for budget in (2, 4))
    trained = sorted((tmp_path / "run").glob("training/*/*/trained.json"))
    assert len(trained) == 4
    seeds = [
        identity_of(
            MMEPolicy.from_pretrained(
                str(tmp_path / "run" / "training" / "framesamp_modul@2" / n)
            ).config
        )
        for n in "01"
    ]
    assert [one and one.seed for one in seeds] == [0, 1] and seeds[0] != seeds[1]
    about = read_json(
        tmp_path / "run" / "further" / "framesamp_modul@2" / "1" / "trained.json", "a row"
    )
    assert (about["row"], about["seed"], about["budget"], about["decisions"]) == (
        "framesamp_modul@2",
        1,
        2,
        3,
    )
    assert (
        about["demonstrations"] == {"VideoUnmask": 2}
        and about["parameters"] > 1e6
        and about["update_flops"] > 1e6
    )
    runs.run(NanoRun.from_config(resolved(compose("nano", words))))
    assert len(made) == 2, "a finished run is not made again"
    for changed, message in (
        ("train.steps=3", "steps was 2, and is 3"),
        ("learning.noise=0.5", "learning.noise was"),
    ):
        with pytest.raises(UserError, match=message):
            runs.run(NanoRun.from_config(resolved(compose("nano", [*words, changed]))))
    killed = tmp_path / "run" / "training" / "framesamp_modul@2" / "0"
    (killed / "trained.json").unlink()
    # as before the first one: there are only lines of progress
    shutil.rmtree(killed / "checkpoints")
    runs.run(NanoRun.from_config(resolved(compose("nano", words))))
    assert read_json(killed / "trained.json", "a training's end")["steps"] == 2


@pytest.mark.parametrize(
    ("word", "says"),
    [
        ("split=further_ez", "Unknown split 'further_ez'. Did you mean 'further'"),
        ("task=VideoUmask", "Unknown task 'VideoUmask'"),
        ("episodes=101", "episodes=101 means the first 101; VideoUnmask in 'further' has 100"),
        ("also_episodes=101", "episodes=101 means the first 101"),
        ("replace=true", "episodes=all: with replace=true write how many scenes"),
        ("shard=2/2", "shard='2/2'"),
    ],
)
def test_what_is_evaluated_is_checked_before_anything_is_recorded(
    word: str, says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(runs, "record_all", lambda *_: pytest.fail("it records"))
    words = ["task=VideoUnmask", "also=[ttt_modul]", f"output={tmp_path / 'run'}", word]
    with pytest.raises(UserError, match=re.escape(says)):
        runs.run(NanoRun.from_config(resolved(compose("nano", words))))
    assert not (tmp_path / "run").exists()


def test_what_is_recorded_is_said_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def demonstrate(*_: Any) -> list[Path]:
        said.extend(caplog.messages)
        return []

    said: list[str] = []
    monkeypatch.setattr(runs, "demonstrate", demonstrate)
    caplog.set_level("INFO", "mme_vla.nano")
    words = ["task=VideoUnmask", "demonstrations={easy: 120, hard: 30}", "stage=record"]
    words.append(f"output={tmp_path / 'run'}")
    runs.run(NanoRun.from_config(resolved(compose("nano", words))))
    assert said == ["300 demonstrations: 120 easy, 150 medium, 30 hard"]


def test_minutes_of_a_stage_add_up_over_runs(tmp_path: Path) -> None:
    minutes = runs.Minutes(tmp_path / "clock.json")
    for stage in ("training", "evaluation", "training"):
        with minutes.of(stage):
            time.sleep(0.02)
    assert minutes.spent["training"] >= 2 * 0.02 / 60 and set(minutes.spent) == {
        "training",
        "evaluation",
    }


def test_the_digest_of_demonstrations_is_of_their_scenes_and_choices(tmp_path: Path) -> None:
    made, acts = demonstration((0, 15, 39)), ROBOMME_JOINT.action
    variants = {
        "a": made,
        "rendered elsewhere": replace(made, images={"front": {0: made.images["front"][0]}}),
        "another processor": replace(made, states=np.nextafter(made.states, np.float32(9))),
        "carried out": replace(made, carried_out=True),
        "another goal": replace(made, goal=f"{made.goal} twice"),
        "one decision fewer": replace(
            made, motions=Motions(made.motions.decisions[1:], made.motions.targets[1:])
        ),
    }
    for name, variant in variants.items():
        variant.save(tmp_path / f"{name}.npz")
    files = tuple(tmp_path / f"{name}.npz" for name in variants)
    digests = dict(zip(variants, fitting.content_of(files, tuple(acts.choice)), strict=True))
    same = {name for name, digest in digests.items() if digest == digests["a"]}
    assert same == {"a", "rendered elsewhere", "another processor"}
    assert Demonstration.load(tmp_path / "a.npz").length == 180


@pytest.mark.parametrize("count", [1, 2, 9, 10, 21])
def test_no_demonstration_is_learned_from_and_measured(
    count: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files, reads = [tmp_path / f"{number}.npz" for number in range(count)], []
    monkeypatch.setattr(fitting, "statistics", lambda *_: None)
    monkeypatch.setattr(fitting.Demonstration, "load", lambda file, images: file)
    monkeypatch.setattr(
        fitting.Decisions, "of", lambda policy, made, *_, **__: reads.append([f for f, _ in made])
    )
    store = SimpleNamespace(read=lambda file: file)
    job = SimpleNamespace(learning={}, files=files, store=store, seed=0)
    fitting.prepared(SimpleNamespace(require_processor=SimpleNamespace), job)
    learned, measured = reads
    assert len(measured) == max(1, count // 10) and (count == 1 or not set(learned) & set(measured))
    assert set(learned) | set(measured) == set(files)
