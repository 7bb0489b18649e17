"""A policy has a model: the same modules under the same names, the same loss, and a short way to a
sampled chunk.
"""

import copy
import re
import sys
import traceback
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
import pytest
import torch

from mme_vla import MMEPolicy, UserError
from mme_vla.memory.base import stack_history
from mme_vla.model import MMEModel, unit_images
from mme_vla.testing.small import moving_frames, random_batch, small_policy
from mme_vla.types import MemoryTokens


@pytest.fixture
def policy() -> MMEPolicy:
    return small_policy("framesamp_modul", memory={"budget": 64})


def test_weights_have_the_names_of_the_model_without_a_prefix(policy: MMEPolicy) -> None:
    assert policy.state_dict().keys() == policy.model.state_dict().keys()
    assert {name.split(".")[0] for name in policy.state_dict()} == {
        "backbone",
        "memory",
        "integration",
    }


def test_a_part_that_is_replaced_is_replaced_in_the_model(policy: MMEPolicy) -> None:
    other = small_policy("framesamp_modul", memory={"budget": 32}).memory
    policy.memory = other
    assert policy.model.memory is other
    twin = copy.deepcopy(policy)
    assert twin.model.memory is twin.memory is not other


def test_mode_and_precision_are_those_of_the_model(policy: MMEPolicy) -> None:
    for mode in (True, False):
        assert policy.train(mode) is policy
        assert policy.model.training is policy.training is policy.memory.training is mode
    policy.compute_dtype = torch.bfloat16
    policy.loss_weights = {"write": 0.5}
    assert policy.model.compute_dtype == torch.bfloat16
    assert policy.model.loss_weights == {"write": 0.5}


def test_the_loss_of_a_policy_is_that_of_its_model(policy: MMEPolicy) -> None:
    policy.eval()
    batch = random_batch(policy, batch=2, valid=64)
    noise = policy.training_noise(2, torch.Generator().manual_seed(0))
    loss, metrics = policy(batch, noise)
    assert torch.equal(loss, policy.model(batch, noise))
    assert torch.equal(metrics["loss"], loss)


def test_missing_noise_is_sampled(policy: MMEPolicy) -> None:
    policy.eval()
    batch = random_batch(policy, batch=2, valid=64)
    torch.manual_seed(3)
    sampled = policy(batch)[0]
    torch.manual_seed(3)
    noise = policy.training_noise(2, torch.default_generator)
    assert torch.equal(sampled, policy(batch, noise)[0])
    assert torch.equal(sampled, policy(batch, noise["noise"], noise["time"])[0])


def test_a_chunk_takes_six_calls_in_four_files(
    policy: MMEPolicy, monkeypatch: pytest.MonkeyPatch
) -> None:
    project_actions: Callable[..., Any] = policy.backbone.project_actions
    stacks: list[traceback.StackSummary] = []

    def watched(hidden: torch.Tensor) -> torch.Tensor:
        stacks.append(traceback.extract_stack())
        return project_actions(hidden)

    monkeypatch.setattr(policy.backbone, "project_actions", watched)
    episode = policy.start_episode("press the button")
    frames = moving_frames(1)
    episode.observe({"front": frames, "wrist": frames}, np.zeros((1, 8), np.float32))
    policy.act([episode])
    calls = [frame for frame in stacks[0] if "mme_vla" in Path(frame.filename).parts]
    names = [frame.name for frame in calls]
    assert names == [
        "act",
        "choose_actions",
        "predict_chunk",
        "sample_actions",
        "sample",  # of the model
        "sample",  # of the backbone, which has the Euler steps
        "predict_at",
    ]
    assert len({frame.filename for frame in calls}) == 4


def test_the_model_lists_the_calls_of_a_loss_in_their_order() -> None:
    policy = small_policy("framesamp_modul")
    batch = random_batch(policy, valid=64)
    noise = policy.training_noise(2, torch.Generator().manual_seed(0))
    called: dict[str, None] = {}

    def note(frame: FrameType, event: str, _: object) -> None:
        if event == "call":
            called.setdefault(frame.f_code.co_qualname)

    sys.setprofile(note)
    try:
        policy.model.loss(batch, noise)
    finally:
        sys.setprofile(None)
    page = sys.modules[MMEModel.__module__].__doc__ or ""
    listed = re.findall(r"^    ([\w.]+) +(?:here|\w+/\w+\.py): ", page, re.MULTILINE)
    assert len(listed) == 12
    assert listed == [name for name in called if name in listed]


@pytest.mark.parametrize(
    ("field", "value", "says"),
    [
        ("weight", torch.ones(2, 1), r"Batch\.weight has shape \[2, 1\]: it must be \[2\]"),
        ("action_mask", torch.ones(2, 1).bool(), r"action_mask has shape \[2, 1\].*\[2, 20\]"),
        ("time", torch.ones(1), r"noise 'time' has shape \[1\]: it must be \[2\]"),
        ("memory", slice(0, 1), r"tokens.* has shape \[1, 64, 64\]: it must be \[2, 64, 64\]"),
    ],
)
def test_rows_that_would_be_broadcast_are_refused(
    policy: MMEPolicy, field: str, value: Any, says: str
) -> None:
    batch = random_batch(policy)
    noise = policy.training_noise(2, torch.Generator().manual_seed(0))
    memory = policy.model.memory_tokens(batch)
    assert memory is not None
    if field == "memory":
        memory = memory.rows(value)
    elif field == "time":
        noise["time"] = value
    else:
        batch = replace(batch, **{field: value})
    with pytest.raises(ValueError, match=says):
        policy.model.loss(batch, noise, memory)


def test_a_chunk_needs_noise_with_a_row_a_sample_and_a_step(policy: MMEPolicy) -> None:
    batch = random_batch(policy, 1)
    noise = policy.sampling_noise(torch.Generator().manual_seed(0))
    with pytest.raises(ValueError, match=r"noise 'noise' has shape \[20, 32\]"):
        policy.model.sample(batch, noise)
    with pytest.raises(UserError, match="steps must be a positive whole number"):
        policy.model.sample(batch, {"noise": noise["noise"][None]}, steps=0)


def test_rows_of_memory_tokens_are_rows_of_their_losses() -> None:
    memory = MemoryTokens(
        torch.ones(3, 2, 4), torch.ones(3, 2).bool(), losses={"x": torch.arange(3)}
    )
    assert memory.rows(torch.tensor([2, 0])).losses["x"].tolist() == [2, 0]


def test_words_of_a_prompt_that_is_padded_on_the_left_stay(policy: MMEPolicy) -> None:
    batch = random_batch(policy)
    batch.prompt_mask[:] = False
    batch.prompt_mask[:, -10:] = True
    cut = batch.without_prompt_padding()
    assert cut.prompt_mask.sum() == 20
    batch.prompt_mask[:] = False
    batch.prompt_mask[:, 2:5] = True
    assert batch.without_prompt_padding(4).prompt.shape[1] == 8


def test_acting_leaves_every_module_in_its_mode(policy: MMEPolicy) -> None:
    policy.train()
    policy.backbone.eval()
    modes = [module.training for module in policy.modules()]
    episode = policy.start_episode("press the button")
    frames = moving_frames(1)
    episode.observe({"front": frames, "wrist": frames}, np.zeros((1, 8), np.float32))
    policy.act(episode)
    assert [module.training for module in policy.modules()] == modes


def test_a_model_without_a_transform_refuses_augmentation() -> None:
    images = torch.zeros(1, 1, 3, 4, 4, dtype=torch.uint8)
    assert torch.equal(unit_images(images), torch.full((1, 1, 3, 4, 4), -1.0))
    with pytest.raises(ValueError, match="does not augment"):
        unit_images(images, torch.zeros(1, 2))


def test_a_backbone_that_cannot_recompute_names_the_switch(policy: MMEPolicy) -> None:
    policy.backbone = torch.nn.Identity()  # type: ignore[assignment]
    with pytest.raises(UserError, match=r"train\.gradient_checkpointing=attention: Identity"):
        policy.recompute("attention")


@torch.no_grad()
def test_memory_tokens_of_episodes_are_read_with_their_prompts(
    policy: MMEPolicy, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy.eval()
    episode = policy.start_episode("press the button", seed=0)
    frames = moving_frames(3, size=policy.backbone.image_size)
    episode.observe({"front": frames, "wrist": frames}, np.zeros((3, 8), np.float32))
    before = policy.encode_memories([episode])
    assert torch.equal(before.tokens, policy.memory(selection_of(policy, episode)).tokens)

    def with_prompt(
        self: Any, tokens: torch.Tensor, prompt: torch.Tensor, prompt_mask: torch.Tensor
    ) -> torch.Tensor:
        return tokens + (prompt * prompt_mask).sum(1)[:, None, None]

    monkeypatch.setattr(type(policy.backbone), "condition_on_prompt", with_prompt)
    batch = policy.observation([episode])
    batch.history = selection_of(policy, episode)
    valid = before.mask  # padding is conditioned in a batch alone, and never read
    tokens = policy.encode_memories([episode]).tokens[valid]
    assert torch.equal(tokens, policy.model.memory_tokens(batch).tokens[valid])
    assert not torch.equal(tokens, before.tokens[valid])


@torch.no_grad()
def test_a_stream_begins_anew_where_another_prompt_changes_the_tokens(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A new subgoal or other options: all that is remembered is read with them, as in training."""
    policy = small_policy("ttt_context").eval()

    def with_prompt(
        self: Any, tokens: torch.Tensor, prompt: torch.Tensor, prompt_mask: torch.Tensor
    ) -> torch.Tensor:
        return tokens + (prompt * prompt_mask).sum(1)[:, None, None] / 1000

    monkeypatch.setattr(type(policy.backbone), "condition_on_prompt", with_prompt)
    episode = policy.start_episode("press the button", seed=0)
    frames = moving_frames(16, size=policy.backbone.image_size)
    updates = []
    for goal in ("press the button", "press the button", "pick up the red cube"):
        episode.goal = goal
        episode.observe({"front": frames, "wrist": frames}, np.zeros((16, 8), np.float32))
        memory = policy.encode_memories([episode])
        batch = policy.observation([episode])
        batch.history = selection_of(policy, episode)
        expected = policy.model.memory_tokens(batch).tokens[memory.mask]
        assert torch.allclose(memory.tokens[memory.mask], expected, atol=1e-5)
        updates.append(episode.stream.updates)
    assert updates == [1, 2, 3]  # one new frame each, and all of them under another prompt


def selection_of(policy: MMEPolicy, episode: Any) -> Any:
    """The stored tokens of an episode that its memory reads now, as a batch of one."""
    history = episode.required_history()
    return stack_history([policy.memory.gather_selection(history, len(history) - 1)])
