"""The training loop, its checkpoints and its refusals, on samples made in memory."""

import json
import math
import os
import re
import shlex
import shutil
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import pytest
import torch
from accelerate import Accelerator
from omegaconf import OmegaConf

from helpers.trainings import RECIPE, SMALL, Samples, collate, loggers, policy, trainer
from mme_vla import MMEPolicy, UserError
from mme_vla.config.composition import compose
from mme_vla.policy.build import build_from_config
from mme_vla.policy.run_folders import checkpoints_in, find_run, resolve_checkpoint
from mme_vla.training.checkpoint import check_disk
from mme_vla.training.data import check_frozen
from mme_vla.training.logging import ProgressLine, check_logger, open_loggers, read_metrics
from mme_vla.training.loop import Trainer, loss_change
from mme_vla.training.order import Validation
from mme_vla.training.runs import Run, differing_keys, open_run, start_from
from mme_vla.training.settings import KeepRule, TrainSettings


def train(folder: Path, *args: Any, **kwargs: Any) -> Trainer:
    built = trainer(folder, *args, **kwargs)
    with ProgressLine(6, 0, visible=False) as line:
        assert built.run(line, loggers(built.run_info.folder, built.run_info.step))
    return built


@pytest.fixture(scope="module")
def two_steps(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of two steps."""
    folder = tmp_path_factory.mktemp("two_steps")
    train(folder, steps=2)
    return folder


@pytest.fixture
def copied(two_steps: Path, tmp_path: Path) -> Path:
    """A copy of that run, to change."""
    return Path(shutil.copytree(two_steps, tmp_path / "copied"))


def losses(folder: Path) -> list[float]:
    return [line["train/loss"] for line in read_metrics(folder) if "train/loss" in line]


@pytest.mark.slow
def test_a_resumed_run_equals_an_uninterrupted_one(tmp_path: Path) -> None:
    straight = train(tmp_path / "whole")
    train(tmp_path / "parts", steps=3)
    checkpoint = resolve_checkpoint(tmp_path / "parts")
    assert checkpoint.name == "step_000003"
    resumed = train(
        tmp_path, built=policy(seed=9), run=Run(tmp_path / "parts", checkpoint, 3), workers=1
    )
    assert losses(tmp_path / "parts") == losses(tmp_path / "whole")
    for name, weight in straight.policy.state_dict().items():
        assert torch.equal(weight, resumed.policy.state_dict()[name]), name
    for name, average in straight.ema.tensors().items():
        assert torch.equal(average, resumed.ema.tensors()[name]), name


def test_computing_a_batch_in_pieces_gives_the_same_update(tmp_path: Path) -> None:
    built = policy(policy={"augment": False})
    straight = train(tmp_path / "a", built=built, steps=2, val_every=9)
    pieces = train(
        tmp_path / "b", built=policy(policy={"augment": False}), steps=2, val_every=9, accumulate=2
    )
    assert losses(tmp_path / "a") == pytest.approx(losses(tmp_path / "b"), rel=1e-5)
    for name, weight in straight.policy.state_dict().items():
        torch.testing.assert_close(weight, pieces.policy.state_dict()[name], rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize(
    "name", ["pi05", "tokendrop_expert", "framesamp_modul", "framesamp_context"]
)
def test_all_trained_weights_are_updated_and_the_frozen_tower_is_not(
    tmp_path: Path, name: str
) -> None:
    built = policy(name)
    before = {key: value.clone() for key, value in built.state_dict().items()}
    after = train(tmp_path, built=built, gradient_checkpointing=True).policy
    unchanged = {
        key for key, value in after.state_dict().items() if torch.equal(value, before[key])
    }
    assert unchanged == {key for key in before if key.startswith("backbone.vision.")}


def test_from_pretrained_takes_the_averaged_weights(tmp_path: Path) -> None:
    done = train(tmp_path)
    loaded = MMEPolicy.from_pretrained(resolve_checkpoint(tmp_path))
    for name, average in done.ema.tensors().items():
        assert torch.equal(loaded.state_dict()[name], average)
    raw = done.policy.backbone.action_in.weight
    assert not torch.equal(loaded.backbone.action_in.weight, raw)


def test_only_the_checkpoints_of_the_rule_stay(tmp_path: Path) -> None:
    train(tmp_path, save_every=1, keep={"last": 2, "every": 3})
    assert [path.name for path in checkpoints_in(tmp_path / "checkpoints")] == [
        "step_000003", "step_000005", "step_000006",
    ]  # fmt: skip
    assert not list((tmp_path / "checkpoints").glob(".*"))


def test_a_half_saved_checkpoint_is_not_one(copied: Path) -> None:
    (copied / "checkpoints" / ".step_000004.partial").mkdir()
    assert resolve_checkpoint(copied).name == "step_000002"


def test_a_loss_that_is_no_number_stops_the_run_and_saves_nothing(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"train/loss .* before step 1"):
        train(tmp_path, actions=math.nan)
    assert not (tmp_path / "checkpoints").exists()


def test_validation_loss_does_not_depend_on_when_it_is_queried() -> None:
    built = policy()
    validation = Validation(Samples(built, 5), collate, 3, 2, seed=1)
    first = validation.loss(built)
    torch.manual_seed(5)
    assert validation.loss(built.train()) == first
    assert built.training
    assert validation.indices == [0, 2, 4]
    assert Validation(Samples(built, 5), collate, 3, 3, seed=1).loss(built) == pytest.approx(
        first, rel=1e-5
    )


def test_a_folder_that_holds_a_run_is_never_overwritten(two_steps: Path) -> None:
    with pytest.raises(UserError, match="never overwritten"):
        open_run(two_steps, None, {})


def test_resuming_with_other_settings_lists_them(two_steps: Path, tmp_path: Path) -> None:
    config = {"train": {**RECIPE, "steps": 9, "log_every": 3, "lr": 0.5}, "seed": 2}
    with pytest.raises(UserError) as error:
        open_run(tmp_path / "new", str(two_steps), config)
    assert "train.lr: 0.01 then, 0.5 now" in str(error.value)
    assert "seed: 1 then, 2 now" in str(error.value)
    assert "train.steps" not in str(error.value).replace("train.steps=", "")
    assert "log_every" not in str(error.value)
    assert "name:" not in str(error.value)
    with pytest.raises(UserError, match=r"another run:\n  name: None then, 'pi05' now\n  seed:"):
        open_run(tmp_path / "new", str(two_steps), {"train": RECIPE, "seed": 2, "name": "pi05"})
    run = open_run(tmp_path / "new", str(two_steps), {"train": {**RECIPE, "steps": 9}, "seed": 1})
    assert (run.folder, run.step) == (two_steps, 2)
    with pytest.raises(UserError, match=r"has done 2 steps already, more than train\.steps=1"):
        open_run(tmp_path / "new", str(two_steps), {"train": {**RECIPE, "steps": 1}, "seed": 1})


def test_a_cosine_that_ends_with_its_run_is_not_stretched_by_more_steps() -> None:
    def changed(then: dict[str, Any], now: dict[str, Any]) -> set[str]:
        return set(differing_keys({"train": then}, {"train": now}))

    ends_with_run = {"schedule": "cosine", "schedule_steps": None, "steps": 2}
    assert changed(ends_with_run, {**ends_with_run, "steps": 9}) == {"train.schedule_steps"}
    assert not changed(ends_with_run, {**ends_with_run, "steps": 9, "schedule_steps": 2})
    same_end = {**ends_with_run, "schedule_steps": 50}
    assert not changed(same_end, {**same_end, "steps": 9})
    constant = {**ends_with_run, "schedule": "constant"}
    assert not changed(constant, {**constant, "steps": 9})


def test_a_setting_that_came_or_went_counts_as_changed() -> None:
    assert differing_keys({"a": {"b": 1}}, {"a": {"c": 1}}) == {"a.b": (1, None), "a.c": (None, 1)}
    assert (
        differing_keys(
            {"logger": {"name": "wandb"}, "keep": (1, 2)}, {"logger": None, "keep": [1, 2]}
        )
        == {}
    )


def test_a_dataset_may_change_its_folder_under_its_name() -> None:
    def changed(then: Any, now: Any, **others: Any) -> dict[str, tuple[Any, Any]]:
        return differing_keys({"data": {"sources": then, **others}}, {"data": {"sources": now}})

    digests: dict[str, Any] = {"content": ["a"], "side_files": [{}]}
    entry = {"root": "/b/mm_new", "name": "mm"}
    for spelled in ("/a/mm", ["/a/mm/"], ["/b/mm"], [entry], entry):
        assert changed(["/a/mm"], spelled, **digests) == {}, spelled
    other = [{"root": "/b/mm", "exec_starts": "/b/starts.json"}]
    assert changed([{"root": "/a/mm", "exec_starts": "/a/starts.json"}], other, **digests) == {}
    # the split goes by the name
    renamed = {"data.sources.0.name": ("mm", "other")}
    assert changed(["/a/mm"], ["/a/other"], **digests) == renamed
    assert changed(["/a/mm"], ["/a/mm", "/a/mn"], **digests) == {
        "data.sources.1.name": (None, "mn")
    }
    # the embedded sample has a held-out episode of its own
    assert changed(["sample"], ["/a/sample"], **digests).keys() == {"data.sources.0.root"}
    # earlier versions kept no digests
    assert changed(["/a/mm"], ["/a/mm/"]) == {}
    assert changed(["/a/mm"], ["/b/mm"]) == {"data.sources.0.root": ("/a/mm", "/b/mm")}


def test_auto_resumes_the_newest_unfinished_run_or_begins(two_steps: Path, tmp_path: Path) -> None:
    config = {"train": {**RECIPE, "steps": 9}, "seed": 1}
    assert open_run(tmp_path / "b", "auto", config) == Run(tmp_path / "b")
    shutil.copytree(two_steps, tmp_path / "a")
    assert open_run(tmp_path / "b", "auto", config).folder == tmp_path / "a"
    with pytest.raises(UserError, match=r"seed: 1 then, 2 now(.|\n)*resume=auto chose that run"):
        open_run(tmp_path / "b", "auto", {**config, "seed": 2})
    assert open_run(tmp_path / "b", "auto", config, named=True) == Run(tmp_path / "b")
    assert open_run(tmp_path / "a", "auto", config, named=True).step == 2
    (tmp_path / "a" / "summary.json").write_text("{}")
    assert open_run(tmp_path / "b", "auto", config) == Run(tmp_path / "b")


def test_a_run_whose_old_checkpoint_was_deleted_is_not_the_newest(
    two_steps: Path, tmp_path: Path
) -> None:
    config = {"train": {**RECIPE, "steps": 9}, "seed": 1}
    for name, hour in (("early", 1), ("late", 2)):
        shutil.copytree(two_steps, tmp_path / name)
        (checkpoint,) = checkpoints_in(tmp_path / name / "checkpoints")
        os.utime(checkpoint, (hour * 3600, hour * 3600))
    (tmp_path / "early" / "checkpoints" / "step_000001").mkdir()
    (tmp_path / "early" / "checkpoints" / "step_000001").rmdir()
    assert open_run(tmp_path / "new", "auto", config).folder == tmp_path / "late"
    assert find_run(tmp_path / "latest") == tmp_path / "late"


def test_a_finished_run_that_trains_on_is_unfinished_again(tmp_path: Path) -> None:
    first = train(tmp_path / "a", steps=1)
    summary = tmp_path / "a" / "summary.json"
    summary.write_text("{}")
    config = {"train": {**RECIPE, "steps": 2}, "seed": 1}
    assert open_run(tmp_path / "b", "auto", config) == Run(tmp_path / "b")
    run = Run(tmp_path / "a", first.last_checkpoint, 1)
    train(tmp_path / "a", run=run, steps=1)
    assert summary.exists()
    train(tmp_path / "a", run=run, steps=2)
    assert not summary.exists()
    assert open_run(tmp_path / "b", "auto", config).step == 2


def write_unsummed(file: Path, text: str) -> None:
    (file.parent / "SHA256SUMS").unlink()
    file.write_text(text)


@pytest.mark.parametrize(
    ("break_it", "message"),
    [
        (lambda folder: (folder / "training_state.json").unlink(), "nothing to resume"),
        (lambda folder: (folder / "training_state.json").write_text("{"), "damaged"),
        (
            lambda folder: write_unsummed(folder / "training_state.json", '{"format": "theirs"}'),
            "not written by",
        ),
        (lambda folder: (folder / "optimizer.safetensors").unlink(), "lacks optimizer.safetensors"),
        (
            lambda folder: (folder / "raw.safetensors").write_bytes(b"broken"),
            "raw.safetensors is damaged",
        ),
        (lambda folder: (folder / "model.safetensors").write_bytes(b"\0" * 64), "damaged"),
    ],
)
def test_broken_checkpoints_are_refused(
    copied: Path, tmp_path: Path, break_it: Any, message: str
) -> None:
    folder = resolve_checkpoint(copied)
    break_it(folder)
    with pytest.raises(UserError, match=message):
        run = open_run(tmp_path / "new", str(folder), {"train": {**RECIPE, "steps": 6}, "seed": 1})
        trainer(tmp_path, run=run)


def test_a_checkpoint_of_another_model_does_not_fit(two_steps: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match="does not fit this policy"):
        trainer(
            tmp_path,
            built=policy("tokendrop_expert"),
            run=Run(two_steps, resolve_checkpoint(two_steps), 2),
        )


@pytest.mark.parametrize(
    "files",
    [["29999/params/_METADATA"], ["29999/params/_METADATA", "history_config.txt"], ["79999.zip"]],
)
def test_a_checkpoint_of_the_released_code_names_the_command_that_converts_it(
    tmp_path: Path, files: list[str]
) -> None:
    for file in files:
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / file).touch()
    run, step = tmp_path, tmp_path / files[0].split("/")[0]
    for place in (run, step):
        command = re.escape(f"mme-vla weights {shlex.quote(str(place))} ")
        with pytest.raises(UserError, match=rf"{command}\S.*_converted"):
            resolve_checkpoint(place)


def test_the_tower_under_a_memory_stays_frozen() -> None:
    check_frozen(policy(), freeze_vision=False)
    with pytest.raises(UserError, match="freeze_vision"):
        check_frozen(policy("tokendrop_expert"), freeze_vision=False)


def test_too_small_a_disk_is_detected_before_training(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "shutil.disk_usage",
        lambda path: os.terminal_size((0, 0)) and type("Usage", (), {"free": 10}),
    )
    with pytest.raises(UserError, match="free"):
        check_disk(tmp_path / "not" / "there", policy(), KeepRule())
    low = policy().bfloat16()  # stored in float32
    needed = 2 * sum(4 * p.numel() * (4 if p.requires_grad else 1) for p in low.parameters())
    for free, fits in ((needed, True), (needed - 1, False)):
        monkeypatch.setattr(
            "shutil.disk_usage", lambda path, free=free: type("Usage", (), {"free": free})
        )
        with nullcontext() if fits else pytest.raises(UserError, match="free"):
            check_disk(tmp_path, low, KeepRule(last=1))


def log_twice(folder: Path, section: dict[str, Any]) -> None:
    """Log as a run that is resumed after its third update."""
    from PIL import Image

    Accelerator(cpu=True)
    folder.mkdir(parents=True)
    Image.new("RGB", (4, 4)).save(folder / "p.png")
    for step in (3, 4):
        opened = open_loggers(folder, {}, step - 1, section)
        opened.write(step, {"train/loss": 0.5})
        opened.log_image(step, "plot", folder / "p.png")
        opened.close()
    assert read_metrics(folder) == [{"step": step, "train/loss": 0.5} for step in (3, 4)]


def test_tensorboard_records_numbers_and_images(tmp_path: Path) -> None:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    log_twice(tmp_path / "run", {"name": "tensorboard"})
    events = EventAccumulator(str(tmp_path / "run" / "tensorboard"))
    events.Reload()
    assert [event.step for event in events.Scalars("train/loss")] == [3, 4]
    assert events.Tags()["images"] == ["plot"]


def test_tensorboard_drops_points_of_a_run_killed_before_its_first_checkpoint(
    tmp_path: Path,
) -> None:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    Accelerator(cpu=True)
    for loss in (0.5, 0.25):
        opened = open_loggers(tmp_path, {}, 0, {"name": "tensorboard"})
        opened.write(1, {"train/loss": loss})
        opened.close()
    events = EventAccumulator(str(tmp_path / "tensorboard"))
    events.Reload()
    assert [event.value for event in events.Scalars("train/loss")] == [0.25]


def test_wandb_records_offline_and_a_resumed_run_keeps_its_id(tmp_path: Path) -> None:
    pytest.importorskip("wandb", reason="uv sync --inexact --extra wandb")
    folder = tmp_path / "model" / "run"
    log_twice(folder, {"name": "wandb", "mode": "offline"})
    run_id = (folder / "wandb_id").read_text()
    files = list(folder.glob(f"wandb/offline-run-*/run-{run_id}.wandb"))
    assert len(files) == 2 and all(file.stat().st_size for file in files)


def test_trackio_resumes_its_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TRACKIO_DIR", str(tmp_path / "trackio"))
    trackio = pytest.importorskip("trackio", reason="pip install -c constraints.txt trackio")
    log_twice(tmp_path / "model" / "run", {"name": "trackio"})
    (run,) = trackio.Api().runs("mme_vla")
    assert run.name.startswith("model/run-")


def test_mlflow_resumes_its_run(tmp_path: Path) -> None:
    mlflow = pytest.importorskip("mlflow", reason="pip install -c constraints.txt mlflow")
    folder = tmp_path / "model" / "run"
    log_twice(folder, {"name": "mlflow"})
    run_id = (folder / "mlflow_id").read_text()
    history = mlflow.MlflowClient().get_metric_history(run_id, "train/loss")
    assert [point.step for point in history] == [3, 4]
    assert list((folder / "mlflow").rglob("p.png"))


def test_metrics_beyond_the_resumed_step_are_cut_off(tmp_path: Path) -> None:
    (tmp_path / "metrics.jsonl").write_text('{"step": 1}\n{"step": 2}\n{"st')
    with pytest.warns(UserWarning, match="half-written"):
        open_loggers(tmp_path, {}, 1).close()
    assert read_metrics(tmp_path) == [{"step": 1}]


@pytest.mark.parametrize("name", ["wandb", "trackio", "mlflow"])
def test_missing_logger_package_is_reported(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    monkeypatch.setitem(__import__("sys").modules, name, None)
    with pytest.raises(UserError, match=f"logger={name} needs the .* `?{name}"):
        check_logger({"name": name})


def test_loss_change_compares_both_ends() -> None:
    lines = [{"step": step, "train/loss": float(100 - step)} for step in range(10, 101, 10)]
    assert loss_change([*lines, {"step": 9, "val/loss": 7}]) == {
        "first_loss": 90.0,
        "last_loss": 0.0,
        "val_loss": 7,
    }
    assert loss_change([]) == {}


@pytest.mark.parametrize(
    "overrides",
    [
        [],
        ["experiment=robomme"],
        ["logger=wandb"],
        ["logger=none"],
        ["logger=trackio"],
        ["logger=mlflow"],
    ],
)
def test_shipped_recipes_are_valid(overrides: list[str]) -> None:
    config = OmegaConf.to_container(compose("train", overrides), resolve=True)
    TrainSettings.from_dict(config["train"], config["seed"])
    json.dumps(config)


def test_the_papers_recipe_is_the_papers() -> None:
    config = compose("train", ["experiment=robomme", "model=framesamp_modul"])
    recipe = config.train
    assert (recipe.steps, recipe.batch_size, recipe.lr, recipe.warmup, recipe.ema) == (
        80_000,
        64,
        5e-5,
        10_000,
        0.999,
    )
    assert config.policy.compute_dtype == "bfloat16"
    assert config.backbone.vlm.width == 2048
    assert config.name == "framesamp_modul"


def test_weights_to_be_replaced_are_not_rendered_but_a_memory_is_fresh(tmp_path: Path) -> None:
    base = policy(seed=5)
    base.save_pretrained(tmp_path)
    words = [
        "model=framesamp_expert",
        "memory.budget=64",
        *(f"backbone.{k}={v}" for k, v in (("depth", 1),)),
    ]
    words += [f"backbone.vision.{key}={value}" for key, value in SMALL["vision"].items()]
    built = build_from_config(compose("policy", words), fresh_backbone=False)
    start_from(built, str(tmp_path))
    fresh = built.state_dict()
    assert all(torch.equal(fresh[key], value) for key, value in base.state_dict().items())
    norm = next(
        value for key, value in fresh.items() if ".experts.memory.attention_norm.scale" in key
    )
    weight = next(
        value for key, value in fresh.items() if ".experts.memory." in key and value.ndim == 2
    )
    assert (norm == 0).all() and 0 < weight.std() < 1
