"""A probe finds what a policy reads in its memory, and nothing where it reads nothing."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from probe_stand_ins import made_up, probed, reader
from rollout_stand_ins import quick_policy

from mme_vla.errors import UserError
from mme_vla.probing.arms import UNPROBED, choose_arms, read_arm
from mme_vla.probing.channels import channel_of
from mme_vla.probing.lines import EntryLine, MomentLine
from mme_vla.probing.offline import compare_chunks
from mme_vla.probing.probed import ProbedPolicy
from mme_vla.probing.report import Findings

NEURAL_ARMS = ["drop:all", "shuffle", "swap", "delay:16", "recent:8", "oracle", "pause:8", "distract:1", "nodemo"]


@pytest.mark.parametrize("slot", [0, 2, 4])
def test_the_slot_that_a_policy_reads_is_found_at_its_distance(slot: int, tmp_path: Path) -> None:
    found = Findings.of(probed(reader(slot), [], tmp_path))
    assert len(found.entries) == 2 * 5
    for entry in found.entries:
        assert (entry.change > entry.spread) == (entry.slot == slot)
        assert (entry.change == 0) == (entry.slot != slot)
        assert entry.age == entry.step - entry.time
        assert entry.time == np.linspace(0, entry.step, 5).astype(int)[entry.slot]
    mattered = [entry for entry in found.entries if entry.slot == slot]
    assert found.reach() == pytest.approx(np.average([e.age for e in mattered], weights=[e.change for e in mattered]))


def test_only_interventions_that_touch_the_slot_have_an_effect(tmp_path: Path) -> None:
    words = [{"name": "drop", "which": "newest"}, {"name": "drop", "which": "oldest"}, "swap", "shuffle", "delay:64"]
    arms = Findings.of(probed(reader(4), words, tmp_path)).arms()
    assert arms["drop(which=oldest)"].change == 0 and arms["delay:64"].change == 0
    for name in ("drop(which=newest)", "swap", "shuffle"):
        assert arms[name].change > arms[name].spread > 0, name


def test_the_entry_that_is_used_most_is_dropped_first(tmp_path: Path) -> None:
    lines = probed(reader(1), [{"name": "drop", "which": "used"}], tmp_path)
    moments = [line for line in lines if isinstance(line, MomentLine)]
    entries = {(e.step, e.slot): e for e in lines if isinstance(e, EntryLine)}
    for line in moments:
        assert line.touched == [entries[line.step, 1].age]
        assert line.change == pytest.approx(entries[line.step, 1].change)


def test_a_policy_that_cannot_remember_shows_no_effect(tmp_path: Path) -> None:
    deaf = Findings.of(probed(reader(None), NEURAL_ARMS, tmp_path / "deaf"))
    assert [found.change for found in deaf.arms().values()] == [0] * len(NEURAL_ARMS)
    assert all(found.spread > 0 and found.distance == 0 for found in deaf.arms().values())
    assert all(entry.change == 0 for entry in deaf.entries) and len(deaf.entries) == 10
    memoryless = quick_policy("pi05").eval()
    found = Findings.of(probed(memoryless, ["pause:8", "distract:1", "nodemo"], tmp_path / "memoryless"))
    assert [effect.change for effect in found.arms().values()] == [0, 0, 0] and not found.entries


def test_interventions_on_entries_are_refused_where_there_are_none() -> None:
    policy = quick_policy("pi05")
    with pytest.raises(UserError, match="with=shuffle needs something remembered that the probe can reach"):
        choose_arms(["shuffle"], policy, channel_of(policy), 3, boundaries=True)
    arms, notes = choose_arms(None, policy, channel_of(policy), 3, boundaries=True)
    assert [arm.name for arm in arms] == ["nodemo", "pause", "distract:1", "distract:3"]
    assert "shuffle was left out: it needs something remembered that the probe can reach." in notes
    with pytest.raises(UserError, match="3 recorded episodes to take from, and there are 2"):
        choose_arms(["distract:3"], policy, channel_of(policy), 2, boundaries=True)
    with pytest.raises(UserError, match="recordings="):
        choose_arms(["distract:1"], policy, channel_of(policy), 0, boundaries=True)


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("shufle", "Unknown intervention 'shufle'. Did you mean 'shuffle'?"),
        ("nodemo:3", "the intervention nodemo has no dial"),
        ("drop:x", "the dial count of drop is a whole number"),
        ("drop:0", "drop.count=0 must be a whole number, at least 1"),
        ({"name": "drop", "which": "old"}, "drop.which='old'. Did you mean 'oldest'?"),
        (7, "with=7"),
    ],
)
def test_words_that_are_no_arms_are_told(word: Any, message: str) -> None:
    with pytest.raises(UserError) as told:
        read_arm(word)
    assert message in str(told.value)


def test_arms_compose_in_their_order(tmp_path: Path) -> None:
    arm = read_arm("nodemo+pause:8+drop:2")
    assert (arm.feed.video, arm.feed.stills) == (False, 8) and arm.edits
    lines = probed(reader(0), ["nodemo", "nodemo+drop:all", "drop:all"], tmp_path)
    moments = [line for line in lines if isinstance(line, MomentLine)]
    assert {len(line.touched) for line in moments if line.arm == "nodemo"} == {0}
    both = [line for line in moments if line.arm == "nodemo+drop:all"]
    assert both and all(line.touched and max(line.touched) <= line.step - 20 for line in both)
    assert any(max(line.touched) > line.step - 20 for line in moments if line.arm == "drop:all")


@pytest.mark.parametrize("name", ["framesamp_context", "tokendrop_modul", "ttt_expert", "rmt_modul"])
def test_through_the_probe_an_unprobed_policy_answers_as_it_does(name: str) -> None:
    policy = quick_policy(name, 8).eval()
    probe, recording = ProbedPolicy(policy).eval(), made_up()[0]
    mine, its = probe.start_episode(recording.goal, 7), policy.start_episode(recording.goal, 7)
    for episode in (mine, its):
        recording.show(episode, 0, 41)
    recollection, stores = probe.snapshot(mine)
    drawn = [policy.sampling_noise(torch.Generator().manual_seed(7))]
    asked = probe.ask(mine, recollection, [stores], drawn, 2)[0, 0]
    given = policy.sample_actions(policy.observation([its]), {k: v[None] for k, v in drawn[0].items()}, 2,
                                  memory=policy._memory_tokens([its], policy.observation([its])))  # fmt: skip
    action = policy.embodiment.action
    assert torch.allclose(asked, given[0, : action.execute, : action.width], atol=1e-5)
    chunks = [probe.act(mine, 2), policy.act(its, 2)]
    assert np.array_equal(*chunks) and UNPROBED.feed == ProbedPolicy(policy).arm.feed


def test_what_is_done_is_not_done_again_and_a_torn_line_is_done_anew(tmp_path: Path) -> None:
    lines = probed(reader(2), ["shuffle"], tmp_path, count=2)
    path = tmp_path / "offline.jsonl"
    whole = path.read_bytes()
    assert probed(reader(2), ["shuffle"], tmp_path, count=2) == lines and path.read_bytes() == whole
    path.write_bytes(whole[:-60])
    with pytest.warns(UserWarning, match="half-written"):
        again = probed(reader(2), ["shuffle"], tmp_path, count=2)
    assert again == lines


def test_a_change_is_measured_against_the_noise_of_the_same_policy() -> None:
    before = torch.randn(6, 4, 2, generator=torch.Generator().manual_seed(0))
    same, moved = compare_chunks(before, before.clone()), compare_chunks(before, before + 0.5)
    assert (same.change, same.distance) == (0, 0) and same.spread > 0
    assert moved.change == pytest.approx(0.5) and moved.spread == same.spread and moved.distance > 0
    assert compare_chunks(before, before[[1, 2, 3, 4, 5, 0]]).distance == pytest.approx(0, abs=1e-12)
