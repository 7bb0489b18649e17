"""Sampling in place: the same chunks as with keys joined anew in every step; what depends on
weights alone is kept.
"""

import logging
from contextlib import nullcontext
from dataclasses import replace
from typing import NamedTuple

import pytest
import torch
from torch import Tensor

from mme_vla import UserError
from mme_vla.backbone import flow
from mme_vla.cli.loading import prepare_sampling
from mme_vla.policy.mme import MMEPolicy
from mme_vla.speed import graphs
from mme_vla.speed.graphs import CapturedSampling
from mme_vla.testing.small import random_batch, small_policy
from mme_vla.types import Batch

MODELS = ["pi05", "tokendrop_expert", "framesamp_modul", "framesamp_context", "rmt_context"]


class JoinedKV(NamedTuple):
    """The past's keys and values of one layer, behind which no space is left."""

    k: Tensor
    v: Tensor

    def filled(self, k: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        return torch.cat([self.k, k], 1), torch.cat([self.v, v], 1)


@torch.no_grad()
def joined_anew(policy: MMEPolicy, batch: Batch, noise: Tensor, steps: int) -> Tensor:
    """Sampling by the parts: every step puts its keys behind the prefix's in a new tensor."""
    backbone = policy.backbone
    memory = policy.model.memory_tokens(batch)
    injection = policy.model.inject(policy.model.prepare_images(batch), memory)
    before = backbone.transformer.layout(injection.blocks, injection.visibility)
    space = backbone.transformer.cache_space(injection.blocks, 0)
    backbone.transformer(injection.blocks, before, past=space)
    prefix = space.after(before)
    prefix = replace(prefix, layers=[JoinedKV(*layer.past()) for layer in prefix.layers])
    layout = backbone.transformer.layout(
        [backbone.action_block(noise)], injection.visibility, prefix
    )
    times = backbone.time_condition(flow.euler_times(steps, noise.device))
    conditions = backbone.transformer.time_modulations(times, before.dtype)
    x = noise
    for index in range(steps):
        action = [backbone.action_block(x)]
        hidden = backbone.transformer(action, layout, conditions.at(index), injection.hook, prefix)
        x = x - backbone.project_actions(hidden) / steps
    return x


@pytest.mark.parametrize("model", MODELS)
def test_sampling_in_place_equals_joining_keys_to_the_bit(model: str) -> None:
    policy = small_policy(model).eval()
    batch, noise = (
        random_batch(policy, 2),
        torch.randn(2, 20, 32, generator=torch.Generator().manual_seed(0)),
    )
    expected = joined_anew(policy, batch, noise, 3)
    assert torch.equal(policy.sample_actions(batch, noise, steps=3), expected)
    policy.compile_sampling()
    for _ in range(2):  # the second time with what the first one kept
        assert torch.equal(policy.sample_actions(batch, noise, steps=3), expected)


def test_time_modulations_are_computed_once_and_anew_where_a_weight_has_changed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    policy = small_policy("pi05").eval()
    batch, noise = random_batch(policy, 1), torch.zeros(1, 20, 32)
    calls = 0
    original = policy.backbone.time_condition

    def counting(times: Tensor) -> Tensor:
        nonlocal calls
        calls += 1
        return original(times)

    monkeypatch.setattr(policy.backbone, "time_condition", counting)
    policy.compile_sampling()
    before = policy.sample_actions(batch, noise)
    policy.sample_actions(batch, noise)
    assert calls == 1
    policy.sample_actions(batch, noise, steps=2)
    assert calls == 2, "other steps are other times"
    with torch.no_grad():
        policy.backbone.transformer.layers[1].experts["action"].mlp_norm.dense.weight.mul_(2)
    after = policy.sample_actions(batch, noise)
    assert calls == 3
    assert not torch.equal(before, after)
    assert torch.equal(after, joined_anew(policy, batch, noise, 10))


class Replayed:
    """A fake CUDA graph on a CPU: runs again what was captured, on the captured inputs."""

    def __init__(self, sampler: CapturedSampling, inputs: graphs.Inputs, steps: int) -> None:
        self._sampler, self._inputs, self._steps = sampler, inputs, steps
        self.chunks = sampler._run(inputs, steps)

    def replay(self) -> None:
        self.chunks.copy_(self._sampler._run(self._inputs, self._steps))


@pytest.fixture
def captures(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Lets graphs be captured without a GPU; the sizes of the batches that were."""
    sizes: list[int] = []

    def capture(self: CapturedSampling, inputs: graphs.Inputs, steps: int) -> graphs._Captured:
        replayed = Replayed(self, inputs, steps)
        sizes.append(len(replayed.chunks))
        return graphs._Captured(replayed, inputs, replayed.chunks)  # type: ignore[arg-type]

    monkeypatch.setattr(CapturedSampling, "_capture", capture)
    monkeypatch.setattr(torch.cuda, "device", lambda device: nullcontext())
    return sizes


@pytest.mark.parametrize("model", ["pi05", "framesamp_expert"])
def test_few_sizes_are_captured_and_each_batch_gets_its_reply(
    model: str, captures: list[int]
) -> None:
    policy = small_policy(model).eval()
    generator = torch.Generator().manual_seed(0)
    cases = [
        (random_batch(policy, n, seed=n), torch.randn(n, 20, 32, generator=generator))
        for n in (3, 4, 1, 3, 2)
    ]
    expected = [policy.sample_actions(batch, noise, steps=2) for batch, noise in cases]
    policy.compile_sampling()
    policy._sampler = CapturedSampling(policy.model.sample, policy.backbone.compile_sampling())
    chunks = [policy.sample_actions(batch, noise, steps=2) for batch, noise in cases]
    assert captures == [4, 1, 2]
    policy.sample_actions(*cases[0], steps=3)
    assert captures == [4, 1, 2, 4], "other steps are another graph"
    assert all(torch.allclose(a, b, atol=1e-5) for a, b in zip(chunks, expected, strict=True))
    policy.train()
    policy.sample_actions(*cases[0], steps=2)
    policy.eval()
    with torch.no_grad():
        policy.backbone.time_in.bias.add_(1)
    changed = policy.sample_actions(*cases[2], steps=2)
    assert captures == [4, 1, 2, 4, 1], "what was captured from other modulations is dropped"
    assert not torch.allclose(changed, chunks[2])


def test_a_command_compiles_what_it_is_requested() -> None:
    logger = logging.getLogger("test")
    policy = small_policy("pi05").eval()
    prepare_sampling(policy, "auto", logger)
    prepare_sampling(policy, "eager", logger)
    assert not policy.backbone.keep_times and policy._sampler is None
    with pytest.raises(UserError, match=r"sampling='graf'.*graph"):
        prepare_sampling(policy, "graf", logger)
    with pytest.raises(UserError, match="needs a GPU"):
        prepare_sampling(policy, "graph", logger)


@torch._dynamo.config.patch(recompile_limit=8, accumulated_recompile_limit=256)
def test_no_length_or_size_of_batch_is_one_too_many_to_compile() -> None:
    policy = small_policy("pi05", **{"processor.prompt_length": 200}).eval()
    policy.processor = None
    policy.compile_sampling(layers=True)
    # A layer has three kinds of code (prefix, its last layer, a step), for 13 lengths of prompt and
    # batches of 1, 2, 4, … 64.
    least = 3 * 13 * 7
    assert torch._dynamo.config.recompile_limit > least
    assert torch._dynamo.config.accumulated_recompile_limit > least
