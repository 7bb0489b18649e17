"""Interventions reach every kind of policy that remembers, and show it what they say."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from helpers.probe_fakes import MadeUpSource, made_up, probed
from helpers.rollout_fakes import quick_policy
from mme_vla import build_policy
from mme_vla.errors import UserError
from mme_vla.extras.methods.sam2act.sam2 import BankState
from mme_vla.extras.probing.arms import UNPROBED, choose_arms, read_arm
from mme_vla.extras.probing.channels import channel_of
from mme_vla.extras.probing.lines import MomentLine
from mme_vla.extras.probing.probed import DonorEpisodes, ProbedEpisode, ProbedPolicy
from mme_vla.memory.base import all_patches
from mme_vla.memory.history import History, OnlineHistory
from mme_vla.processing.normalise import NormStats
from mme_vla.testing.small import unit_stats
from mme_vla.training.open_loop import open_loop

JOINED: list[dict[str, Any]] = [{"name": "framesamp", "budget": 64}, {"name": "ttt", "budget": 64}]


def diffusion_with_memory() -> Any:
    pytest.importorskip("diffusers")
    tower = {
        "image_size": 32,
        "patch_size": 2,
        "width": 16,
        "depth": 1,
        "mlp_dim": 16,
        "num_heads": 2,
    }
    policy = build_policy(
        "diffusion_policy", backbone={"memory_tower": tower}, memory="tokendrop", integration="film"
    )
    policy.require_processor().stats = unit_stats(policy.embodiment)
    return policy.eval()


def memoryvla() -> Any:
    policy = build_policy("memoryvla", backbone={"vision": {"image_size": 28}})
    policy.require_processor().stats = unit_stats(policy.embodiment)
    generator = torch.Generator().manual_seed(0)
    for (
        name,
        parameter,
    ) in policy.core.named_parameters():  # what begins at zero would hide what does not arrive
        if name.endswith(("head.output.weight", "in_proj_weight")):
            torch.nn.init.normal_(parameter, std=0.3, generator=generator)
    return policy.eval()


def by_choices() -> Any:
    policy: Any = build_policy(
        "framesamp_modul", backbone="nano_choice", **{"backbone.point": "regression"},
        embodiment="robomme_choice_front", memory={"budget": 4, "grid": 1},
    )  # fmt: skip
    policy.require_processor().stats = NormStats.unit(8, 10)
    for parameter in policy.integration.parameters():  # as above: a fresh modulator changes nothing
        torch.nn.init.normal_(parameter, std=0.3, generator=torch.Generator().manual_seed(0))
    return policy.eval()


KINDS = {
    "perceptual": lambda: quick_policy("framesamp_expert", 8).eval(),
    "by change": lambda: quick_policy("tokendrop_context", 8).eval(),
    "recurrent": lambda: quick_policy("ttt_modul", 8).eval(),
    "joined": lambda: quick_policy("pi05", 8, memory=JOINED, integration="context").eval(),
    "film": diffusion_with_memory,
    "bank": memoryvla,
    "by choices": by_choices,
}


def chunks(policy: Any, word: str | None, step: int = 36) -> tuple[ProbedPolicy, list[np.ndarray]]:
    """What a policy chooses under an arm at two moments of a synthetic episode."""
    recordings = made_up(robot=policy.embodiment)
    recording = recordings[0]
    arm = read_arm(word) if word else UNPROBED
    donors = DonorEpisodes(policy, channel_of(policy), recordings) if word == "swap" else None
    probe = ProbedPolicy(policy, arm, recordings[1:], donors)
    probe.eval()
    episode = probe.start_episode(recording.goal, 5)
    episode.recording = recording
    chunks_, n_frames = [], 0
    for now in (20, step):
        recording.show(episode, n_frames, now + 1)
        n_frames = now + 1
        chunks_.append(probe.act(episode, 2))
    return probe, chunks_


@pytest.mark.parametrize("kind", KINDS)
def test_every_memory_answers_otherwise_when_its_entries_are_others(kind: str) -> None:
    policy = KINDS[kind]()
    baseline = chunks(policy, None)[1]
    words = ["drop:all", "shuffle", "swap", "delay:40"] + (
        ["recent:4"] if channel_of(policy).chooses else []
    )
    for word in words:
        changed = chunks(policy, word)[1]
        if not (kind == "by change" and word == "shuffle"):
            # where all that changed is of one frame, nothing moves
            assert any(
                np.abs(a - b).max() > 1e-6 for a, b in zip(baseline, changed, strict=True)
            ), word
    assert all(
        np.array_equal(*pair) for pair in zip(baseline, chunks(policy, None)[1], strict=True)
    )


@pytest.mark.parametrize("model", ["actions_modul", "events_modul"])
def test_a_memory_that_reads_the_robots_motion_can_be_probed(model: str) -> None:
    policy = quick_policy(model, 8).eval()
    baseline = chunks(policy, None)[1]
    for word in ("drop:all", "swap", "recent:4", "noise:1"):
        changed = chunks(policy, word)[1]
        same = [np.array_equal(a, b) for a, b in zip(baseline, changed, strict=True)]
        assert not all(same), word  # a fresh memory changes little


@pytest.mark.parametrize("word", ["shuffle", "recent:24"])
def test_a_memory_that_chooses_by_stored_tokens_keeps_its_choice(word: str) -> None:
    policy = quick_policy("framesamp_modul", 8).eval()
    memory = policy.require_memory()
    rows: list[np.ndarray] = []

    def brightest(history: History, step: int, rng: Any = None) -> np.ndarray:
        """The newest frame and that with the largest token, among the stored ones."""
        stored = history.stored_frames
        stored = stored[stored <= step]
        tokens = history.stored(all_patches(stored, memory.storage.grid))
        largest = tokens.unflatten(0, (len(stored), -1)).amax((1, 2)).argmax()
        rows.append(all_patches(np.unique([stored[int(largest)], stored[-1]]), memory.storage.grid))
        return rows[-1]

    memory.select = brightest  # type: ignore[method-assign]
    chunks(policy, word)
    # Of a decision: what is remembered, and the same with other contents.
    for mine, others in zip(rows[::2], rows[1::2], strict=True):
        assert np.array_equal(mine, others)


@pytest.mark.parametrize("kind", ["perceptual", "recurrent", "film", "bank"])
def test_probe_frames_equal_manually_composed_ones(kind: str) -> None:
    policy = KINDS[kind]()
    recordings = made_up(robot=policy.embodiment)
    recording, other = recordings[0], recordings[1]
    by_hand: dict[str, Any] = {}
    for name in ("nodemo", "distract:1"):
        episode = policy.start_episode(recording.goal, 5)
        if name == "distract:1":
            other.show(episode, 0, other.length, video=True)
        recording.show(episode, 0 if name == "distract:1" else recording.exec_start, 21)
        by_hand[name] = policy.act(episode, 2)
    for name, expected in by_hand.items():
        assert np.array_equal(chunks(policy, name)[1][0], expected), name


def test_a_policy_by_choices_reads_the_recorded_options_and_each_motion_once(
    tmp_path: Path,
) -> None:
    policy, goals = by_choices(), set()
    prompt = policy.processor.prompt
    policy.processor.prompt = lambda goal, **others: (goals.add(goal), prompt(goal, **others))[1]
    lines = probed(policy, ["distract:1", "swap"], tmp_path, moments=3)
    assert {line.arm for line in lines if isinstance(line, MomentLine)} == {"distract:1", "swap"}
    assert goals == {"pick up the cube number 0. Options: a pick up cube 0 (point), c drop it"}

    policy = quick_policy("pi05_past_actions", 8, embodiment="robomme_choice_front")
    recording = made_up(robot=policy.embodiment)[0]
    episode = policy.start_episode(recording.goal)
    for start, stop in ((0, 21), (21, 25), (25, 27)):
        recording.show(episode, start, stop)
    assert episode._executed[:, 0].tolist() == [20, 21, 22, 23, 24, 25]


def test_a_pause_is_a_frame_repeated() -> None:
    policy = KINDS["perceptual"]()
    recording = made_up()[0]
    expected = policy.start_episode(recording.goal, 5)
    recording.show(expected, 0, 21)
    for _ in range(6):
        views, _ = recording.views(20, 21, None)
        expected.observe(views, recording.source.states(0, 20, 21), False)
    policy.act(expected, 2)
    recording.show(expected, 21, 37)
    probe, chunks_ = chunks(policy, "pause:6")
    assert np.array_equal(chunks_[1], policy.act(expected, 2))
    episode = probe.start_episode(recording.goal, 5)
    recording.show(episode, 0, 37)
    assert isinstance(episode.inner.history, OnlineHistory)
    assert (len(episode.inner.history), episode.n_observed_frames) == (43, 37)


def test_a_memory_stored_where_chunks_are_selected_sees_no_pause() -> None:
    policy = memoryvla()
    with pytest.raises(UserError, match="a memory that sees frames at which nothing is decided"):
        choose_arms(["pause"], policy, channel_of(policy), 3, boundaries=True)
    arms, _ = choose_arms(None, policy, channel_of(policy), 3, boundaries=True)
    names = {arm.name.partition(":")[0] for arm in arms}
    assert names == {"drop", "nodemo", "swap", "shuffle", "delay", "distract"}


def test_keyframes_are_probed_and_the_bank_goes_on_as_it_was() -> None:
    policy = build_policy("sam2act_plus")
    channel = channel_of(policy)
    episode: Any = policy.start_episode("pick up the cube")
    maps = tuple(torch.full((3, 4, 2), float(i)) for i in range(3))
    episode.remembered = BankState(maps)
    snapshot = channel.read(episode)
    store = snapshot.stores[0]
    assert [store.age(slot) for slot in store.occupied] == [3, 2, 1]
    twin = channel.counterfactual(episode, snapshot, [store.without([1])])
    assert [float(m[0, 0, 0]) for m in twin.remembered.maps] == [0, 2] and len(
        episode.remembered
    ) == 3
    twin.decided(BankState((*twin.remembered.maps, torch.full((3, 4, 2), 9.0))))
    channel.commit(episode, twin)
    assert [float(m[0, 0, 0]) for m in episode.awaiting.maps][-4:] == [0, 1, 2, 9][
        -policy.backbone.sizes.remembered :
    ]
    with pytest.raises(UserError, match="entries that have a time"):
        choose_arms(["delay"], policy, channel, 3, boundaries=True)


@pytest.mark.parametrize(
    ("word", "message", "expected"),
    [
        (
            "subgoal_count",
            "pick it up for the first time at <1, 2>",
            "pick it up for the second time at <1, 2>",
        ),
        ("subgoal_count:-1", "press 3 times, then one", "press 2 times, then ten"),
        ("subgoal_delay:1", "the third thing", "the second thing"),
    ],
)
def test_subgoals_can_be_wrong_by_one_or_late(word: str, message: str, expected: str) -> None:
    policy = quick_policy("simplesg")
    probe = ProbedPolicy(policy, read_arm(word))
    episode = probe.start_episode("press the button")
    episode.subgoals = ["the second thing"]
    episode.subgoal = message
    assert probe.arm.say(message, probe.moment(episode)) == expected


@pytest.mark.parametrize(
    ("model", "word"), [("simplesg", "subgoal_delay:1"), ("framesamp_modul", "forget")]
)
def test_a_decision_that_is_repeated_after_a_failure_is_the_same_one(
    model: str, word: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy = quick_policy(model, 8).eval()
    recording = made_up()[0]
    fails: list[bool] = []

    def decisions(probe: ProbedPolicy) -> tuple[list[np.ndarray], ProbedEpisode]:
        episode = probe.start_episode(recording.goal, 5)
        actions, n_frames = [], 0
        for now in (20, 36, 52):
            episode.subgoal = f"the one of step {now}"
            recording.show(episode, n_frames, now + 1)
            n_frames = now + 1
            state = episode.noise_state
            for _ in fails:
                monkeypatch.setattr(probe, "predict_chunk", out_of_memory)
                with pytest.raises(torch.OutOfMemoryError):
                    probe.act(episode, 2)
                monkeypatch.undo()
                episode.noise_state = state
            actions.append(probe.act(episode, 2))
        return actions, episode

    def out_of_memory(*_: Any, **__: Any) -> Any:
        raise torch.OutOfMemoryError

    expected, _ = decisions(ProbedPolicy(policy, read_arm(word)).eval())
    fails.append(True)
    repeated, episode = decisions(ProbedPolicy(policy, read_arm(word)).eval())
    assert all(np.array_equal(*pair) for pair in zip(expected, repeated, strict=True))
    assert episode.subgoals == [f"the one of step {now}" for now in (20, 36, 52)]


def test_a_subgoal_of_another_episode_reaches_the_prompt() -> None:
    policy = quick_policy("simplesg").eval()
    recordings = made_up()
    probe = ProbedPolicy(
        policy,
        read_arm("subgoal_swap"),
        donors=DonorEpisodes(policy, channel_of(policy), recordings),
    )
    episode = probe.start_episode(recordings[0].goal, 1)
    episode.recording = recordings[0]
    recordings[0].show(episode, 0, 21)
    episode.subgoal = recordings[0].subgoal(20)
    probe.eval().act(episode, 2)
    assert episode.subgoal.endswith("number 0")
    assert episode.inner.subgoal[-1] in "12" and episode.inner.subgoal.startswith(
        "pick it up for the first time"
    )


def test_on_recordings_a_late_subgoal_is_that_of_chunks_ago_however_few_are_probed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def subgoals(source: MadeUpSource, episode: int, step: int) -> dict[str, str]:
        return {"simple_subgoal": f"the one of step {step}"}

    monkeypatch.setattr(MadeUpSource, "subgoals", subgoals)
    read = []
    ask = ProbedPolicy.ask

    def note(probe: ProbedPolicy, episode: ProbedEpisode, *arguments: Any, **options: Any) -> Any:
        read.append((probe.arm.name, episode.inner.subgoal))
        return ask(probe, episode, *arguments, **options)

    monkeypatch.setattr(ProbedPolicy, "ask", note)
    probed(quick_policy("simplesg", 8).eval(), ["subgoal_delay:1"], tmp_path, moments=2)
    # Decisions are at 20, 36 and 52.
    assert read == [
        ("unprobed", "the one of step 20"),
        ("subgoal_delay:1", "the one of step 20"),
        ("unprobed", "the one of step 52"),
        ("subgoal_delay:1", "the one of step 36"),
    ]


def test_a_bank_holds_every_decision_however_few_are_probed(tmp_path: Path) -> None:
    entries = []
    for moments in (None, 2):
        folder = tmp_path / str(moments)
        folder.mkdir()
        lines = probed(memoryvla(), ["drop:all"], folder, draws=2, moments=moments, scan=False)
        entries.append([(line.step, line.entries) for line in lines])
    every, few = entries
    assert [step for step, *_ in few] == [20, 52]
    assert few == [every[0], every[-1]]


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_policy_is_checked_open_loop(kind: str) -> None:
    policy = KINDS[kind]()
    recording = made_up(robot=policy.embodiment)[0]
    first = open_loop(policy, recording, "an episode", most=3, seed=1)
    again = open_loop(policy, recording, "an episode", most=3, seed=1)
    assert first.predicted.shape[::2] == (3, policy.embodiment.action.width)
    assert first.recorded.shape == first.predicted.shape
    np.testing.assert_array_equal(first.predicted, again.predicted)
    assert "baseline" in first.verdict()
