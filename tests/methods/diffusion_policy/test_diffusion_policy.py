"""`diffusion_policy` learns, resumes, comes back from a folder, acts in episodes, and hands its weights on."""

import sys
import time
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from omegaconf import DictConfig, OmegaConf

pytest.importorskip("diffusers")

from rich.console import Console

from helpers.rollout_fakes import JOBS, InlineEnvs, roll
from helpers.serving_fakes import Served, acted_directly, challenge, course
from mme_vla import MMEPolicy, Policy, UserError, build_policy, load_weights
from mme_vla.cli.inspect import show_checkpoint
from mme_vla.cli.train import train
from mme_vla.cli.weights import convert
from mme_vla.config.composition import compose
from mme_vla.data.dataset import TrainingDataset
from mme_vla.data.sources import open_sources
from mme_vla.methods.diffusion_policy.policy import DiffusionPolicy
from mme_vla.policy.tensor_files import load_tensors
from mme_vla.testing.small import moving_frames, unit_stats

SHORT = [
    "logger=none", "train.batch_size=2", "train.workers=0", "train.device=cpu", "train.val_samples=2",
    "train.log_every=1", "backbone.diffusion_steps=4",
]  # fmt: skip


RECIPE = ["train.schedule=cosine", "train.schedule_steps=3", "train.warmup_from_zero=true", "train.warmup=1",
          "train.decay_min_dim=2", "train.ema_warmup=true", "train.weight_decay=1e-2"]  # fmt: skip


def ready(name: str = "diffusion_policy", **overrides: Any) -> DiffusionPolicy:
    policy = build_policy(name, **overrides)
    assert isinstance(policy, DiffusionPolicy)
    policy.require_processor().stats = unit_stats(policy.embodiment)
    return policy


@pytest.fixture(scope="module")
def policy() -> DiffusionPolicy:
    return ready()


@cache
def composed() -> DictConfig:
    return compose("train", ["model=diffusion_policy", *SHORT, *RECIPE])


def run(folder: Path, steps: int, resume: Path | None = None, chunks: int = 0) -> Path:
    """Train so many updates with the authors' recipe in small, drawing so many chunks; the last checkpoint."""
    cfg = composed().copy()
    cfg.train.open_loop_chunks, cfg.train.val_samples = chunks, 2 * chunks
    cfg.train.steps, cfg.resume = steps, None if resume is None else str(resume)
    config: Any = OmegaConf.to_container(cfg, resolve=True)
    return train(cfg, config, folder, begun=time.perf_counter())


def views(count: int, seed: int = 0) -> dict[str, np.ndarray]:
    return {"front": moving_frames(count, seed=seed), "wrist": moving_frames(count, seed=seed + 1)}


def test_it_trains_on_the_sample_and_resumes_to_the_bit(tmp_path: Path) -> None:
    straight = run(tmp_path / "whole", 3, chunks=1)
    run(tmp_path / "parts", 2)
    resumed = load_tensors(run(tmp_path / "unused", 3, resume=tmp_path / "parts"))
    for name, tensor in load_tensors(straight).items():
        assert torch.equal(tensor, resumed[name]), name
    again = Policy.from_pretrained(straight)
    assert isinstance(again, DiffusionPolicy) and again.require_processor().stats is not None
    assert again.embodiment.action.execute == 8
    console = Console(record=True, width=200)
    show_checkpoint(straight, console)
    output = console.export_text()
    assert all(word in output for word in ("encoder", "text", "action", "hashed", "11,305,900"))
    with pytest.raises(UserError, match=r"holds a 'diffusion_policy' policy.*Policy.from_pretrained"):
        MMEPolicy.from_pretrained(straight)


def test_weights_go_to_the_authors_format_and_back(policy: DiffusionPolicy, tmp_path: Path) -> None:
    policy.save_pretrained(tmp_path / "ours")
    convert(tmp_path / "ours", tmp_path / "theirs", to="diffusion_policy")
    saved = torch.load(tmp_path / "theirs" / "model.pth", weights_only=True)
    wrapped = {f"module._orig_mod.{name}": value for name, value in saved["model"].items()}
    torch.save({**saved, "model": wrapped}, tmp_path / "theirs" / "model.pth")
    other = build_policy("diffusion_policy", seed=1)
    load_weights(other, tmp_path / "theirs")
    for name, tensor in policy.state_dict().items():
        assert torch.equal(tensor, other.state_dict()[name]), name
    convert(tmp_path / "theirs", tmp_path / "back", ["backbone=dp_tiny"])
    back = Policy.from_pretrained(tmp_path / "back")
    assert torch.equal(
        back.state_dict()["backbone.unet.final_conv.1.weight"], saved["model"]["policy.final_conv.1.weight"]
    )
    loaded, original = (each.require_processor().require_stats() for each in (back, policy))
    np.testing.assert_array_equal(loaded.actions.max, original.actions.max)


def test_a_pth_of_objects_is_not_run(policy: DiffusionPolicy, tmp_path: Path) -> None:
    torch.save({"model": Path("x")}, tmp_path / "model.pth")
    with pytest.raises(UserError, match="objects, which are code"):
        load_weights(policy, tmp_path / "model.pth")


def test_an_episode_sees_what_training_shows() -> None:
    policy = ready("diffusion_policy_obs2")
    (source,) = open_sources(["sample"], policy.embodiment)
    data = TrainingDataset([source], policy.require_processor())
    item = data[5]
    _, number, frame = item["place"]
    start = int(source.exec_starts[number])
    frames = np.arange(start, frame + 1)
    views = {name: source.frames(number, frames, name) for name in policy.embodiment.camera_names}
    episode = policy.start_episode(item["goal"])
    episode.observe(views, source.states(number, start, frame + 1))
    images, states = episode.window
    assert torch.equal(images, item["images"])
    assert torch.equal(policy.require_processor().states(states), item["state"])
    assert torch.equal(episode.prompt, item["text"])


def test_the_window_holds_consecutive_frames_or_those_it_was_requested_at() -> None:
    policy, images, states = ready("diffusion_policy_obs2"), views(9), np.linspace(0, 1, 9, dtype=np.float32)
    states = np.repeat(states[:, None], 8, 1)
    processor = policy.require_processor()
    batches = {}
    for consecutive in (True, False):
        processor.samples = replace(processor.samples, consecutive=consecutive)
        episode = policy.start_episode("push the button")
        episode.observe({name: of[:3] for name, of in images.items()}, states[:3], np.array([True, True, False]))
        first = episode.window[1]
        assert torch.equal(first[0], first[1]), "the video is no part of it: the first frame means those before"
        episode.observe({name: of[3:] for name, of in images.items()}, states[3:])
        batches[consecutive] = episode.window[1][:, 0].tolist()
    assert batches == {True: [states[7, 0], states[8, 0]], False: [states[2, 0], states[8, 0]]}
    assert policy.act(episode).shape == (policy.horizon - 1, 8), "a chunk begins a frame before the current one"


def test_batching_changes_no_episode(policy: DiffusionPolicy) -> None:
    def episodes() -> list[Any]:
        begun = []
        for seed in (0, 1):
            episode = policy.start_episode("stop the cube", seed)
            episode.observe(views(1, seed), np.full((1, 8), 0.1, np.float32))
            begun.append(episode)
        return begun

    together = policy.act(episodes(), 5)
    alone = [policy.act(episode, 5) for episode in episodes()]
    np.testing.assert_allclose(together, alone, atol=1e-5)
    assert not np.allclose(alone[0], alone[1], atol=1e-3)


def test_a_batch_is_cropped_at_one_place_and_the_centre_when_acting(policy: DiffusionPolicy) -> None:
    ramp = torch.arange(72 * 72).reshape(72, 72).remainder(251).to(torch.uint8).expand(2, 1, 2, 3, 72, 72)
    centre = policy._cropped_images(ramp, None)
    assert torch.equal(centre, policy._cropped_images(ramp, (4, 4)))
    policy.train()
    try:
        torch.manual_seed(0)
        crops = [policy._cropped_images(ramp, None) for _ in range(8)]
    finally:
        policy.eval()
    assert len({crop.flatten()[0].item() for crop in crops}) > 1
    assert all((crop == crop[:1, :, :1]).all() for crop in crops)


def test_rollouts_execute_half_a_chunk(policy: DiffusionPolicy) -> None:
    (record,) = roll(policy, JOBS[:1], InlineEnvs(max_steps=20))
    assert policy.embodiment.action.execute == policy.horizon // 2 == 8
    assert record.steps > 8 and record.extra["chunks"] == -(-record.steps // 8)


def test_it_is_served_as_it_acts(policy: DiffusionPolicy) -> None:
    (front, wrist, state), *_ = parts = course(video=0, rounds=1)
    with Served(policy) as served, served.client() as client:
        chunk = client.infer(challenge(front, wrist, state, True))["actions"]
    expected = acted_directly(policy, parts[:1])[0]
    np.testing.assert_allclose(chunk, expected[: policy.embodiment.action.execute], atol=1e-5)


@pytest.mark.parametrize("module", ["diffusers", "torchvision.models"])
def test_a_missing_package_is_named_with_its_extra(module: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(UserError, match="extra `baselines`"):
        build_policy("diffusion_policy")


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["backbone=tiny"], "no network of Diffusion Policy"),
        (["backbone.widths=[16,24]", "embodiment.action.horizon=15"], "must be a multiple of 2"),
        (["backbone.kernel=4"], "must be odd"),
        (["backbone.groups=7"], "no multiple of backbone.groups=7"),
        (["processor.frames=some"], "processor.frames='some'"),
        (["processor.window=0"], "processor.window=0"),
    ],
)
def test_what_cannot_be_is_reported(words: list[str], says: str) -> None:
    from mme_vla.policy.build import build_from_config

    with pytest.raises(UserError, match=says):
        build_from_config(compose("policy", ["model=diffusion_policy", *words]))
