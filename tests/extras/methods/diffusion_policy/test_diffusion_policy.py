"""`diffusion_policy` comes back from a folder, acts in episodes, and hands its weights on."""

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

pytest.importorskip("diffusers")


from helpers.memory_fakes import same
from mme_vla import Policy, UserError, build_policy, load_weights
from mme_vla.cli.weights import convert
from mme_vla.config.composition import compose
from mme_vla.data.dataset import TrainingDataset
from mme_vla.data.episodes import EpisodeSource
from mme_vla.data.sources import open_sources
from mme_vla.extras.methods.diffusion_policy.policy import DiffusionPolicy
from mme_vla.testing.small import moving_frames, unit_stats


def ready(name: str = "diffusion_policy", **overrides: Any) -> DiffusionPolicy:
    policy = build_policy(name, **overrides)
    assert isinstance(policy, DiffusionPolicy)
    policy.require_processor().stats = unit_stats(policy.embodiment)
    return policy


@pytest.fixture(scope="module")
def policy() -> DiffusionPolicy:
    return ready()


def views(count: int, seed: int = 0) -> dict[str, np.ndarray]:
    return {"front": moving_frames(count, seed=seed), "wrist": moving_frames(count, seed=seed + 1)}


def test_weights_go_to_the_authors_format_and_back(policy: DiffusionPolicy, tmp_path: Path) -> None:
    policy.save_pretrained(tmp_path / "ours")
    convert(tmp_path / "ours", tmp_path / "theirs", to="diffusion_policy")
    saved = torch.load(tmp_path / "theirs" / "model.pth", weights_only=True)
    wrapped = {f"module._orig_mod.{name}": value for name, value in saved["model"].items()}
    torch.save({**saved, "model": wrapped}, tmp_path / "theirs" / "model.pth")
    other = build_policy("diffusion_policy", seed=1)
    load_weights(other, tmp_path / "theirs")
    assert same(policy, other)
    convert(tmp_path / "theirs", tmp_path / "back", ["backbone=dp_tiny"])
    back = Policy.from_pretrained(tmp_path / "back")
    assert torch.equal(
        back.state_dict()["backbone.unet.final_conv.1.weight"],
        saved["model"]["policy.final_conv.1.weight"],
    )
    loaded, original = (each.require_processor().require_stats() for each in (back, policy))
    np.testing.assert_array_equal(loaded.actions.max, original.actions.max)


def test_an_episode_sees_what_training_shows() -> None:
    policy = ready("diffusion_policy_obs2")
    (source,) = open_sources(["sample"], policy.embodiment)
    data = TrainingDataset([source], policy.require_processor())
    for index in (5, 0):  # the first step of an episode with a video has no frame before it
        check_window(policy, source, data[index])


def check_window(policy: DiffusionPolicy, source: EpisodeSource, item: dict[str, Any]) -> None:
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
    policy, images, states = (
        ready("diffusion_policy_obs2"),
        views(9),
        np.linspace(0, 1, 9, dtype=np.float32),
    )
    states = np.repeat(states[:, None], 8, 1)
    processor = policy.require_processor()
    batches = {}
    for consecutive in (True, False):
        processor.samples = replace(processor.samples, consecutive=consecutive)
        episode = policy.start_episode("push the button")
        episode.observe(
            {name: of[:3] for name, of in images.items()}, states[:3], np.array([True, True, False])
        )
        first = episode.window[1]
        assert torch.equal(first[0], first[1]), (
            "the video is no part of it: the first frame means those before"
        )
        in_pieces = policy.start_episode("push the button")
        for frame, demo in enumerate((True, True, False)):
            in_pieces.observe(
                {name: of[frame : frame + 1] for name, of in images.items()}, states[[frame]], demo
            )
        assert torch.equal(in_pieces.window[1], first), "however it is observed"
        policy.act(episode)
        for piece in (slice(3, 6), slice(6, 9)):
            episode.observe({name: of[piece] for name, of in images.items()}, states[piece])
        batches[consecutive] = episode.window[1][:, 0].tolist()
    assert batches == {True: [states[7, 0], states[8, 0]], False: [states[2, 0], states[8, 0]]}
    assert policy.act(episode).shape == (policy.horizon - 1, 8), (
        "a chunk begins a frame before the current one"
    )


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


def test_a_batch_is_cropped_at_one_place_and_the_centre_when_acting(
    policy: DiffusionPolicy,
) -> None:
    ramp = (
        torch.arange(72 * 72)
        .reshape(72, 72)
        .remainder(251)
        .to(torch.uint8)
        .expand(2, 1, 2, 3, 72, 72)
    )
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


@pytest.mark.parametrize("module", ["diffusers", "torchvision.models"])
def test_a_missing_package_is_named_with_its_extra(
    module: str, monkeypatch: pytest.MonkeyPatch
) -> None:
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
