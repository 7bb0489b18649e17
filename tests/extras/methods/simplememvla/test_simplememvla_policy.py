"""SimpleMemVLA in a policy's hands: reading ahead, episodes, memories in the video's place,
recipes.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

pytest.importorskip("transformers", reason="needs the extra `vlm`: uv sync --inexact --extra vlm")

from helpers.prior_vla_runs import UNTESTED, losses, run
from mme_vla import UserError, build_policy
from mme_vla.config.composition import compose
from mme_vla.extras.methods.simplememvla.policy import SimpleMemVlaPolicy
from mme_vla.extras.methods.simplememvla.prompt import (
    CameraTokens,
    Robot,
    WordTokenizer,
    encode,
    instruction,
)
from mme_vla.extras.methods.simplememvla.video import TEMPORAL
from mme_vla.policy.base import Policy
from mme_vla.policy.build import build_from_config
from mme_vla.policy.finetune import apply_finetuning
from mme_vla.testing.small import unit_stats
from mme_vla.training.optim import lr_factors, make_optimizer
from mme_vla.training.settings import TrainSettings

SIDE = 32
SMALL: dict[str, Any] = {
    "processor.max_words": 4,
    "processor.seconds": 2,
    "backbone.head.depth": 1,
    "backbone.vlm.vision_config.depth": 1,
    "backbone.vlm.text_config.num_hidden_layers": 2,
    "backbone.vlm.text_config.full_attention_interval": 2,
}
WORDS = [f"{key}={value}" for key, value in SMALL.items()]


def small(**options: Any) -> SimpleMemVlaPolicy:
    """A small policy whose outputs depend on everything: what begins at zero is random."""
    policy = build_policy("simplememvla", **{**SMALL, **options})
    assert isinstance(policy, SimpleMemVlaPolicy)
    policy.require_processor().stats = unit_stats(policy.embodiment)
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for parameter in policy.action_head.parameters():
            if not parameter.any():
                parameter.normal_(std=0.1, generator=generator)
    return policy.eval()


@pytest.fixture(scope="module")
def policy() -> SimpleMemVlaPolicy:
    """For tests that change nothing in it."""
    return small()


def observations(count: int, seed: int = 0) -> tuple[dict[str, np.ndarray], np.ndarray]:
    rng = np.random.default_rng(seed)
    views = {
        name: rng.integers(0, 255, (count, SIDE, SIDE, 3), np.uint8) for name in ("front", "wrist")
    }
    return views, np.full((count, 8), 0.1, np.float32)


def observe(
    episode: Any, views: dict[str, np.ndarray], states: np.ndarray, start: int, end: int
) -> None:
    episode.observe({name: view[start:end] for name, view in views.items()}, states[start:end])


@pytest.mark.parametrize("vocabulary", ["bytes", "words"])
def test_a_prompt_has_the_same_tokens_with_a_response_as_alone(vocabulary: str) -> None:
    tokenizer, cameras = WordTokenizer.load(vocabulary), [CameraTokens("front", (1, 1), [0.5])]
    request = instruction("pick up the cube twice", Robot("arm", 20, 4), 1, 0)
    alone, learned = (
        encode(tokenizer, cameras, request, response) for response in (None, "pick up the cube")
    )
    assert alone.prompt == learned.prompt == len(alone.ids)
    np.testing.assert_array_equal(learned.ids[: learned.prompt], alone.ids)
    assert tokenizer.decode(learned.ids[learned.prompt :].tolist()) == "pick up the cube\n"


def test_reading_ahead_changes_no_action() -> None:
    policy = small(**{"processor.seconds": 10})
    views, states = observations(200)
    ahead, base = (policy.start_episode("pick up the cube", seed=3) for _ in range(2))
    observed = 0
    for step in (0, 16, 32, 120, 136, 152, 190):
        for episode in (ahead, base):
            observe(episode, views, states, observed, step + 1)
        observed = step + 1
        np.testing.assert_allclose(policy.act(ahead), policy.act(base), atol=1e-5)
        while policy.prepare(ahead):
            pass
        planned: Any = ahead
        assert step < 32 or planned.video.ahead.length > 0


def test_an_interrupted_reading_ahead_is_continued_where_it_stopped(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("mme_vla.extras.methods.simplememvla.episode.PIECE", 2)
    policy = small(**{"processor.seconds": 20})
    views, states = observations(200)
    ahead, base = (policy.start_episode("pick up the cube", seed=3) for _ in range(2))
    for episode in (ahead, base):
        observe(episode, views, states, 0, 171)
        policy.act(episode)
    assert policy.prepare(ahead)  # more remains
    for episode in (ahead, base):
        observe(episode, views, states, 171, 187)
    np.testing.assert_allclose(policy.act(ahead), policy.act(base), atol=1e-5)


def test_what_an_episode_keeps_does_not_grow_beyond_its_window(policy: SimpleMemVlaPolicy) -> None:
    window = policy.require_processor().window
    views, states = observations(240)
    episode: Any = policy.start_episode("pick up the cube")
    retained = []
    for step in range(0, 240, 16):
        observe(episode, views, states, max(step - 15, 0), step + 1)
        policy.act(episode)
        while policy.prepare(episode):
            pass
        retained.append((len(episode.video.frames), len(episode.video.patches)))
    assert all(frames <= window.span + 1 for frames, _ in retained)
    assert len({patches for _, patches in retained[-10:]}) == 1


def test_a_full_window_that_moved_on_forgets_the_first_frame(policy: SimpleMemVlaPolicy) -> None:
    span = policy.require_processor().window.span
    views, states = observations(span + 2)
    other = {name: view.copy() for name, view in views.items()}
    other["front"][0] = 0
    chunks = {}
    for name, frames in (("views", views), ("other", other)):
        for step in (span, span + 1):
            episode = policy.start_episode("pick up the cube", seed=1)
            observe(episode, frames, states, 0, step + 1)
            chunks[name, step] = policy.act(episode)
    assert not np.array_equal(chunks["views", span], chunks["other", span])
    np.testing.assert_array_equal(chunks["views", span + 1], chunks["other", span + 1])


def test_only_frames_of_the_video_need_to_be_rendered(policy: SimpleMemVlaPolicy) -> None:
    views, states = observations(60)
    read = policy.frames_read(np.array([59]), 0)
    assert read.tolist() == policy.require_processor().frames(59).tolist()
    full, sparse = (policy.start_episode("pick up the cube", seed=1) for _ in range(2))
    observe(full, views, states, 0, 60)
    rendered = {"front": read, "wrist": np.array([59])}
    sparse.observe(
        {name: views[name][index] for name, index in rendered.items()}, states, rendered=rendered
    )
    np.testing.assert_array_equal(policy.act(full), policy.act(sparse))
    bare = policy.start_episode("pick up the cube", seed=1)
    rendered["front"] = read[1:]
    bare.observe(
        {name: views[name][index] for name, index in rendered.items()}, states, rendered=rendered
    )
    with pytest.raises(UserError, match="not rendered or not observed"):
        policy.act(bare)


def test_without_video_the_past_does_not_count() -> None:
    policy = small(**{"processor.video": False})
    views, states = observations(30)
    other = {name: np.concatenate([255 - view[:29], view[29:]]) for name, view in views.items()}
    chunks = []
    for frames in (views, other):
        episode = policy.start_episode("pick up the cube", seed=1)
        observe(episode, frames, states, 0, 30)
        chunks.append(policy.act(episode))
    np.testing.assert_array_equal(chunks[0], chunks[1])
    assert len(policy.frames_read(np.arange(30), 0)) == 0 and not policy.prepare(episode)


def test_rows_of_a_batch_keep_their_temporal_patches(policy: SimpleMemVlaPolicy) -> None:
    batch = policy.full_batch()
    assert torch.equal(batch.rows(torch.tensor([0, 0])).video[: len(batch.video)], batch.video)  # type: ignore[index, arg-type]
    assert batch.rows(slice(0, 1)).patches == batch.patches


MEMORIES: dict[str, list[str]] = {
    "tokendrop": ["memory.grid=2", "memory.budget=8"],
    "ttt": ["memory.grid=2", "memory.budget=8", "memory.max_steps=4", "memory.stride=1"],
}


@pytest.mark.parametrize("memory", MEMORIES)
def test_a_memory_of_the_paper_in_the_videos_place(memory: str, tmp_path: Path) -> None:
    """It builds, trains two updates over the same backbone and head, and samples."""
    words = [*WORDS, f"memory={memory}", *MEMORIES[memory], "train.steps=2", "train.batch_size=2"]
    checkpoint = run("simplememvla", tmp_path / "run", *words, short=UNTESTED)
    assert len(losses(tmp_path / "run")) == 2 and np.isfinite(losses(tmp_path / "run")).all()
    policy = Policy.from_pretrained(checkpoint)
    assert policy.config["memory"]["name"] == memory
    assert isinstance(policy, SimpleMemVlaPolicy) and policy.memory is not None
    views, states = observations(6)
    episode = policy.start_episode("pick up the cube", seed=1)
    observe(episode, views, states, 0, 6)
    tokens = policy.observation([episode])
    assert int((tokens.kinds == 3).sum()) == policy.memory.budget
    assert (
        policy.act(episode, 2).shape == (policy.horizon, 8)
        and np.isfinite(policy.act(episode, 2)).all()
    )
    with torch.no_grad():
        assert policy.memory_proj is not None
        policy.memory_proj.weight.normal_()
        for parameter in policy.action_head.final_layer.parameters():
            parameter.fill_(0.1)
    past = {**views, "front": np.concatenate([255 - views["front"][:-1], views["front"][-1:]])}
    chunks = []
    for frames in (views, past):
        episode = policy.start_episode("pick up the cube", seed=1)
        observe(episode, frames, states, 0, 6)
        chunks.append(policy.act(episode, 2))
    assert not np.array_equal(chunks[0], chunks[1])


def test_lora_trains_adapters_of_the_language_model_and_the_head() -> None:
    policy = small()
    counts = apply_finetuning(policy, "lora", rank=2, alpha=2.0)
    assert counts["vision"] == 0 < counts["vlm"] < 50_000 and counts["action"] == sum(
        parameter.numel() for parameter in policy.action_head.parameters()
    )
    batch = policy.full_batch()
    loss, _ = policy.train()(batch)
    loss.backward()
    assert all(
        p.grad is not None
        for name, p in policy.named_parameters()
        if p.requires_grad and "lora_B" in name
    )


def test_a_language_model_without_delta_nets_generates() -> None:
    policy = small(**{"backbone.vlm.text_config.full_attention_interval": 1})
    episode = policy.start_episode("pick up the cube", seed=1)
    observe(episode, *observations(20), 0, 20)
    assert np.isfinite(policy.act(episode)).all()


def test_a_lora_training_lowers_the_loss_and_changes_adapters_and_the_head_alone(
    tmp_path: Path,
) -> None:
    words = [
        *WORDS,
        "finetune=simplememvla",
        "train.steps=30",
        "train.batch_size=2",
        "train.lr=2e-3",
        "train.warmup=2",
    ]
    trained = Policy.from_pretrained(run("simplememvla", tmp_path / "run", *words, short=UNTESTED))
    values = losses(tmp_path / "run")
    assert len(values) == 30 and np.mean(values[-10:]) < 0.95 * np.mean(values[:10])
    fresh = dict(
        build_from_config(compose("train", ["model=simplememvla", *words])).named_parameters()
    )
    weights = {
        name.replace(".base_layer.", "."): value for name, value in trained.named_parameters()
    }
    adapters = {name for name in weights if ".lora_" in name}
    assert adapters and all(weights[name].any() for name in adapters)
    changed = {name for name in fresh if not torch.equal(weights[name], fresh[name])}
    assert changed and all(name.startswith("action_head.") for name in changed)
    episode = trained.start_episode("pick up the cube", seed=1)
    observe(episode, *observations(20), 0, 20)
    assert np.isfinite(trained.act(episode)).all()


def test_the_recipe_has_two_learning_rates(policy: SimpleMemVlaPolicy) -> None:
    cfg = compose("train", ["experiment=simplememvla"])
    assert (
        cfg.name == "simplememvla"
        and cfg.backbone.horizon == 30
        and cfg.embodiment.action.execute == 16
    )
    settings = TrainSettings(
        steps=1, batch_size=1, lr=5e-5, part_lr={"vision": 0.1, "vlm": 0.1}, decay_min_dim=2
    )
    named = dict(policy.named_parameters())
    optimizer = make_optimizer(
        named.values(), settings, lr_factors(named, policy.finetune_spec, settings)
    )
    factors = {
        id(p): group.get("lr_factor", 1.0)
        for group in optimizer.param_groups
        for p in group["params"]
    }
    assert {factors[id(p)] for name, p in named.items() if name.startswith("backbone.")} == {0.1}
    assert {factors[id(p)] for name, p in named.items() if name.startswith("action_head.")} == {1.0}
    with pytest.raises(UserError, match=r"train\.part_lr names 'tower'"):
        lr_factors(
            named,
            policy.finetune_spec,
            TrainSettings(steps=1, batch_size=1, lr=1.0, part_lr={"tower": 1.0}),
        )


def test_a_video_of_another_rate_is_refused() -> None:
    with pytest.raises(UserError, match=r"processor\.native_fps=15.*20 frames per second"):
        build_policy("simplememvla", **SMALL, **{"processor.native_fps": 15})


def test_data_of_another_rate_are_refused(tmp_path: Path) -> None:
    words = [*WORDS, "embodiment.fps=10", "train.steps=1", "train.batch_size=1"]
    with pytest.raises(UserError, match=r"20 frames per second and embodiment\.fps=10"):
        run("simplememvla", tmp_path / "run", *words, short=UNTESTED)


def test_it_acts_in_bfloat16(policy: SimpleMemVlaPolicy, tmp_path: Path) -> None:
    policy.save_pretrained(tmp_path / "saved")
    rounded = Policy.from_pretrained(tmp_path / "saved", dtype="bfloat16")
    views, states = observations(70)
    episode = rounded.start_episode("pick up the cube", seed=1)
    observe(episode, views, states, 0, 50)
    assert np.isfinite(rounded.act(episode)).all()
    rounded.prepare(episode)  # type: ignore[operator]
    observe(episode, views, states, 50, 66)
    assert np.isfinite(rounded.act(episode)).all()


def test_a_policy_comes_back_from_its_folder(policy: SimpleMemVlaPolicy, tmp_path: Path) -> None:
    policy.save_pretrained(tmp_path / "saved")
    again = Policy.from_pretrained(tmp_path / "saved")
    views, states = observations(25)
    chunks = []
    for loaded in (policy, again):
        episode = loaded.start_episode("pick up the cube", seed=1)
        observe(episode, views, states, 0, 25)
        chunks.append(loaded.act(episode))
    np.testing.assert_array_equal(chunks[0], chunks[1])
    assert policy.require_processor().frames(24).size % TEMPORAL == 0
