"""A sweep over memories, budgets and trainings is one run: demonstrations and tokens once, one table."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from helpers.nano_policies import demonstration
from mme_vla.cli import nano as command
from mme_vla.cli.nano import with_settings
from mme_vla.config.composition import compose, resolved
from mme_vla.evaluation.records import EpisodeRecord
from mme_vla.nano import evaluating, fitting, learning
from mme_vla.nano.demonstrations import Demonstration
from mme_vla.policy.mme import MMEPolicy
from mme_vla.policy.training_identity import identity_of

FRAMES = tuple(range(0, 160))


def test_models_and_budgets_are_lists_of_one_run() -> None:
    words = with_settings(["--multirun", "model=a,b,c", "budget=4,16", "trainings=2"])
    assert words == ["with_memory=[a,b,c]", "budget=[4,16]", "trainings=2", "also=[]"]
    assert with_settings(["-m", "model=a", "seed=0,1"]) == ["-m", "with_memory=a", "seed=0,1"]
    assert "--multirun" in with_settings(["--multirun", "model=a,b", "seed=0,1"])


def test_a_sweep_shares_demonstrations_and_tokens_and_has_one_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = []
    for number in range(2):
        files.append(tmp_path / f"easy-{number}.npz")
        demonstration(FRAMES).save(files[-1])
    recorded: list[Any] = []
    monkeypatch.setattr(command, "record_all", lambda *args: recorded.append(args) or files)
    made: list[Any] = []
    original = learning.Decisions.of.__func__  # type: ignore[attr-defined]

    def of(cls: Any, policy: Any, *args: Any, **options: Any) -> Any:
        made.append(policy.require_memory().budget)
        return original(cls, policy, *args, **options)

    monkeypatch.setattr(learning.Decisions, "of", classmethod(of))

    def episodes(checkpoint: Path, folder: Path, task: str, **_: Any) -> list[EpisodeRecord]:
        policy = MMEPolicy.from_pretrained(str(checkpoint))
        return [
            EpisodeRecord(str(policy.config["name"]), 2, 7, task, n, n, "easy", "success" if n else "fail", 9,
                          split="further", training=identity_of(policy.config),
                          memory_budget=policy.require_memory().budget) for n in range(2)
        ]  # fmt: skip

    monkeypatch.setattr(evaluating, "run_episodes", episodes)
    words = with_settings(["task=VideoUnmask", "nano=null", "model=framesamp_modul,tokendrop_modul", "budget=2,4"])
    words += ["trainings=2", "beside=[]", "drawn_for=[]", "planner=false", "films=false", f"output={tmp_path / 'run'}"]
    words += ["train.steps=2", "train.val_samples=4", "train.batch_size=2", "train.log_every=1"]
    page = command.run(resolved(compose("nano", words))).read_text()
    assert len(recorded) == 1 and made == [2, 2, 4, 4, 2, 2, 4, 4]  # to learn from and to measure by
    for name in ("framesamp_modul-every_8-grid_1", "tokendrop_modul-grid_1"):
        assert all(f"| {name} | {budget} | 50 ± 0 % (2/4) |" in page for budget in (2, 4))
    assert len(list((tmp_path / "run").glob("*/training_*/trained.json"))) == 8
    seeds = [identity_of(MMEPolicy.from_pretrained(str(run)).config) for run in
             fitting.training_folders(tmp_path / "run" / "framesamp_modul@2", 2)]  # fmt: skip
    assert [one and one.seed for one in seeds] == [0, 1] and seeds[0] != seeds[1]
    command.run(resolved(compose("nano", words)))
    assert len(made) == 8, "a finished run is not made again"


def test_the_digest_of_demonstrations_does_not_depend_on_rendered_frames(tmp_path: Path) -> None:
    files = [tmp_path / "a.npz", tmp_path / "b.npz"]
    made = demonstration((0, 15, 39))
    made.save(files[0])
    replace(made, images={"front": {0: made.images["front"][0]}}).save(files[1])
    assert len(set(fitting.content_of(files))) == 1
    assert Demonstration.load(files[0]).length == 180
