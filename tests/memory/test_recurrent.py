"""What recurrent memories guarantee beyond every memory: window and stream are equal, and their
costs.
"""

from functools import partial

import numpy as np
import pytest
import torch

from helpers.golden import from_released
from helpers.recurrent_memories import (
    D_VISION,
    GRID,
    MEMORIES,
    TOLERANCE,
    RandomHistory,
    same_memory,
    small_memory,
    window,
)
from mme_vla import UserError
from mme_vla.memory.recurrent import jittered, recurrent_frames
from mme_vla.memory.ttt import TTT
from mme_vla.testing.small import moving_frames, random_batch, small_policy
from mme_vla.types import HistoryTokens
from mme_vla.weights.released import to_released


@pytest.fixture(params=MEMORIES)
def make(request):
    return partial(small_memory, request.param)


class Counting:
    """A function that counts its calls."""

    def __init__(self, function) -> None:
        self.function, self.calls = function, 0

    def __call__(self, *args):
        self.calls += 1
        return self.function(*args)


@torch.no_grad()
def test_frame_by_frame_equals_the_window(make):
    memory = make()
    tokens = window(memory, 150)
    state = memory.init_state(1)
    for part in zip(
        *(x.split(GRID**2, 1) for x in (tokens.features, tokens.positions, tokens.mask)),
        strict=True,
    ):
        state = memory.update(state, *part)
    assert same_memory(memory.read(state), memory(tokens))


@torch.no_grad()
@pytest.mark.parametrize("exec_start", [0, 30])
def test_a_growing_list_costs_one_update_a_frame(make, exec_start):
    memory, stream = make(), None
    history = RandomHistory(exec_start + 1, exec_start)
    stream = memory.start_stream()
    memory.encode([history], [stream])
    before, gathered = stream.updates, history.gathered
    for replan in range(1, 5):
        history.length += 16
        now = memory.encode([history], [stream])
        assert stream.updates == before + replan
        assert history.gathered == gathered + replan * GRID**2
        assert same_memory(now, memory(window(memory, len(history), exec_start)))
    memory.encode([history], [stream])
    assert stream.updates == before + 4, "nothing new was seen"


@torch.no_grad()
def test_any_other_list_is_computed_anew(make):
    memory = make(max_steps=6)
    history, stream = RandomHistory(81), memory.start_stream()
    memory.encode([history], [stream])
    assert stream.updates == 6
    for more, frames in (
        (5, 6),
        (16, 6),
    ):  # off the stride; then on it, but the earliest frame has fallen out
        before, history.length = stream.updates, history.length + more
        now = memory.encode([history], [stream])
        assert stream.updates == before + frames
        assert same_memory(now, memory(window(memory, len(history))))


@torch.no_grad()
def test_episodes_at_different_places_share_a_call(make):
    memory = make()
    histories = [RandomHistory(20), RandomHistory(1), RandomHistory(90, 40), RandomHistory(20)]
    streams = [memory.start_stream() for _ in histories]
    for _ in range(2):
        together = memory.encode(histories, streams)
        for i, history in enumerate(histories):
            alone = memory(window(memory, len(history), history.exec_start))
            assert torch.equal(together.mask[i], alone.mask[0])
            assert torch.allclose(
                together.tokens[i][alone.mask[0]], alone.tokens[alone.mask], atol=TOLERANCE
            )
            history.length += 16


def test_acting_carries_the_state_in_the_episode(monkeypatch):
    policy = small_policy("ttt_modul")
    counted = []
    advance = policy.memory.layer.advance

    def counting(state, x, *arguments):
        counted.append(x.shape[1])
        return advance(state, x, *arguments)

    monkeypatch.setattr(policy.memory.layer, "advance", counting)
    frames = moving_frames(50)
    episode = policy.start_episode("press the button")
    for start, stop in ((0, 1), (1, 17), (17, 33), (33, 40)):
        view = {"front": frames[start:stop], "wrist": frames[start:stop]}
        episode.observe(view, np.zeros((stop - start, 8), np.float32))
        policy.act([episode])
    assert counted == [
        1,
        1,
        1,
        2,
        1,
    ]  # the last replan came off the stride; the newest frame enters alone
    assert episode.stream.updates == 6


@torch.no_grad()
def test_front_padding_never_matters(make):
    memory = make(max_steps=64)
    tokens = window(memory, 40)
    assert tokens.mask.shape[1] == 4 * GRID**2, (
        "a short episode is padded to a chunk, not to 64 frames"
    )
    around = memory.capacity - tokens.mask.shape[1]
    padded = HistoryTokens(
        torch.nn.functional.pad(tokens.features, (0, 0, around, 0), value=9.0),
        torch.nn.functional.pad(tokens.positions, (0, 0, around, 0), value=9.0),
        torch.nn.functional.pad(tokens.mask, (around, 0)),
    )
    assert same_memory(memory(tokens), memory(padded))


def test_chunks_and_recomputation_change_neither_numbers_nor_gradients(make):
    results = []
    for options in ({"chunk": 1}, {"chunk": 3}, {"chunk": 64}, {"recompute": False}):
        memory = make(**options)
        out = memory(window(memory, 200))
        loss = (out.tokens * out.mask[..., None]).square().sum()
        gradients = torch.autograd.grad(loss, memory.parameters())
        results.append((loss.detach(), torch.cat([gradient.flatten() for gradient in gradients])))
    for loss, gradient in results[1:]:
        assert torch.allclose(loss, results[0][0], rtol=1e-5)
        assert torch.allclose(
            gradient, results[0][1], rtol=1e-3, atol=1e-4 * float(gradient.abs().max())
        )


def test_gradients_flow_through_every_step(make):
    memory = make()
    tokens = window(memory, 200)
    tokens.features.requires_grad_(True)
    memory(tokens).tokens[:, -1].sum().backward()
    frames = tokens.features.grad.unflatten(1, (-1, GRID**2)).abs().sum((0, 2, 3))
    real = tokens.mask.unflatten(1, (-1, GRID**2)).all(-1)[0]
    assert (frames[real] > 0).all()
    assert (frames[~real] == 0).all()


TTT_METRICS = [
    "inner_loss_before",
    "inner_loss_after",
    "step_size",
    "clipped_rates",
    "clipped_gradients",
    "weight_change",
]


@pytest.mark.parametrize(
    ("model", "names"), [("ttt_modul", TTT_METRICS), ("rmt_modul", ["slot_change"])]
)
def test_inner_statistics_are_metrics(model, names):
    policy = small_policy(model)
    policy.memory.reporting = True
    _, metrics = policy(random_batch(policy))
    assert sorted(metrics) == sorted(["loss", *(f"memory/{name}" for name in names)])
    assert all(
        value.ndim == 0 and torch.isfinite(value) and not value.requires_grad
        for value in metrics.values()
    )
    if "memory/step_size" in metrics:
        assert float(metrics["memory/step_size"]) == pytest.approx(0.01, rel=0.5)
        assert metrics["memory/inner_loss_after"] < metrics["memory/inner_loss_before"]


def test_statistics_are_computed_only_when_requested(make, monkeypatch):
    memory, queries = make(), []
    advance = memory.layer.advance

    def noting(state, x, valid, following=0, statistics=False):
        queries.append(statistics)
        return advance(state, x, valid, following, statistics)

    monkeypatch.setattr(memory.layer, "advance", noting)
    if isinstance(memory, TTT):
        monkeypatch.setattr(memory.layer, "inner", counted := Counting(memory.layer.inner))
    tokens = window(memory, 100)
    quiet = memory(tokens)
    quiet.tokens.sum().backward()  # recomputation included
    assert quiet.metrics == {}
    assert not any(queries)
    without = counted.calls if isinstance(memory, TTT) else 0
    memory.reporting = True
    telling = memory(tokens)
    assert telling.metrics
    assert torch.equal(telling.tokens, quiet.tokens)
    if isinstance(memory, TTT):
        frames = tokens.mask.shape[1] // GRID**2
        assert counted.calls - without == without / 2 + 2 * frames, (
            "two more forward passes a frame"
        )


def test_inner_updates_round_to_the_dtype_of_the_stored_state(make):
    memory = make().to(torch.bfloat16)
    state = memory.layer.advance(
        memory.init_state(1), torch.randn(1, 3, GRID**2, 16), torch.ones(1, 3).bool()
    )[0]
    assert state[0].dtype == torch.bfloat16
    assert memory(window(memory, 40)).tokens.isfinite().all()


def test_frames_of_a_running_video_are_those_of_the_finished_episode():
    for step in range(60):
        running = recurrent_frames(step, step + 1)
        assert running.tolist() == recurrent_frames(step, 700).tolist()
        assert (np.diff(running) > 0).all()
        assert running[-1] == step


def test_past_frames_are_the_same_at_every_step_with_every():
    for exec_start in (0, 66, 400, 2000):
        lists = [
            recurrent_frames(step, exec_start, 64, 40, 32, every=16) for step in range(0, 1300, 7)
        ]
        for step, frames in zip(range(0, 1300, 7), lists, strict=True):
            past = frames[frames < step]
            assert ((past == 0) | ((past + 1) % 16 == 0)).all() and (np.diff(frames) > 0).all()
            assert frames[-1] == step and len(frames) <= 64
    assert recurrent_frames(50, 0, every=16).tolist() == [0, 15, 31, 47, 50]
    assert recurrent_frames(300, 0, 3, every=16).tolist() == [271, 287, 300], (
        "the earliest are dropped first"
    )
    assert (
        recurrent_frames(20, 21, every=16).tolist() == recurrent_frames(20, 700, every=16).tolist()
    )


@torch.no_grad()
@pytest.mark.parametrize("exec_start", [0, 30])
def test_an_uneven_pace_continues_with_every(make, exec_start):
    memory = make(every=16)
    history, stream, read = RandomHistory(exec_start + 1, exec_start), memory.start_stream(), set()
    for more in (0, 5, 20, 16, 3, 47, 0):
        history.length += more
        now, step = memory.encode([history], [stream]), len(history) - 1
        assert same_memory(now, memory(window(memory, len(history), exec_start)))
        read |= {
            int(frame)
            for frame in memory.frames(history, step)
            if frame < step or (step + 1) % 16 == 0
        }
    assert stream.updates <= len(read) + 7, "each past frame enters once, each current one once"


def test_every_needs_a_stride_that_is_a_multiple_and_no_jitter():
    with pytest.raises(
        UserError, match=r"memory\.stride=24 must be a multiple of memory\.every=16, such as 32"
    ):
        TTT(D_VISION, 16, stride=24, every=16)
    with pytest.raises(
        UserError, match=r"memory\.jitter=3 .* set memory\.jitter=0 or memory\.every=1"
    ):
        TTT(D_VISION, 16, every=16, jitter=3)


def test_jitter_keeps_order_parts_and_the_current_frame():
    memory = TTT(D_VISION, 16, jitter=5)
    history = RandomHistory(400, exec_start=100)
    fixed = memory.frames(history, 399)
    assert np.array_equal(fixed, recurrent_frames(399, 100)), "without randomness nothing moves"
    shifted = memory.frames(history, 399, np.random.default_rng(0))
    assert not np.array_equal(fixed, shifted)
    assert (np.diff(shifted) > 0).all()
    assert shifted[-1] == 399
    assert (shifted < 100).sum() == (fixed < 100).sum()
    assert np.abs(shifted - fixed).max() <= 5
    for step in range(40):
        frames = jittered(recurrent_frames(step, 20), 20, 7, np.random.default_rng(step))
        assert frames[0] >= 0
        assert (np.diff(frames) > 0).all()
        assert frames[-1] == step


@pytest.mark.parametrize(
    ("model", "constant"), [("ttt_modul", "ttt_base_lr_inv"), ("rmt_modul", "freqs_cis")]
)
def test_derived_constants_are_saved_and_checked(model, constant):
    policy, path = small_policy(model), f"mem_encoder/recur_layer/{constant}"
    tree = to_released(policy)
    assert path in tree
    assert not tree["mem_encoder/pre_norm/scale"].any()
    assert from_released(small_policy(model), {k: v for k, v in tree.items() if k != path})
    tree[path] = tree[path] + 1
    with pytest.raises(UserError, match=constant):
        from_released(small_policy(model), tree)
