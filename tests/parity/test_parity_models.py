"""Whole policies equal the released implementation: velocity, loss and sampled actions at tiny
size.

They run on the GPU where there is one.
"""

from pathlib import Path

import pytest
import torch

from helpers import golden
from mme_vla.memory.rmt import RMT

MODELS = ["pi05_baseline", "symbolic-grounded-subgoal"] + [
    f"{memory}-{integration}"
    for memory in ("perceptual-framesamp", "perceptual-tokendrop", "recurrent-ttt", "recurrent-rmt")
    for integration in ("context", "modul", "expert")
]
TOLERANCE = 1e-4
DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")
ROUNDED_TOLERANCE = 2e-2  # where bfloat16 is rounded on the way, a last bit may fall either way


@pytest.fixture(params=MODELS)
def case(request: pytest.FixtureRequest, parity: Path):
    return loaded(parity, f"model_{request.param}")


def loaded(parity: Path, name: str):
    tensors, about = golden.load(parity, name)
    policy = golden.policy(tensors, about).to(DEVICE)
    return policy, {key: value.to(DEVICE) for key, value in tensors.items()}, about


def exact(policy, tensors):
    """Turn RMT's cast to bfloat16 off and return the golden outputs without it; other models' as
    they are.
    """
    if not isinstance(policy.memory, RMT):
        return tensors
    policy.memory.layer.attention_dtype = torch.float32
    return tensors | {
        key.removesuffix("_f32attn"): value for key, value in tensors.items() if "_f32attn" in key
    }


@torch.no_grad()
def test_velocity_and_loss_equal_the_released_model(case):
    policy, tensors, _ = case
    tensors = exact(policy, tensors)
    batch, memory = golden.batch(tensors), golden.memory_tokens(policy, tensors)
    if memory is not None:
        assert golden.error(memory.tokens, tensors["out/mem_tokens"]) <= TOLERANCE
        assert torch.equal(memory.mask, tensors["out/mem_mask"])
    time, noise = tensors["in/time"], tensors["in/noise"]
    velocity = policy.predict(batch, tensors["out/x_t"], time, memory)
    assert golden.error(velocity, tensors["out/v_t"]) <= TOLERANCE
    loss, _ = policy(batch, noise, time, memory)
    assert abs(float(loss) - float(tensors["out/loss"].mean())) <= TOLERANCE


@torch.no_grad()
def test_ten_step_samples_equal_the_released_model(case):
    policy, tensors, about = case
    tensors = exact(policy, tensors)
    batch, memory = golden.batch(tensors), golden.memory_tokens(policy, tensors)
    noise = tensors["in/sample_noise"]
    sampled = policy.sample_actions(batch, noise, about["num_denoise_steps"], memory=memory)
    assert golden.error(sampled, tensors["out/sampled_actions"]) <= TOLERANCE
    one_step = policy.sample_actions(batch, noise, steps=1, memory=memory)
    assert golden.error(one_step, tensors["out/sampled_actions_1step"]) <= TOLERANCE


@torch.no_grad()
@pytest.mark.parametrize("integration", ["context", "modul", "expert"])
def test_rmt_rounds_where_the_released_model_does(integration, parity):
    policy, tensors, about = loaded(parity, f"model_recurrent-rmt-{integration}")
    batch, memory = golden.batch(tensors), golden.memory_tokens(policy, tensors)
    assert golden.error(memory.tokens, tensors["out/mem_tokens"]) <= ROUNDED_TOLERANCE
    velocity = policy.predict(batch, tensors["out/x_t"], tensors["in/time"], memory)
    assert golden.error(velocity, tensors["out/v_t"]) <= ROUNDED_TOLERANCE
    sampled = policy.sample_actions(
        batch, tensors["in/sample_noise"], about["num_denoise_steps"], memory=memory
    )
    assert golden.error(sampled, tensors["out/sampled_actions"]) <= ROUNDED_TOLERANCE


@torch.no_grad()
def test_bfloat16_stays_near_the_released_model(case):
    """Under autocast, as in training, and with rounded weights, as in evaluation; relative to the
    largest entry.
    """
    policy, tensors, about = case
    policy.compute_dtype = torch.bfloat16
    for dtype in (torch.float32, torch.bfloat16):
        policy.to(dtype)
        with policy.autocast():
            batch, memory = golden.batch(tensors), golden.memory_tokens(policy, tensors)
            velocity = policy.predict(batch, tensors["out/x_t"], tensors["in/time"], memory)
            noise = tensors["in/sample_noise"]
            sampled = policy.sample_actions(batch, noise, about["num_denoise_steps"], memory=memory)
        for actual, expected in (
            (velocity, tensors["out/v_t"]),
            (sampled, tensors["out/sampled_actions"]),
        ):
            assert golden.error(actual, expected) <= ROUNDED_TOLERANCE * float(
                expected.abs().max()
            ), dtype


def test_gradients_equal_the_released_model(case):
    """The L2 norm of each parameter's gradient: a parameter that is read wrongly would show."""
    policy, tensors, about = case
    for parameter in policy.parameters():
        parameter.requires_grad_(True)
    loss, _ = policy(
        golden.batch(tensors),
        tensors["in/noise"],
        tensors["in/time"],
        golden.memory_tokens(policy, tensors),
    )
    loss.backward()
    from mme_vla.weights.released import released_adapter, released_table
    from mme_vla.weights.tables import write

    gradients = {
        name: p.grad if p.grad is not None else torch.zeros_like(p)
        for name, p in policy.named_parameters()
    }
    released = write(released_table(policy), released_adapter(policy).unread, gradients)
    for path, norm in about["grad_l2_of_mean_loss"].items():
        assert abs(float(released[path].norm()) - norm) <= 1e-4 + 1e-3 * norm, path
