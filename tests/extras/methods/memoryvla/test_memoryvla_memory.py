"""MemoryVLA with a memory of the library in place of its banks: it learns, acts, is served and
probed as any policy.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from helpers.memoryvla_golden import reached
from mme_vla import UserError, build_policy
from mme_vla.config.composition import compose
from mme_vla.extras.methods.memoryvla.model import MemoryVlaCore, RecallingCore
from mme_vla.extras.methods.memoryvla.policy import MemoryVlaPolicy
from mme_vla.memory.base import full_history, stack_history
from mme_vla.policy.build import build_from_config, policy_words
from mme_vla.testing.small import BEYOND_MEMORIES, moving_frames
from mme_vla.training.data import check_frozen, prepare_data
from mme_vla.training.settings import DataSettings
from mme_vla.types import HistoryTokens
from mme_vla.weights.load import transfer
from mme_vla.weights.writers import write_policy


def recalling(memory: Any = "framesamp", **options: Any) -> MemoryVlaPolicy:
    return reached(memory=memory, backbone={"head": {"depth": 1}}, **options)


@pytest.fixture(scope="module")
def policy() -> MemoryVlaPolicy:
    return recalling()


def histories(policy: MemoryVlaPolicy, count: int, seed: int = 0) -> HistoryTokens:
    """Full selections of so many moments, each with features of its own."""
    full = full_history(policy.require_memory(), policy.sizes.vision.width)
    features = torch.randn(
        count, *full.features.shape[1:], generator=torch.Generator().manual_seed(seed)
    )
    return replace(full.rows(torch.zeros(count, dtype=torch.int64)), features=features)


def draws(policy: MemoryVlaPolicy, groups: int = 1) -> dict[str, torch.Tensor]:
    return policy.training_noise(groups, torch.Generator().manual_seed(0))


def noise(policy: MemoryVlaPolicy) -> dict[str, torch.Tensor]:
    return {
        name: value[None]
        for name, value in policy.sampling_noise(torch.Generator().manual_seed(0)).items()
    }


@pytest.mark.parametrize(
    "memory", ["framesamp", "tokendrop", "ttt", "rmt", *BEYOND_MEMORIES, "bank"]
)
def test_any_memory_stands_where_the_banks_stood(memory: str) -> None:
    policy = recalling(memory)
    assert policy.config["memory"]["name"] == memory
    assert isinstance(policy.core, RecallingCore) and not any(
        "_bank" in name for name, _ in policy.core.named_modules()
    )
    assert 0 < policy.require_memory().budget <= 512
    batch = policy.full_batch()
    first, again, other = (
        policy.sample_actions(replace(batch, history=histories(policy, 1, seed)), noise(policy), 2)
        for seed in (0, 0, 1)
    )
    assert torch.equal(first, again) and not torch.equal(first, other)


def test_the_loss_depends_on_what_is_remembered_and_teaches_the_memory(
    policy: MemoryVlaPolicy,
) -> None:
    batch = policy.full_batch()
    losses = [
        policy(replace(batch, history=histories(policy, 1, seed)), draws(policy))[0]
        for seed in (0, 0, 1)
    ]
    assert torch.equal(losses[0], losses[1]) and not torch.equal(losses[0], losses[2])
    policy.zero_grad()
    losses[0].backward()
    component = policy.finetune_spec.component_of
    still = [
        n for n, p in policy.named_parameters() if component(n) == "memory" and not p.grad.any()
    ]  # type: ignore[union-attr]
    # a bias of all keys alike changes no weight
    assert all(name.endswith("key.bias") for name in still), still
    policy.zero_grad()
    with pytest.raises(ValueError, match="has a memory"):
        policy(replace(batch, history=None))


@torch.no_grad()
def test_what_padding_holds_changes_nothing_and_an_empty_memory_answers_with_the_moment(
    policy: MemoryVlaPolicy,
) -> None:
    tokens = policy.encode_memory(histories(policy, 1))
    assert tokens is not None
    tokens.mask[:, 16:] = False
    filled = replace(
        tokens, tokens=tokens.tokens.masked_fill(~tokens.mask[..., None], float("nan"))
    )
    chunks = [
        policy.sample_actions(policy.full_batch(), noise(policy), 2, memory)
        for memory in (tokens, filled)
    ]
    assert torch.equal(*chunks) and chunks[0].isfinite().all()
    now = torch.randn(1, 5, policy.sizes.perceptual_width)
    assert isinstance(policy.core, RecallingCore)
    empty = replace(filled, mask=torch.zeros_like(filled.mask))
    torch.testing.assert_close(policy.core.perceptual_retrieval.read_memory(empty, now), now)


@torch.no_grad()
def test_moments_of_a_group_do_not_read_each_other(policy: MemoryVlaPolicy) -> None:
    """Unlike through banks, a group is as its moments one by one; a chunk is for its last one."""
    processor, generator = policy.require_processor(), torch.Generator().manual_seed(1)
    ids, mask = processor.prompt("press the button")
    items = [
        {
            "images": torch.randint(256, (3, 56, 56), generator=generator, dtype=torch.uint8),
            "prompt": ids,
            "prompt_mask": mask,
            "actions": torch.randn(policy.horizon, policy.action_dim, generator=generator),
            "history": histories(policy, 3).rows(i),  # type: ignore[arg-type]
            "place": (0, 0, 8 * i),
        }
        for i in range(3)
    ]  # fmt: skip
    group = processor.collate(
        [{"moments": items, "times": np.arange(3) * 8, "place": (0, 0, 16)}, items[0]]
    )
    singles = processor.collate(items)
    assert (
        group.history is not None
        and group.history.features.ndim == 4
        and group.valid.sum(1).tolist() == [3, 1]
    )
    assert singles.times.tolist() == [[0], [8], [16]]
    draws_ = draws(policy, 2)
    alone = {
        name: torch.cat(
            [value[:1, :, :3].transpose(0, 2).flatten(1, 2), value[1:, :, 0].flatten(0, 0)]
        )[:, :, None]
        for name, value in draws_.items()
    }
    together = policy(group, draws_)[0]
    apart = policy(processor.collate([*items, items[0]]), alone)[0]
    torch.testing.assert_close(together, apart)
    chunk = policy.sample_actions(group.rows(slice(0, 1)), noise(policy), 2)
    torch.testing.assert_close(
        chunk, policy.sample_actions(processor.collate(items[2:]), noise(policy), 2)
    )


def test_each_frame_of_a_group_has_the_history_of_its_step(tmp_path: Path) -> None:
    # it keeps next to no frames: a cache at once
    policy = recalling("actions", processor={"group_size": 3})
    data = OmegaConf.to_container(
        compose("train", [f"data.cache.root={tmp_path}"]).data, resolve=True
    )
    samples = prepare_data(policy, DataSettings.from_dict(data), 42, say=str).train  # type: ignore[arg-type]
    for item in (samples[0], samples.observation(40)):
        for moment, time in zip(item["moments"], item["times"].tolist(), strict=True):
            assert moment["history"].step == time == moment["history"].positions[-1, 0]


def test_an_episode_stores_as_a_sample_does_and_saves_nothing(policy: MemoryVlaPolicy) -> None:
    front, still = moving_frames(12), np.zeros((12, 8), np.float32)
    episode = policy.start_episode("press the button", seed=3)
    episode.observe({"front": front, "wrist": front}, still, np.arange(12) < 5)
    start = episode.noise_state
    chunk = policy.act(episode, 2)
    episode.noise_state = start
    np.testing.assert_array_equal(policy.act(episode, 2), chunk)
    episode.noise_state = start
    batch = replace(
        policy.observation([episode]), history=stack_history([episode.gather_selection()])
    )
    draws_ = {name: value[None] for name, value in episode.draw().items()}
    expected = policy.require_processor().absolute_actions(
        policy.sample_actions(batch, draws_, 2), torch.zeros(1, 8)
    )
    np.testing.assert_allclose(chunk, expected[0], atol=1e-5)
    other = policy.start_episode("press the button", seed=4)
    other.observe({"front": moving_frames(12, seed=9), "wrist": front}, still)
    episode.noise_state = start
    np.testing.assert_allclose(policy.act([other, episode], 2)[1], chunk, atol=1e-4)
    assert policy.frames_read(np.array([11]), 5).tolist() == list(range(12))  # type: ignore[union-attr]


def test_what_cannot_stand_there_is_refused_in_words() -> None:
    with pytest.raises(
        UserError, match="the tower of the backbone 'memoryvla' sees one image at a time"
    ):
        build_policy("memoryvla", memory="spacetime")
    with pytest.raises(UserError, match="no place for the integration 'context'"):
        build_policy("memoryvla", memory="framesamp", integration="context")
    with pytest.raises(UserError, match=r"memory\.grid=3: the backbone's 8×8 tokens"):
        build_policy("memoryvla", memory="framesamp", **{"memory.grid": 3, "memory.budget": 9})
    with pytest.raises(UserError, match="freeze_vision"):
        check_frozen(recalling(), freeze_vision=False)


@pytest.mark.parametrize(
    ("model", "words"), [("memoryvla", {}), ("memoryvla", {"memory": "ttt"}), ("openvla_oft", {})]
)
def test_what_a_checkpoint_to_start_from_lacks_is_rendered(
    model: str, words: dict[str, Any]
) -> None:
    """Training does not draw what `init_from` will replace: openvla-7b has neither
    heads nor banks.
    """
    torch.use_deterministic_algorithms(True)  # uninitialised memory is nan then
    try:
        policy = build_from_config(
            compose("policy", policy_words(model, words)), fresh_backbone=False
        )
    finally:
        torch.use_deterministic_algorithms(False)
    component = policy.finetune_spec.component_of
    waiting = {
        component(name) for name, value in policy.state_dict().items() if value.isnan().any()
    }
    assert waiting == {"vision", "vlm"}


def test_it_starts_from_a_policy_with_banks_whose_banks_stay_behind(tmp_path: Path) -> None:
    banked, policy = (
        build_policy("memoryvla", seed=1),
        build_policy("memoryvla", seed=2, memory="framesamp"),
    )
    assert isinstance(banked.core, MemoryVlaCore)  # type: ignore[union-attr]
    banked.save_pretrained(tmp_path / "ours")
    (tmp_path / "theirs").mkdir()
    write_policy(banked, tmp_path / "theirs", "memoryvla", torch.float32, None)
    for source in ("ours", "theirs"):
        took = transfer(policy, tmp_path / source)
        assert all("_bank" in name for name in took.left) and took.left
        assert {policy.finetune_spec.component_of(name) for name in took.new} == {"memory"}
        assert torch.equal(policy.core.head.output.bias, banked.core.head.output.bias)  # type: ignore[union-attr]
    with pytest.raises(UserError, match="This format has no name"):
        write_policy(policy, tmp_path / "theirs", "memoryvla", torch.float32, None)
