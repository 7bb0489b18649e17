"""Flow matching: the path, its times, and the options on them."""

import pytest
import torch

from mme_vla import UserError, build_policy
from mme_vla.backbone import flow
from mme_vla.testing.small import small_policy

CPU = torch.device("cpu")


def draw(distribution: str) -> torch.Tensor:
    return flow.sample_time(20_000, distribution, CPU, torch.Generator().manual_seed(0))


def test_released_times_are_beta_and_lean_to_noise():
    times = draw("beta")
    assert times.min() >= 0.001 and times.max() <= 1
    assert times.mean() == pytest.approx(0.001 + 0.999 * 1.5 / 2.5, abs=0.005)
    assert times.var() == pytest.approx(0.999**2 * 1.5 / (2.5**2 * 3.5), rel=0.03)


def test_uniform_times_are_an_option():
    assert draw("uniform").mean() == pytest.approx(0.5, abs=0.01)
    assert (
        build_policy(
            "pi05", backbone={"time_distribution": "uniform"}
        ).backbone.config.time_distribution
        == "uniform"
    )
    with pytest.raises(UserError, match="time_distribution"):
        build_policy("pi05", backbone={"time_distribution": "normal"})


def test_the_path_runs_from_actions_to_noise():
    actions, noise = torch.randn(2, 3, 4), torch.randn(2, 3, 4)
    start, velocity = flow.interpolate(actions, noise, torch.zeros(2))
    end, _ = flow.interpolate(actions, noise, torch.ones(2))
    assert torch.allclose(start, actions) and torch.allclose(end, noise)
    # numbers near zero are differences of larger ones
    assert torch.allclose(start + velocity, end, atol=1e-5)


@pytest.mark.parametrize("steps", [1, 7, 10])
def test_euler_steps_of_the_true_velocity_end_at_the_actions(steps):
    actions, noise = torch.randn(2, 3, 4), torch.randn(2, 3, 4)
    times = flow.euler_times(steps, CPU)
    assert len(times) == steps and times[0] == 1 and times[-1] == pytest.approx(1 / steps, abs=1e-5)
    head = flow.FlowHead(horizon=3, action_dim=4)
    velocity = head.velocity(lambda x, i: noise - actions, times, {"noise": noise})
    x = head.start({"noise": noise}, steps, None)
    for index in range(steps):
        x = head.step(x, velocity(x, index), steps)
    assert torch.allclose(x, actions, atol=1e-5)


def test_max_pooling_reaches_the_stored_tokens():
    frames = torch.randint(0, 256, (2, 64, 64, 3), dtype=torch.uint8)
    mean, largest = (
        small_policy("framesamp_context", memory={"pooling": kind}).encode_frames(frames)
        for kind in ("mean", "max")
    )
    assert mean.shape == largest.shape
    assert (largest.float() >= mean.float() - 1e-2).all() and not torch.allclose(
        mean.float(), largest.float()
    )
