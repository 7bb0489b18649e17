"""The protocol of a rollout: what the environment is sent, and what the policy has seen, at every
inference.
"""

import numpy as np
import pytest
import torch

from helpers.rollout_fakes import JOBS, InlineEnvs, quick_policy, roll
from helpers.scripted_env import VIDEO, make_moving_env
from mme_vla.envs.vector.pool import Job
from mme_vla.evaluation.rollout.running import episode_seed
from mme_vla.policy.mme import MMEPolicy
from mme_vla.subgoal import build_predictor
from mme_vla.testing.small import cached_history

UNMASK = Job("VideoUnmask", "test", 0)


class Watched:
    """A policy that notes what every episode of every batch knew when it acted."""

    def __init__(
        self, policy: MMEPolicy, monkeypatch: pytest.MonkeyPatch, inspect=lambda episode: None
    ) -> None:
        self.chunks: list[np.ndarray] = []
        self.batches: list[int] = []
        self.observed: list[object] = []
        act = policy.act

        def watched(episodes, *args):
            self.batches.append(len(episodes))
            self.observed += [inspect(episode) for episode in episodes]
            chunks = act(episodes, *args)
            self.chunks += list(chunks)
            return chunks

        monkeypatch.setattr(policy, "act", watched)


@pytest.fixture(scope="module")
def memoryless() -> MMEPolicy:
    return quick_policy("pi05")


def test_sixteen_of_twenty_actions_are_executed_and_then_the_policy_is_queried_again(
    memoryless, monkeypatch
):
    watched, envs = Watched(memoryless, monkeypatch), InlineEnvs()
    (record,) = roll(memoryless, [UNMASK], envs)
    assert [len(chunk) for chunk in watched.chunks] == [20, 20, 20]
    sent = np.concatenate([chunk[:16] for chunk in watched.chunks])
    assert np.array_equal(np.stack(envs.made[UNMASK].actions), sent[:41])
    assert (record.outcome, record.steps, record.chunks) == ("timeout", 41, 3)


def test_an_episode_that_ends_inside_a_chunk_ends_there(memoryless):
    envs = InlineEnvs(base=make_moving_env)
    (record,) = roll(memoryless, [UNMASK], envs)
    assert record.outcome == "success" and record.steps % 16 != 0
    assert len(envs.made[UNMASK].actions) == record.steps


@pytest.mark.parametrize("job", [UNMASK, Job("PickXtimes", "test", 1)])
def test_the_current_view_and_state_are_those_after_the_last_action(memoryless, monkeypatch, job):
    watched = Watched(
        memoryless, monkeypatch, lambda e: (e.n_observed_frames, e.images.clone(), e.state.clone())
    )
    envs = InlineEnvs()
    roll(memoryless, [job], envs)
    env, video = envs.made[job], VIDEO.get(job.task, 0)
    assert [n_frames for n_frames, _, _ in watched.observed] == [video + 1, video + 17, video + 33]
    for n_frames, images, state in watched.observed:
        front = env.frames[n_frames - 1]
        assert torch.equal(images, memoryless.processor.images([front, front[::-1]]))
        assert np.array_equal(state.numpy(), env.states[n_frames - 1])
        if n_frames > video + 1:  # the state that the action before this frame led to
            assert np.array_equal(
                state.numpy()[:7], env.actions[n_frames - video - 2][:7].astype(np.float32)
            )


@pytest.mark.parametrize(
    ("name", "encode_chunk"),
    [("framesamp_modul", 3), ("tokendrop_expert", 3), ("tokendrop_expert", 32), ("ttt_modul", 3)],
)
def test_memory_holds_at_every_inference_what_training_would_select(
    name, encode_chunk, monkeypatch
):
    policy = quick_policy(name, 8, policy={"history_dtype": "float32"})
    watched = Watched(
        policy,
        monkeypatch,
        lambda e: (e.n_observed_frames, e.history.exec_start, e.gather_selection()),
    )
    envs = InlineEnvs()
    roll(policy, [UNMASK], envs, encode_chunk=encode_chunk)
    frames, video = np.stack(envs.made[UNMASK].frames), VIDEO["VideoUnmask"]
    assert len(watched.observed) == 3
    for n_frames, exec_start, recalled in watched.observed:
        assert exec_start == video
        offline = policy.memory.gather_selection(
            cached_history(policy, frames, exec_start=video), n_frames - 1
        )
        assert torch.equal(recalled.mask, offline.mask)
        assert torch.equal(recalled.positions, offline.positions)
        assert torch.allclose(recalled.features, offline.features, atol=1e-5)


def test_past_actions_in_the_prompt_are_those_executed(monkeypatch):
    policy = quick_policy("pi05_past_actions")
    watched, envs = (
        Watched(policy, monkeypatch, lambda e: (e.prompt[0], e.state.clone())),
        InlineEnvs(),
    )
    roll(policy, [UNMASK], envs)
    done = np.stack(envs.made[UNMASK].actions).astype(np.float32)
    for past, (prompt, state) in zip(
        (done[:0], done[:16], done[16:32]), watched.observed, strict=True
    ):
        expected, _ = policy.processor.prompt(
            "pick up the red cube", state=state, past_actions=past
        )
        assert torch.equal(prompt, expected)


@pytest.mark.parametrize(("model", "texts"), [
    ("simplesg", ["push 0 times", "push 16 times", "push 32 times"]),
    ("groundsg", ["push at <0, 9>", "push at <16, 9>", "push at <32, 9>"]),
])  # fmt: skip
def test_the_oracles_subgoal_is_that_of_the_current_frame(model, texts, monkeypatch):
    policy = quick_policy(model)
    watched = Watched(policy, monkeypatch, lambda e: (e.subgoal, e.prompt[0]))
    oracle = build_predictor(
        {"name": "oracle", "kind": policy.config["subgoal_text"]["kind"].split("_")[0]}
    )
    roll(policy, [UNMASK], InlineEnvs(), subgoals=oracle)
    assert [text for text, _ in watched.observed] == texts
    for text, prompt in watched.observed:
        assert torch.equal(prompt, policy.processor.prompt("pick up the red cube", subgoal=text)[0])


def test_whoever_is_ready_travels_in_one_batch(memoryless, monkeypatch):
    watched = Watched(memoryless, monkeypatch)
    roll(memoryless, JOBS, InlineEnvs(workers=6))
    assert watched.batches == [6, 6, 6]
    roll(memoryless, JOBS, InlineEnvs(workers=6), max_batch=4)
    assert max(watched.batches[3:]) == 4 and sum(watched.batches[3:]) == 18


def test_one_at_a_time_results_are_equal_to_the_last_bit_in_any_order():
    policy = quick_policy("tokendrop_expert", 8)

    def digests(jobs, workers):
        records = roll(
            policy, jobs, InlineEnvs(workers, base=make_moving_env, max_steps=24), max_batch=1
        )
        return {r.key: (r.outcome, r.steps, r.actions_sha256) for r in records}

    forward = digests(JOBS, 1)
    assert digests(JOBS[::-1], 4) == forward
    few = digests(JOBS[2:4], 2)
    assert len(few) == 2 and few.items() <= forward.items()
    assert len({digest for _, _, digest in forward.values()}) == len(JOBS), (
        "two episodes had the same noise"
    )


def test_batches_change_rounding_alone(memoryless):
    alone, together = InlineEnvs(1), InlineEnvs(6)
    a = roll(memoryless, JOBS, alone, max_batch=1)
    b = roll(memoryless, JOBS, together, max_batch=6)
    assert sorted((r.key, r.outcome, r.steps) for r in a) == sorted(
        (r.key, r.outcome, r.steps) for r in b
    )
    for job in JOBS:
        first, second = alone.made[job].actions, together.made[job].actions
        assert np.abs(np.stack(first) - np.stack(second)).max() < 1e-4


def test_actions_that_are_no_numbers_end_the_episode_alone(memoryless, monkeypatch):
    act, broken = memoryless.act, episode_seed(42, "PickXtimes", 1)

    def sick(episodes, *args):
        chunks = act(episodes, *args).copy()
        for episode, chunk in zip(episodes, chunks, strict=True):
            if episode._generator.initial_seed() == broken:
                chunk[3] = np.nan
        return chunks

    monkeypatch.setattr(memoryless, "act", sick)
    records = {record.key: record for record in roll(memoryless, JOBS, InlineEnvs(2))}
    assert len(records) == len(JOBS)
    assert [key for key, record in records.items() if record.outcome == "error"] == [
        ("PickXtimes", 1)
    ]
    assert "finite" in records[("PickXtimes", 1)].error
