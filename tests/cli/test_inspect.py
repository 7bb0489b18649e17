"""`python -m mme_vla.inspect` shows what is there."""

import time
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from rich.console import Console

from helpers.lerobot_tables import write_dataset
from mme_vla import Policy, UserError, build_policy
from mme_vla.cli.inspect import (
    Inspection,
    build_memory,
    check_open_loop,
    check_place,
    draw_memory,
    held_out_episodes,
    main,
    show_dataset,
    show_episode,
)
from mme_vla.cli.inspect_checkpoint import show_checkpoint
from mme_vla.cli.train import train
from mme_vla.config.composition import compose, resolved
from mme_vla.data import cache_building
from mme_vla.data.episodes import EpisodeSource
from mme_vla.data.recording import Recording, action_offset_of
from mme_vla.policy.saving import save_policy
from mme_vla.policy.self_check import NO_CHECK, record_self_check
from mme_vla.testing.small import small_policy, unit_stats
from mme_vla.training.settings import DataSettings, TrainRun


@pytest.fixture
def console() -> Console:
    return Console(record=True, width=160, quiet=False, file=open("/dev/null", "w"))  # noqa: PTH123


@pytest.fixture(scope="module")
def sample() -> EpisodeSource:
    return EpisodeSource("sample")


def test_a_dataset_shows_its_episodes(sample: EpisodeSource, console: Console) -> None:
    show_dataset(sample, console)
    text = console.export_text()
    assert all(sample.goal(episode)[:30] in text for episode in range(len(sample)))
    assert str(int(sample.lengths.sum())) in text


def test_an_episode_shows_its_phases_and_subgoals(sample: EpisodeSource, console: Console) -> None:
    show_episode(sample, 0, 100, console)
    text = console.export_text()
    assert f"frames 0 … {sample.exec_starts[0] - 1}" in text
    assert sample.subgoals(0, 100)["simple_subgoal"] in text


def test_a_memory_is_rendered_as_it_selects(
    sample: EpisodeSource, console: Console, tmp_path: Path
) -> None:
    config = resolved(compose("inspect", ["memory=tokendrop"]))
    memory = build_memory(Inspection.from_config(config))
    path = draw_memory(sample, 3, 120, memory, "tokendrop", tmp_path, console)
    with Image.open(path) as image:
        assert image.width > 800
    assert f"of {memory.budget} tokens" in console.export_text()


def test_a_memory_that_chooses_by_tokens_is_not_rendered(
    sample: EpisodeSource, console: Console, tmp_path: Path
) -> None:
    config = resolved(compose("inspect", ["memory=retrieval"]))
    memory = build_memory(Inspection.from_config(config))
    with pytest.raises(UserError, match="reads vision tokens to choose its frames"):
        draw_memory(sample, 0, 170, memory, "retrieval", tmp_path, console)


@pytest.mark.parametrize("name", ["framesamp_modul", "retrieval_modul"])
def test_the_memory_of_a_checkpoint_is_rendered_with_the_tokens_that_it_reads(
    name: str, sample: EpisodeSource, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    policy = small_policy(name)
    policy.save_pretrained(tmp_path / "policy")
    words = [f"checkpoint={tmp_path / 'policy'}", "dataset=sample", f"output={tmp_path}"]
    main(compose("inspect", [*words, "episode=1", "step=100"]))
    running = policy.start_episode(sample.goal(1))
    Recording(sample, 1).show(running, 0, 101)
    with torch.no_grad():
        selected = policy.require_memory().select(running.required_history(), 100)
    frames = ", ".join(str(frame) for frame in np.unique(selected[:, 0]))
    printed = "".join(character for character in capsys.readouterr().out if character not in "│\n")
    assert " ".join(frames.split()) in " ".join(printed.split())
    (path,) = tmp_path.glob("sample_episode1_step100_*.png")
    with Image.open(path) as image:
        assert image.width > 800


def test_a_checkpoint_without_memory_has_none_to_render(tmp_path: Path) -> None:
    small_policy("pi05").save_pretrained(tmp_path)
    words = [f"checkpoint={tmp_path}", "dataset=sample", "step=3"]
    with pytest.raises(UserError, match=r"add episode=…"):
        main(compose("inspect", words))
    with pytest.raises(UserError, match="has no memory"):
        main(compose("inspect", [*words, "episode=0"]))


def test_images_that_the_default_memory_cannot_divide_say_which_to_choose(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    frames = EpisodeSource.frames
    cropped = lambda *arguments: frames(*arguments)[:, :94, :130]  # noqa: E731
    monkeypatch.setattr(EpisodeSource, "frames", cropped)
    words = ["dataset=sample", "episode=0", "step=20", f"output={tmp_path}"]
    main(compose("inspect", words))
    printed = capsys.readouterr().out
    assert "image: none of memory=tokendrop, the default. A 94×130 frame does not" in printed
    assert "multiples of 8, set memory.grid=2, or choose" in printed
    main(compose("inspect", [*words, "memory=framesamp"]))
    assert "framesamp.png" in capsys.readouterr().out
    memory = build_memory(Inspection.from_config(resolved(compose("inspect"))))
    with pytest.raises(UserError, match=r"sample, image \(the camera 'front'\): A 94×130 frame"):
        list(cache_building._chunks(EpisodeSource("sample"), [0], memory, 32))


def test_the_tokens_that_are_read_are_counted_against_the_most_that_can_be(
    sample: EpisodeSource, console: Console, tmp_path: Path
) -> None:
    config = resolved(compose("inspect", ["memory=ttt", "memory.budget=64"]))
    memory = build_memory(Inspection.from_config(config))
    draw_memory(sample, 0, 170, memory, "ttt", tmp_path, console)
    assert f"of {memory.capacity:,} tokens" in console.export_text()
    assert memory.capacity > memory.budget


def test_a_checkpoint_shows_its_parts(tmp_path: Path, console: Console) -> None:
    policy = build_policy("framesamp_modul", memory={"budget": 64})
    policy.save_pretrained(tmp_path)
    show_checkpoint(tmp_path, console)
    text = console.export_text()
    assert f"{sum(p.numel() for p in policy.parameters()):,}" in text
    assert all(part in text for part in ("vision", "vlm", "memory", "action"))
    assert "framesamp, 64 tokens" in text and "robomme_joint" in text
    assert "budget=64" not in text
    assert "not recorded" in text, "these weights were not trained"


def test_summary_fits_a_screen(tmp_path: Path) -> None:
    build_policy("framesamp_modul").save_pretrained(tmp_path)
    with Path("/dev/null").open("w") as nowhere:
        console = Console(record=True, width=80, file=nowhere)
        show_checkpoint(tmp_path, console)
    lines = console.export_text().splitlines()
    assert len(lines) <= 24 and max(map(len, lines[1:])) <= 80


def test_all_shows_the_configuration_and_statistics(tmp_path: Path, console: Console) -> None:
    policy = build_policy("framesamp_modul", memory={"budget": 64})
    policy.require_processor().stats = unit_stats(policy.embodiment)
    policy.save_pretrained(tmp_path)
    show_checkpoint(tmp_path, console, everything=True)
    text = console.export_text()
    assert "budget=64" in text and "normalisation of the state" in text
    assert text.count("│ joint 1") == 2, "the state's numbers have the names of the action's"


def test_a_checkpoint_is_compared_with_its_self_check(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    policy = build_policy("pi05")
    policy.require_processor().stats = unit_stats(policy.embodiment)
    command = [f"checkpoint={tmp_path}", "check=true", "device=cpu"]
    policy.save_pretrained(tmp_path)
    main(compose("inspect", command))
    assert capsys.readouterr().out == f"{NO_CHECK}\n"

    check = record_self_check(policy)
    save_policy(policy, tmp_path, self_check=check)
    main(compose("inspect", command))
    line = capsys.readouterr().out
    assert line.startswith("self-check: passed") and line.count("\n") == 1

    other = build_policy("pi05", seed=5)
    other.require_processor().stats = unit_stats(other.embodiment)
    save_policy(other, tmp_path, self_check=check)
    with pytest.raises(UserError, match=r"^self-check: FAILED.*fetch the checkpoint again"):
        main(compose("inspect", command))
    with pytest.raises(UserError, match="name checkpoint="):
        main(compose("inspect", ["check=true"]))


@pytest.fixture
def squid(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, with a dataset of a robot that no file describes."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MME_VLA_CACHE", str(tmp_path / "caches"))
    write_dataset(tmp_path / "squid", (30, 25), names=["a", "b", "gripper"])
    return tmp_path


def test_unknown_robot_is_drafted(squid: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(compose("inspect", ["dataset=squid"]))
    printed = capsys.readouterr().out
    draft = squid / "outputs" / "inspect" / "embodiment" / "squid.yaml"
    assert draft.read_text() in printed
    assert "mme-vla train --config-dir outputs/inspect embodiment=squid" in printed
    with pytest.raises(UserError, match=r"mme-vla inspect dataset=squid.*your-robot"):
        EpisodeSource("squid")


def test_held_out_episodes_are_those_of_the_training(sample: EpisodeSource) -> None:
    named = DataSettings(sources=["sample", "other"], val_episodes=("sample/1", "other/0"))
    content = [sample.fingerprint, "another"]
    held_out = held_out_episodes(sample, named, content)
    assert held_out is not None and held_out.tolist() == [False, True, False, False]
    default = held_out_episodes(sample, DataSettings(sources="sample"), content)
    assert default is not None and default.tolist() == [False, False, False, True]
    all_but_none = DataSettings(sources=["sample", "other"], val_episodes=(), val_fraction=0.999999)
    every = held_out_episodes(sample, all_but_none, content)
    assert every is not None and every.all(), "another source was trained on"
    assert held_out_episodes(sample, named, ["another"]) is None


@pytest.mark.slow
def test_draft_trains_and_the_checkpoint_is_checked_open_loop(
    squid: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    main(compose("inspect", ["dataset=squid"]))
    words = [
        "embodiment=squid", "model=framesamp_modul", "data=lerobot", "data.sources=[squid]",
        "data.val_episodes=[1]", "train.steps=1", "train.batch_size=2", "train.val_samples=2",
        "train.workers=0", "train.device=cpu", "logger=none", "output=run", "backbone.depth=1",
    ]  # fmt: skip
    cfg = compose("train", words, extra_dirs=[squid / "outputs" / "inspect"])
    run = TrainRun.from_config(resolved(cfg))
    train(run, squid / "run", begun=time.perf_counter())
    printed = capsys.readouterr().out
    assert "open loop on held-out episode 1 of squid" in printed and "baseline" in printed

    main(compose("inspect", ["checkpoint=run", "dataset=squid"]))
    printed = capsys.readouterr().out
    assert "open loop on held-out episode 1 of squid" in printed and "baseline" in printed
    assert (squid / "outputs/inspect/framesamp_modul_squid_episode1_open_loop.png").is_file()
    main(compose("inspect", ["checkpoint=run", "dataset=squid", "episode=0"]))
    printed = capsys.readouterr().out
    assert "training episode 0" in printed and "was trained on this episode" in printed
    main(compose("inspect", ["checkpoint=run"]))
    printed = " ".join(capsys.readouterr().out.split())
    assert "squid: cameras top" in printed and "1 of 1 updates" in printed
    assert "error validation loss=" in printed and "dataset=… compares actions" in printed

    with pytest.raises(UserError, match=r"step=3 is a frame of an episode: add episode="):
        main(compose("inspect", ["dataset=sample", "step=3"]))
    with pytest.raises(UserError, match=r"step=3 draws .* add episode="):
        main(compose("inspect", ["checkpoint=run", "dataset=squid", "step=3"]))
    with pytest.raises(UserError, match="squid has episodes 0 … 1"):
        main(compose("inspect", ["checkpoint=run", "dataset=squid", "episode=2"]))


@pytest.mark.slow
def test_weights_without_their_training_say_which_actions_they_were_paired_with(
    sample: EpisodeSource, tmp_path: Path, console: Console
) -> None:
    words = [
        "model=pi05", "backbone.depth=1", "backbone.vision.depth=1", "data.action_offset=1",
        "backbone.vision.image_size=16", "backbone.vision.patch_size=1", "train.steps=1",
        "train.batch_size=2", "train.workers=0", "train.val_samples=0", "train.open_loop_chunks=0",
        "train.self_check=false", "train.device=cpu", "logger=none",
    ]  # fmt: skip
    run = TrainRun.from_config(resolved(compose("train", words)))
    Policy.from_pretrained(train(run, tmp_path / "run", 0.0)).save_pretrained(tmp_path / "weights")
    words = [f"checkpoint={tmp_path / 'weights'}", "dataset=sample", f"output={tmp_path}"]
    inspection = Inspection.from_config(resolved(compose("inspect", [*words, "chunks=1"])))
    result = check_open_loop(inspection, console)
    step = int(result.steps[0])
    assert (result.recorded[0] == sample.action_chunk(0, step, 20, 1)[0]).all()
    show_checkpoint(tmp_path / "weights", console)
    assert "action_offset=1" in console.export_text()


@pytest.mark.parametrize("wrong", [2, True, "1", None])
def test_a_wrong_action_offset_of_a_checkpoint_is_refused(wrong: object) -> None:
    policy = small_policy("pi05")
    assert action_offset_of(policy) == 0
    policy.config["data"] = {"action_offset": wrong}
    with pytest.raises(UserError, match=r"data\.action_offset=.*; expected 0 or 1"):
        action_offset_of(policy)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ([], "Name one thing"),
        (["dataset=sample", "checkpoint=/nowhere"], "No checkpoint at /nowhere"),
        (["checkpoint=/nowhere"], "No checkpoint at /nowhere"),
        (["dataset=/nowhere"], "No LeRobot dataset"),
    ],
)
def test_nothing_to_inspect_is_explained(overrides: list[str], message: str) -> None:
    with pytest.raises(UserError, match=message):
        main(compose("inspect", overrides))


def test_a_place_outside_the_data_is_refused(sample: EpisodeSource) -> None:
    assert check_place(sample, 0, None) == (0, int(sample.lengths[0]) - 1)
    with pytest.raises(UserError, match="episodes 0 … 3"):
        check_place(sample, 4, 0)
    with pytest.raises(UserError, match="frames 0 … 172"):
        check_place(sample, 0, 173)
