"""A full window moves at every decision: what its next one needs is prepared between requests, to
the same bit.
"""

from functools import partial

import numpy as np
import pytest
import torch

from helpers.recurrent_memories import MEMORIES, RandomHistory, same_memory, small_memory, window
from helpers.rollout_fakes import InlineEnvs, quick_policy, roll
from helpers.serving_fakes import Served, acted_directly, course, observation, wait_until
from mme_vla.envs.vector.pool import Job
from mme_vla.policy.scheduler import Act, Prepare, Scheduler
from mme_vla.testing.small import moving_frames

STEPS = 6
"""A window of six frames is full after 96."""


@pytest.fixture(params=MEMORIES)
def make(request):
    return partial(small_memory, request.param)


def prepared(memory, history, stream) -> int:
    """Pieces done until none is left."""
    done = 1
    while memory.prepare(history, stream):
        done += 1
        assert done < 20
    return done


@torch.no_grad()
@pytest.mark.parametrize("exec_start", [0, 30])
def test_a_decision_costs_one_frame_however_long_the_episode(make, exec_start):
    memory = make(max_steps=STEPS)
    history, unprepared = RandomHistory(exec_start + 1, exec_start), memory.start_stream()
    stream = memory.start_stream()
    memory.encode([history], [stream])
    for _ in range(14):
        prepared(memory, history, stream)
        before, history.length = stream.updates, history.length + 16
        now, late = memory.encode([history], [stream]), memory.encode([history], [unprepared])
        assert stream.updates == before + 1
        assert torch.equal(now.tokens, late.tokens), "prepared or not: the same bits"
        assert same_memory(now, memory(window(memory, len(history), exec_start)))
    assert len(history) > 2 * 16 * STEPS


@torch.no_grad()
@pytest.mark.parametrize("pace", [4, 8, 12, 32])
def test_another_pace_continues_what_it_has(make, pace):
    memory = make(max_steps=64)
    history, stream = RandomHistory(1), memory.start_stream()
    for decision in range(24):
        before, history.length = stream.updates, history.length + pace
        now = memory.encode([history], [stream])
        if decision >= 16 // np.gcd(16, pace):  # each offset has been seen once
            assert stream.updates - before <= max(pace // np.gcd(16, pace), 2)
        assert same_memory(now, memory(window(memory, len(history))))


@torch.no_grad()
@pytest.mark.parametrize("pace", [8, 12])
def test_a_full_window_is_prepared_at_the_pace_of_the_decisions(make, pace):
    memory = make(max_steps=STEPS)
    history, stream = RandomHistory(1), memory.start_stream()
    for decision in range(24):
        before, history.length = stream.updates, history.length + pace
        now = memory.encode([history], [stream])
        if decision > 1:
            assert stream.updates - before == 1
        assert same_memory(now, memory(window(memory, len(history))))
        prepared(memory, history, stream)


@torch.no_grad()
def test_what_was_prepared_in_vain_does_no_harm(make):
    memory = make(max_steps=STEPS, chunk=2)
    history, stream = RandomHistory(129), memory.start_stream()
    assert not memory.prepare(history, stream), "nothing is known before the first decision"
    memory.encode([history], [stream])
    assert memory.prepare(history, stream), "a piece of several"
    for more in (16, 5, 16, 3, 40, 16):
        history.length += more
        now = memory.encode([history], [stream])
        assert same_memory(now, memory(window(memory, len(history))))
        memory.prepare(history, stream)
        assert torch.equal(memory.encode([history], [stream]).tokens, now.tokens), "asked twice"


def acted(policy, prepare: bool, chunks: int = 6) -> list[np.ndarray]:
    frames, results = moving_frames(16), []
    episode = policy.start_episode("press the button")
    for chunk in range(chunks):
        frames_ = np.roll(frames, chunk, axis=2)
        episode.observe({"front": frames_, "wrist": frames_}, np.zeros((16, 8), np.float32))
        results.append(policy.act(episode, 1))
        while prepare and policy.prepare(episode):
            pass
    return results


FULL = {
    "ttt_modul": {"max_steps": 4, "budget": 64},
    "rmt_context": {"max_steps": 4, "budget": 64},
    "actions_modul": {"max_steps": 4, "stride": 16},
    **{
        model: {}
        for model in (
            "retrieval_modul",
            "moment_modul",
            "gist_modul",
            "learned_topk_modul",
            "spacetime_modul",
        )
    },
    **{model: {} for model in ("events_modul", "pyramid_modul", "keyframes_modul")},
}
"""Windows that six chunks fill, where there is one."""


@pytest.mark.slow
@pytest.mark.parametrize("model", FULL)
def test_preparing_changes_no_action(model):
    policy = quick_policy(model, 8, memory=FULL[model])
    assert all(
        np.array_equal(a, b) for a, b in zip(acted(policy, True), acted(policy, False), strict=True)
    )


def test_policies_without_such_a_memory_have_nothing_to_prepare():
    for model in ("pi05", "framesamp_modul"):
        policy = quick_policy(model)
        episode = policy.start_episode("press the button")
        assert not policy.prepare(episode)
        view = moving_frames(2)
        episode.observe({"front": view, "wrist": view}, np.zeros((2, 8), np.float32))
        policy.act(episode, 1)
        assert not policy.prepare(episode)


def test_preparing_waits_for_everybody_and_keeps_nobody():
    class Session:
        pass

    scheduler: Scheduler = Scheduler(max_batch=2)
    someone, gone = Session(), Session()
    scheduler.later[gone] = scheduler.later[someone] = None
    scheduler.acting.extend("abc")
    assert [step.batch for step in scheduler.next_steps() if isinstance(step, Act)] == [["a", "b"]]
    assert len(scheduler.later) == 2, "c still waits"
    del gone
    steps = list(scheduler.next_steps())
    assert [type(step) for step in steps] == [Act, Prepare] and steps[1].work is someone
    assert not scheduler


def test_rollouts_prepare_between_chunks(monkeypatch):
    policy = quick_policy("ttt_modul", 8, memory={"max_steps": 10})
    calls, prepare = [], policy.prepare
    monkeypatch.setattr(
        policy,
        "prepare",
        lambda episode: calls.append(episode.n_observed_frames) or prepare(episode),
    )

    class Slow(InlineEnvs):
        """Returns frames when it is queried again, as a simulation does."""

        waited = False

        def recv(self, timeout=None):
            self.waited = not self.waited
            return [] if self.waited and timeout == 0 else super().recv(timeout)

    roll(policy, [Job("VideoUnmask", "test", 0)], Slow())
    assert len(calls) >= 2 and len(set(calls)) >= 2


def test_a_server_prepares_after_it_has_answered(monkeypatch):
    policy = quick_policy("rmt_modul", 8, memory={"max_steps": 4, "chunk": 2})
    parts, done = course(video=9, rounds=6), []
    prepare = policy.prepare
    monkeypatch.setattr(
        policy, "prepare", lambda episode: done.append(left := prepare(episode)) or left
    )
    expected = acted_directly(policy, parts)
    with Served(policy) as served, served.client() as client:
        for index, (front, wrist, state) in enumerate(parts):
            client.add_buffer(front, state, exec_start=len(front) - 1 if index == 0 else 0)
            actions = client.infer(observation(front[-1], wrist[-1], state[-1]))["actions"]
            assert np.array_equal(actions, expected[index])
            wait_until(lambda: not served.server.engine.scheduler)
        wait_until(lambda: True in done)  # a window of four frames, pieces of two
