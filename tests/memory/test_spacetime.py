"""Spacetime: past images in the vision tower and past states as tokens, as LeRobot's
π0.5 has it.
"""

import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

from helpers.lerobot_window import (
    ONLY,
    RECORDED,
    SETTINGS,
    VISION,
    as_batch,
    inputs,
    weights,
    window_policy,
)
from helpers.union_frames import both_ways
from mme_vla import UserError, build_policy
from mme_vla.data.dataset import TrainingDataset, collate
from mme_vla.data.sources import open_sources
from mme_vla.memory.history import CachedHistory
from mme_vla.policy.mme import MMEPolicy
from mme_vla.testing.small import SMALL_VISION, moving_frames, random_batch, small_policy
from mme_vla.weights.load import load_weights, transfer

SHORT = {"frames": 3, "stride": 5}


@cache
def small(model: str = "spacetime_context", **words: Any) -> MMEPolicy:
    return small_policy(
        model, memory=SHORT, backbone={"vision": SMALL_VISION | {"depth": 2}}, **words
    )


def as_lerobots(only: str, folder: Path, **settings: Any) -> Path:
    """A checkpoint of LeRobot's, of the settings and weights that were recorded."""
    views, states = ONLY[only]
    about = {
        "type": "pi05",
        "use_visual_memory": views,
        "use_proprioceptive_memory": states,
        **SETTINGS,
        **settings,
    }
    save_file(weights(window_policy(views, states)), folder / "model.safetensors")
    (folder / "config.json").write_text(json.dumps(about))
    return folder


# LeRobot


@pytest.mark.slow
@torch.no_grad()
@pytest.mark.parametrize("only", ONLY)
def test_a_checkpoint_of_lerobots_loads_completely_and_acts_as_it_does_there(
    only: str, tmp_path: Path
) -> None:
    policy = load_weights(window_policy(*ONLY[only]), as_lerobots(only, tmp_path)).eval()
    expected = torch.tensor(json.loads(RECORDED.read_text())[only])
    batch = as_batch(policy)
    chunk = policy.sample_actions(batch, inputs()["noise"])
    assert expected.std() > 0.5 and float((chunk - expected).abs().max()) < 1e-4
    if batch.past is not None:
        blind = replace(batch.past, mask=torch.zeros_like(batch.past.mask))
        other = policy.sample_actions(replace(batch, past=blind), inputs()["noise"])
        assert float((other - expected).abs().max()) > 1e-2, "the past would not matter"


def test_one_that_differs_is_reported_how_to_be_built(tmp_path: Path) -> None:
    folder = as_lerobots("both", tmp_path, memory_stride=30)
    with pytest.raises(
        UserError,
        match=r"integration\.mutual=true memory\.frames=3 memory\.stride=30 memory\.every=2",
    ):
        load_weights(window_policy(True, True), folder)
    with pytest.raises(UserError, match=r"memoryless π0\.5 and this policy has a memory"):
        load_weights(
            window_policy(True, True),
            as_lerobots("both", tmp_path, use_visual_memory=False, use_proprioceptive_memory=False),
        )


def test_its_states_are_taken_where_tokens_are_as_wide_and_left_behind_by_name_otherwise(
    tmp_path: Path,
) -> None:
    folder, policy = as_lerobots("both", tmp_path), window_policy(True, True)
    start = transfer(policy, folder)
    assert not start.left and not start.new
    states = policy.require_memory().states  # type: ignore[union-attr]
    assert torch.equal(states.weight, weights(policy)["model.proprio_history_proj.weight"])
    sizes = {"num_heads": 8, "vision": VISION}
    narrow = small_policy("spacetime_expert", backbone=sizes, integration={"width": 32})
    assert transfer(narrow, folder).left == [
        "proprio_history_proj.bias",
        "proprio_history_proj.weight",
    ]


# What is seen


@torch.no_grad()
def test_frames_before_the_episode_are_masked_and_those_in_it_are() -> None:
    policy = small()
    batch, draws = random_batch(policy), policy.training_noise(2, torch.Generator().manual_seed(0))
    assert batch.past is not None and not batch.past.mask[0, 0]
    policy.eval()
    baseline = float(policy(batch, draws)[0])

    def changed(row: int, frame: int) -> float:
        assert batch.past is not None
        images = batch.past.images.clone()
        images[row, frame] = 255 - images[row, frame]
        return float(policy(replace(batch, past=replace(batch.past, images=images)), draws)[0])

    assert changed(0, 0) == baseline
    assert abs(changed(0, 1) - baseline) > 1e-5 and abs(changed(1, 0) - baseline) > 1e-5


@torch.no_grad()
def test_a_clip_of_one_frame_is_an_image() -> None:
    tower, images = small().backbone.vision, torch.rand(2, 3, 64, 64) * 2 - 1
    alone = tower(images[:, None], torch.ones(2, 1, dtype=torch.bool), 2)
    assert torch.allclose(alone, tower(images), atol=1e-5)


def test_augmentation_changes_past_views_as_it_does_the_current_ones() -> None:
    policy = small()
    batch = random_batch(policy)
    assert batch.past is not None
    still = batch.images[:, None].expand_as(batch.past.images)
    draws_ = torch.rand(2, 7, generator=torch.Generator().manual_seed(1))
    current = policy.model.prepare_images(
        replace(batch, past=replace(batch.past, images=still)), draws_
    )
    views = current.images
    assert current.past is not None and not torch.equal(
        views, policy.model.prepare_images(batch).images
    )
    assert torch.equal(current.past.images[:, 0], views) and torch.equal(
        current.past.images[:, 1], views
    )


def test_an_episode_sees_what_the_dataset_shows_and_its_pieces_make_no_difference() -> None:
    policy, source = small(), open_sources(["sample"])[0]
    processor = policy.require_processor()
    memory = policy.require_memory()
    cached = np.zeros((1, 1, policy.backbone.vision_width), np.float32)

    class Cache:
        def history(self, episode: int) -> CachedHistory:
            length = int(source.lengths[episode])
            return CachedHistory(memory.storage, cached, np.zeros(1, np.int64), length, None, start)

    start = int(source.exec_starts[0])
    dataset = TrainingDataset([source], processor, memory, [Cache()])  # type: ignore[list-item]
    for index in (0, 12):
        step, batch = dataset.step(index), collate([dataset[index]])
        frames = np.arange(step.index + 1)
        views = {name: source.frames(0, frames, name) for name in processor.embodiment.camera_names}
        states, demo = source.states(0, 0, len(frames)), frames < start
        for piece in (len(frames), 7):
            episode = policy.start_episode(step.goal, seed=1)
            for at in range(0, len(frames), piece):
                part = slice(at, at + piece)
                episode.observe(
                    {name: view[part] for name, view in views.items()}, states[part], demo[part]
                )
            observation = policy.observation([episode])
            assert (
                observation.past is not None
                and batch.past is not None
                and batch.history is not None
            )
            assert torch.equal(observation.past.images, batch.past.images) and torch.equal(
                observation.past.mask, batch.past.mask
            )
            assert torch.allclose(
                episode.gather_selection().features, batch.history.features[0], atol=1e-6
            )


@pytest.mark.parametrize("model", ["spacetime_context", "spacetime_modul"])
def test_a_rollout_renders_past_views_of_every_camera_and_nothing_changes(model: str) -> None:
    *everything, video, full = both_ways(small(model))
    assert video["front"] == video["wrist"] and full["front"] == full["wrist"]
    assert full["front"] < everything[1]["front"] / 2


def test_it_joins_with_others_and_two_that_read_past_frames_are_refused() -> None:
    words: dict[str, Any] = {"backbone": {"vision": SMALL_VISION}, "integration": "expert"}
    members: list[Any] = [
        {"name": "framesamp", "budget": 64, "grid": 4},
        {"name": "spacetime", **SHORT},
    ]
    policy = small_policy("framesamp_ttt_modul", memory={"members": members}, **words)
    frames, states, chunks = moving_frames(30), np.zeros((30, 8), np.float32), []
    for piece in (30, 8):
        episode = policy.start_episode("press the button", seed=2)
        for at in range(0, 30, piece):
            part = slice(at, at + piece)
            episode.observe({"front": frames[part], "wrist": frames[part]}, states[part])
        assert policy.observation([episode]).past is not None
        chunks.append(policy.act(episode))
    assert np.abs(chunks[0] - chunks[1]).max() < 1e-4
    with pytest.raises(UserError, match="join only one of them"):
        small_policy("framesamp_ttt_modul", memory={"members": [members[1], members[1]]}, **words)


# What is refused


def test_where_it_has_no_place_a_sentence_says_so() -> None:
    with pytest.raises(UserError, match="'nano' sees one image at a time"):
        build_policy("spacetime_modul", backbone="nano", device="meta")
    with pytest.raises(UserError, match="produces no tokens with these settings"):
        build_policy("spacetime_context", memory={"states": False}, device="meta")
    with pytest.raises(UserError, match="leave nothing to remember"):
        build_policy("spacetime_context", memory={"states": False, "views": False}, device="meta")
    with pytest.raises(UserError, match="a memory without an integration"):
        build_policy("spacetime_context", integration="none", device="meta")
    with pytest.raises(UserError, match=r"integration\.mutual=true"):
        build_policy(
            "framesamp_context",
            integration={"mutual": True, "memory_position": "time"},
            device="meta",
        )


def test_past_frames_of_one_camera_are_not_enough() -> None:
    episode = small().start_episode("press the button")
    images = moving_frames(4)
    with pytest.raises(UserError, match="of every camera"):
        episode.add_frames(images)
    with pytest.raises(UserError, match="of every camera"):
        episode.set_view({"front": images[0], "wrist": images[0]}, np.zeros(8))
    rendered = {"front": np.arange(8), "wrist": np.array([7])}
    both = {"front": np.concatenate([images, images]), "wrist": images[:1]}
    episode.observe(both, np.zeros((8, 8), np.float32), rendered=rendered)
    with pytest.raises(UserError, match=r"looks back at the frames \[2\]"):
        small().act(episode)
