"""`train trainings=2`: one command, two seeds, one vision cache; it continues with the first that
is unfinished.
"""

import warnings
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch

from mme_vla import MMEPolicy, UserError, cli
from mme_vla.cli import evaluate as evaluation
from mme_vla.cli import train as command
from mme_vla.config.composition import compose
from mme_vla.evaluation.rollout.evaluation import facts_of
from mme_vla.evaluation.rollout.settings import RolloutSettings
from mme_vla.policy.run_folders import find_run, locate_checkpoint, trainings_in
from mme_vla.training.runs import Run, check_finished

SMALL = [
    "model=framesamp_modul",
    "backbone.depth=1",
    "backbone.vision.depth=1",
    "backbone.vision.image_size=32",
    "backbone.vision.patch_size=2",
    "memory.budget=64",
    "train.steps=2",
    "train.log_every=1",
    "train.val_samples=0",
    "train.batch_size=2",
    "train.open_loop_chunks=0",
    "train.device=cpu",
    "train.workers=0",
    "trainings=2",
]


@pytest.mark.slow
def test_several_trainings_resume_and_share_a_cache(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / "runs" / "two"
    words = [*SMALL, f"output={output}", f"data.cache.root={tmp_path / 'cache'}"]
    original, calls = command.train, []

    def interrupted(*args: Any, **options: Any) -> Path:
        calls.append(args[1].name)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return original(*args, **options)

    monkeypatch.setattr(command, "train", interrupted)
    with pytest.raises(KeyboardInterrupt):
        command.main(compose("train", words))
    first = trainings_in(output)[0] / "summary.json"
    stored = first.stat().st_mtime_ns
    command.main(compose("train", words))
    assert (
        calls == ["training_0", "training_1", "training_1"] and first.stat().st_mtime_ns == stored
    )
    printed = capsys.readouterr().out
    assert f"training 1 of 2, seed 42, in {output / 'training_0'}: finished" in printed
    assert "train.warmup=20 does not end within train.steps=2" in printed
    policies = [MMEPolicy.from_pretrained(locate_checkpoint(run)) for run in trainings_in(output)]
    facts = [facts_of(policy, None, "one", RolloutSettings(), None).training for policy in policies]
    assert [one and one.seed for one in facts] == [42, 43] and len(
        {one and one.recipe for one in facts}
    ) == 1
    assert (
        len({one and one.data for one in facts}) == 1
        and len({one and one.weights for one in facts}) == 2
    )
    fingerprints = {policy.vision_fingerprint() for policy in policies}
    assert len(fingerprints) == 1
    assert len([path for path in (tmp_path / "cache").glob("*/*") if path.is_dir()]) == 1
    parts = [dict(policy.named_parameters())["backbone.action_out.weight"] for policy in policies]
    assert not torch.equal(*parts)
    check_finished(trainings_in(output))
    with pytest.raises(UserError, match="holds 2 trainings"):
        locate_checkpoint(output)
    assert find_run(output.parent / "latest") == output
    evaluated: list[tuple[str, str]] = []
    monkeypatch.setattr(
        evaluation,
        "evaluate_one",
        lambda run, name="": evaluated.append((run.policy.checkpoint, name)),
    )
    evaluation.main(compose("evaluate", [f"checkpoint={output}", "tasks=StopCube"]))
    assert evaluated == [(str(run), run.name) for run in trainings_in(output)]
    with pytest.raises(UserError, match="other settings"):
        command.main(compose("train", [*words, "train.lr=1e-5"]))
    (trainings_in(output)[1] / "summary.json").unlink()
    with pytest.raises(UserError, match="not finished"):
        check_finished(trainings_in(output))


def test_the_number_of_trainings_is_checked(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="trainings=0"):
        command.main(compose("train", [*SMALL, f"output={tmp_path}", "trainings=0"]))


@pytest.mark.parametrize("seed", [-1, 2**63])
def test_a_seed_beyond_those_of_random_numbers_is_refused(seed: int, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=f"seed={seed} must be a whole number from 0"):
        command.main(compose("train", [*SMALL, f"output={tmp_path}", f"seed={seed}"]))


def test_a_job_of_a_sweep_has_the_folder_that_output_names(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    places = []
    monkeypatch.setattr(command, "train", lambda run, folder, *_: places.append(folder))
    job = tmp_path / "sweep" / "1"
    for word in (f"output={tmp_path}/lr${{train.lr}}", "train.steps=2"):
        hydra = SimpleNamespace(
            runtime=SimpleNamespace(output_dir=str(job)), overrides=SimpleNamespace(task=[word])
        )
        fake = SimpleNamespace(initialized=lambda: True, get=lambda hydra=hydra: hydra)
        monkeypatch.setattr(command, "HydraConfig", fake)
        command.main(compose("train", [*SMALL, "trainings=1", "train.lr=0.5", word]))
    assert places == [tmp_path / "lr0.5", job]


def test_the_training_command_prints_a_warning_without_its_place_in_the_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(command, "train", lambda *_: warnings.warn("mind this", stacklevel=1))
    monkeypatch.setattr("sys.argv", ["mme-vla", "model=pi05", f"output={tmp_path}"])
    monkeypatch.setattr(warnings, "showwarning", warnings.showwarning)  # put back afterwards
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        cli.run("train")
    assert "Warning: mind this" in capsys.readouterr().err.splitlines()


def test_a_folder_holds_a_single_run_or_several_trainings(tmp_path: Path) -> None:
    (tmp_path / "one" / "checkpoints").mkdir(parents=True)
    (tmp_path / "two" / "training_0" / "checkpoints").mkdir(parents=True)
    with pytest.raises(UserError, match="one holds a single run: leave trainings"):
        command.main(compose("train", [*SMALL, f"output={tmp_path / 'one'}"]))
    for resume in ("null", "auto"):
        words = [*SMALL, "trainings=1", f"output={tmp_path / 'two'}", f"resume={resume}"]
        with pytest.raises(UserError, match="two holds trainings of one recipe: add trainings"):
            command.main(compose("train", words))


def test_several_trainings_continue_with_the_latest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    group = tmp_path / "model" / "two"
    state = group / "training_0" / "checkpoints" / "step_000001" / "training_state.json"
    state.parent.mkdir(parents=True)
    state.touch()
    places = []
    monkeypatch.setattr(command, "open_run", lambda place, *_, **__: Run(place))
    monkeypatch.setattr(command, "train", lambda run, place, *_, **__: places.append(place))
    command.main(compose("train", [*SMALL, f"resume={tmp_path}/model/latest"]))
    assert places == [group / "training_0", group / "training_1"]
    with pytest.raises(UserError, match="lost: there is no such folder"):
        command.main(compose("train", [*SMALL, f"resume={tmp_path}/model/lost"]))
