"""Sampling in Gaussian steps and the density of what was sampled."""

import pytest
import torch
from torch.distributions import MultivariateNormal

from mme_vla.backbone.flow import FlowHead
from mme_vla.errors import UserError
from mme_vla.extras.trajectories.log_prob import (
    gaussian_steps,
    path_log_prob,
    sample_path,
    steps_log_prob,
)
from mme_vla.testing.small import random_batch, small_policy
from mme_vla.types import stack_noise


def test_the_log_probability_of_a_path_is_the_density_of_the_joint_normal() -> None:
    steps, deviation, slope = 4, 0.3, 0.7
    head = FlowHead(horizon=2, action_dim=3)
    generator = torch.Generator().manual_seed(0)

    def linear(x: torch.Tensor, index: int) -> torch.Tensor:
        return slope * x

    noise = torch.randn(5, 2, 3, generator=generator, dtype=torch.float64)
    increments = torch.randn(5, steps, 2, 3, generator=generator, dtype=torch.float64)
    path = gaussian_steps(head, linear, noise, increments, deviation)
    # x_{i+1} = (1 − slope/k)·x_i + σ·ε_i: one joint normal distribution of the k + 1 states of each
    # number.
    gain = 1 - slope / steps
    mixing = torch.zeros(steps + 1, steps + 1, dtype=torch.float64)
    for i in range(steps + 1):
        mixing[i, 0] = gain**i
        for j in range(1, i + 1):
            mixing[i, j] = deviation * gain ** (i - j)
    joint = MultivariateNormal(torch.zeros(steps + 1, dtype=torch.float64), mixing @ mixing.T)
    expected = joint.log_prob(path.flatten(2).transpose(1, 2)).sum(1)
    assert torch.allclose(
        steps_log_prob(head, linear, path, deviation), expected, rtol=0, atol=1e-9
    )


@pytest.mark.parametrize("backbone", ["tiny", "nano"])
def test_a_path_is_sampled_and_its_log_probability_has_a_gradient(backbone: str) -> None:
    policy = small_policy("framesamp_modul", backbone=backbone)
    batch = random_batch(policy)
    path = sample_path(policy, batch, 0.1, generator=torch.Generator().manual_seed(0))
    log_prob = path_log_prob(policy, batch, path)
    assert torch.allclose(log_prob, path.log_prob, rtol=1e-5)
    log_prob.sum().backward()
    learning = [
        n
        for n, p in policy.named_parameters()
        if n.startswith(("backbone.", "memory.")) and p.grad is not None
    ]
    assert any(n.startswith("backbone.action_out") for n in learning)
    assert any(n.startswith("memory.") for n in learning)
    again = sample_path(policy, batch, 0.1, generator=torch.Generator().manual_seed(0))
    assert torch.equal(again.states, path.states)


@pytest.mark.parametrize("backbone", ["tiny", "nano"])
def test_without_noise_the_path_ends_in_the_plain_chunk(backbone: str) -> None:
    policy = small_policy("framesamp_modul", backbone=backbone)
    batch = random_batch(policy)
    noise = torch.randn(len(batch.prompt), policy.horizon, policy.action_dim)
    path = sample_path(policy, batch, 0.0, noise=noise)
    assert (path.chunk - policy.sample_actions(batch, noise)).abs().max() < 1e-5
    with pytest.raises(UserError, match="no density"):
        path_log_prob(policy, batch, path)
    with pytest.raises(UserError, match="deviation=-1"):
        sample_path(policy, batch, -1)


def test_a_head_with_deviation_samples_the_path_of_its_noise() -> None:
    steps, generator = 4, torch.Generator().manual_seed(0)
    head = FlowHead(horizon=2, action_dim=3, steps=steps, deviation=0.3)
    noise = {name: value[None] for name, value in head.sampling_noise(generator).items()}
    assert noise["increments"].shape == (1, steps, 2, 3)

    def linear(x: torch.Tensor, index: int) -> torch.Tensor:
        return 0.7 * x

    path = gaussian_steps(head, linear, noise["noise"], noise["increments"], 0.3)
    x = noise["noise"]
    for index in range(steps):
        x = x - 0.7 * x / steps + 0.3 * noise["increments"][:, index]
    assert torch.allclose(path[:, -1], x)
    assert torch.equal(head.start(noise, steps, None), noise["noise"])
    assert set(FlowHead(horizon=2, action_dim=3).sampling_noise(generator)) == {"noise"}
    with pytest.raises(UserError, match="flow_steps=5"):
        head.start(noise, 5, None)


def test_a_backbone_whose_head_has_a_deviation_samples_the_path_of_its_noise() -> None:
    policy = small_policy("pi05", **{"+backbone.head.deviation": 0.2})
    batch = random_batch(policy, batch=2)
    noise = stack_noise([policy.sampling_noise(torch.default_generator) for _ in range(2)])
    chunk = policy.sample_actions(batch, noise)
    path = sample_path(policy, batch, 0.2, **noise)
    assert (path.chunk - chunk).abs().max() < 1e-5
