"""A probe finds what a policy reads in its memory, and nothing where it reads nothing."""

import json
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from helpers.probe_fakes import made_up, probed, reader
from helpers.rollout_fakes import quick_policy
from mme_vla import probe
from mme_vla.config.composition import compose
from mme_vla.errors import UserError
from mme_vla.extras.probing import run as run_module
from mme_vla.extras.probing.arms import UNPROBED, choose_arms, read_arm
from mme_vla.extras.probing.channels import channel_of
from mme_vla.extras.probing.findings import Findings
from mme_vla.extras.probing.interventions import NoDemo
from mme_vla.extras.probing.lines import EntryLine, MomentLine, append, read
from mme_vla.extras.probing.offline import compare_chunks
from mme_vla.extras.probing.probed import ProbedPolicy
from mme_vla.extras.probing.run import ProbePlan
from mme_vla.extras.probing.settings import ProbeChoice
from mme_vla.memory.perturbation import Pause, Perturbation
from mme_vla.policy.build import policy_config
from mme_vla.testing.small import small_policy

NEURAL_ARMS = [
    "drop:all",
    "shuffle",
    "swap",
    "delay:16",
    "recent:8",
    "oracle",
    "pause:8",
    "distract:1",
    "nodemo",
]


@pytest.mark.parametrize("slot", [0, 2, 4])
def test_the_slot_that_a_policy_reads_is_detected_at_its_distance(
    slot: int, tmp_path: Path
) -> None:
    findings = Findings.of(probed(reader(slot), [], tmp_path))
    assert len(findings.entries) == 2 * 5
    for entry in findings.entries:
        assert (entry.change > entry.spread) == (entry.slot == slot)
        assert (entry.change == 0) == (entry.slot != slot)
        assert entry.age == entry.step - entry.time
        assert entry.time == np.linspace(0, entry.step, 5).astype(int)[entry.slot]
    mattered = [entry for entry in findings.entries if entry.slot == slot]
    assert findings.reach() == pytest.approx(
        np.average([e.age for e in mattered], weights=[e.change for e in mattered])
    )


def test_only_interventions_that_touch_the_slot_have_an_effect(tmp_path: Path) -> None:
    words = [
        {"name": "drop", "which": "newest"},
        {"name": "drop", "which": "oldest"},
        "swap",
        "shuffle",
        "delay:64",
    ]
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


def test_a_memoryless_policy_shows_no_effect(tmp_path: Path) -> None:
    deaf = Findings.of(probed(reader(None), NEURAL_ARMS, tmp_path / "deaf"))
    assert [arm.change for arm in deaf.arms().values()] == [0] * len(NEURAL_ARMS)
    assert all(arm.spread > 0 and arm.distance == 0 for arm in deaf.arms().values())
    assert all(entry.change == 0 for entry in deaf.entries) and len(deaf.entries) == 10
    memoryless = quick_policy("pi05").eval()
    arm = Findings.of(
        probed(memoryless, ["pause:8", "distract:1", "nodemo"], tmp_path / "memoryless")
    )
    assert [effect.change for effect in arm.arms().values()] == [0, 0, 0] and not arm.entries


def test_interventions_on_entries_are_refused_where_there_are_none() -> None:
    policy = quick_policy("pi05")
    with pytest.raises(
        UserError, match="with=shuffle needs something remembered that the probe can reach"
    ):
        choose_arms(["shuffle"], policy, channel_of(policy), 3, boundaries=True)
    arms, notes = choose_arms(None, policy, channel_of(policy), 3, boundaries=True)
    assert [arm.name for arm in arms] == ["nodemo", "pause", "distract:1", "distract:3"]
    assert notes == [
        "drop:all, swap, shuffle were left out: they need something remembered that the probe can"
        " reach.",
        "recent, oracle were left out: they need a memory that chooses among stored frames.",
        "delay:16, delay:64, delay:256 were left out: they need entries that have a time.",
    ], "a reason once, and none for the subgoals that this policy cannot read"
    with pytest.raises(UserError, match=r"to take from, and there are 2\.$"):
        choose_arms(["distract:3"], policy, channel_of(policy), 2, boundaries=True)
    with pytest.raises(UserError, match="recordings="):
        choose_arms(["distract:1"], policy, channel_of(policy), 0, boundaries=True)


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("shufle", "with=shufle: name='shufle'. Did you mean 'shuffle'?"),
        ("nodemo:3", "with=nodemo:3: nodemo takes no number"),
        ("drop:x", "with=drop:x: write a name, as drop, or a name and a number, drop:2"),
        ("drop:0", "drop.count=0 must be a whole number, 1 or more"),
        ({"name": "drop", "which": "old"}, "drop.which='old'. Did you mean 'oldest'?"),
        (7, "with=7"),
        ("gap:3", "with=gap:3: gap changes nothing here; it belongs in event=…."),
        ("pause:3@step:2", "with=pause:3@step:2: write a name"),
    ],
)
def test_words_that_are_no_arms_are_reported(word: Any, message: str) -> None:
    with pytest.raises(UserError) as caught:
        read_arm(word)
    assert message in str(caught.value)


@pytest.mark.parametrize(
    ("word", "meaning"),
    [
        ("drop:all", "everything remembered is removed"),
        ({"name": "drop", "which": "used"}, "1 entry removed: most used"),
        ("delay:-8", "every entry seems to be 8 frames earlier than it was"),
        ("delay:1", "every entry seems to be 1 frame later than it was"),
        ("late:1", "the images of the execution arrive 1 frame late"),
        ("linger:2", "the frame of the decision is repeated 2 more times"),
        ("pause:1", "time stands still for 1 frame"),
        ("recent:1", "only the last frame can be remembered"),
        ("nodemo+pause:8", "the video before the episode is not shown and time stands still for 8"),
        ("distract:3", "3 other episodes first, as if part of this one"),
    ],
)
def test_arms_say_in_plain_words_what_they_do(word: Any, meaning: str) -> None:
    assert read_arm(word).meaning.startswith(meaning)


def test_a_perturbation_without_plain_words_says_the_first_sentence_of_its_class() -> None:
    class Occlude(Perturbation):
        """The robot holds its pose,
        and sees half. More of it.
        """

    assert Occlude().meaning == "The robot holds its pose, and sees half"


def test_arms_compose_in_their_order(tmp_path: Path) -> None:
    arm = read_arm("nodemo+pause:8+drop:2")
    assert not arm.feed.shows_video and arm.feed.perturbations == (NoDemo(), Pause(8)) and arm.edits
    lines = probed(reader(0), ["nodemo", "nodemo+drop:all", "drop:all"], tmp_path)
    moments = [line for line in lines if isinstance(line, MomentLine)]
    assert {len(line.touched) for line in moments if line.arm == "nodemo"} == {0}
    both = [line for line in moments if line.arm == "nodemo+drop:all"]
    assert both and all(line.touched and max(line.touched) <= line.step - 20 for line in both)
    assert any(max(line.touched) > line.step - 20 for line in moments if line.arm == "drop:all")


def test_one_chunk_a_decision_is_too_few_since_its_spread_is_not_known(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="draws=1 must be a whole number, 2 or more"):
        probe("nano", "sample", output=tmp_path, draws=1)


@pytest.mark.parametrize(
    "name", ["framesamp_context", "tokendrop_modul", "ttt_expert", "rmt_modul"]
)
def test_through_the_probe_an_unprobed_policy_answers_as_it_does(name: str) -> None:
    policy = quick_policy(name, 8).eval()
    probe, recording = ProbedPolicy(policy).eval(), made_up()[0]
    mine, its = probe.start_episode(recording.goal, 7), policy.start_episode(recording.goal, 7)
    for episode in (mine, its):
        recording.show(episode, 0, 41)
    snapshot, stores = probe.snapshot(mine)
    draws = [policy.sampling_noise(torch.Generator().manual_seed(7))]
    actual = probe.ask(mine, snapshot, [stores], draws, 2)[0, 0]
    expected = policy.sample_actions(
        policy.observation([its]),
        {k: v[None] for k, v in draws[0].items()},
        2,
        memory=policy.encode_memories([its]),
    )
    action = policy.embodiment.action
    assert torch.allclose(actual, expected[0, : action.execute, : action.width], atol=1e-5)
    chunks = [probe.act(mine, 2), policy.act(its, 2)]
    assert np.array_equal(*chunks) and UNPROBED.feed == ProbedPolicy(policy).arm.feed


def test_what_is_done_is_not_done_again_and_a_torn_line_is_done_anew(tmp_path: Path) -> None:
    lines = probed(reader(2), ["shuffle"], tmp_path, count=2)
    path = tmp_path / "offline.jsonl"
    content = path.read_bytes()
    assert (
        probed(reader(2), ["shuffle"], tmp_path, count=2) == lines and path.read_bytes() == content
    )
    for cut in (100, 1):  # within the last line, and its end alone
        path.write_bytes(content[:-cut])
        with pytest.warns(UserWarning, match="half-written") if cut > 1 else nullcontext():
            assert probed(reader(2), ["shuffle"], tmp_path, count=2) == lines
    append(path, [], "another")
    assert read(path) == (lines, {"made-up/0", "made-up/1", "another"})


def test_a_damaged_line_of_a_probe_is_named(tmp_path: Path) -> None:
    probed(reader(2), ["shuffle"], tmp_path)
    path = tmp_path / "offline.jsonl"
    first, *others = path.read_text().splitlines(keepends=True)
    row = json.loads(first)
    for changed in ({"change": row["change"] + 1}, {"step": row["step"] + 1}):
        path.write_text(json.dumps(row | changed) + "\n" + "".join(others))
        with pytest.raises(UserError, match=r"offline\.jsonl, line 1 is not what was written"):
            read(path)
    del row["crc32"]
    path.write_text(json.dumps(row) + "\n" + "".join(others))  # as earlier versions wrote it
    assert len(read(path)[0]) == len(others)
    for changed in (
        {"change": {"a": 1}},
        {"step": "x"},
        {"step": True},
        {"kind": "other"},
        {"more": 1},
    ):
        path.write_text(json.dumps(row | changed) + "\n" + "".join(others))
        with pytest.raises(UserError, match="line 1"):
            read(path)
    for line in ('{"kind": "done"}', '{"kind": "done", "recording": 7}', "[]"):
        path.write_text(line + "\n")
        with pytest.raises(UserError, match="line 1"):
            read(path)


def test_a_change_is_measured_against_the_noise_of_the_same_policy() -> None:
    before = torch.randn(6, 4, 2, generator=torch.Generator().manual_seed(0))
    same, changed = compare_chunks(before, before.clone()), compare_chunks(before, before + 0.5)
    assert (same.change, same.distance) == (0, 0) and same.spread > 0
    assert (
        changed.change == pytest.approx(0.5)
        and changed.spread == same.spread
        and changed.distance > 0
    )
    assert compare_chunks(before, before[[1, 2, 3, 4, 5, 0]]).distance == pytest.approx(
        0, abs=1e-12
    )


def test_settings_of_recordings_and_rollouts_are_keywords(tmp_path: Path) -> None:
    policy = small_policy("framesamp_modul")
    options: dict[str, Any] = {"draws": 2, "moments": 1, "scan": False, "workers": 1}
    page = probe(
        policy, "sample", ["shuffle"], output=tmp_path, show_progress=False, **options
    ).page
    assert "shuffle" in page.read_text()
    with pytest.raises(UserError, match="Unknown key moment"):
        probe(policy, "sample", ["shuffle"], output=tmp_path, moment=1)


def test_recordings_are_read_as_the_policy_was_trained(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy = small_policy("framesamp_modul")
    policy.config["data"] = {"action_offset": 1}
    plans: list[ProbePlan] = []
    monkeypatch.setattr(run_module, "run_probe", lambda _, plan, *others: plans.append(plan))
    probe(policy, "sample", ["shuffle"], output=tmp_path)
    assert {recording.action_offset for recording in plans[0].recordings} == {1}


def test_names_of_a_checkpoints_plugins_are_checked_once_the_plugins_are_imported() -> None:
    words = ["checkpoint=run", "recordings=sample", "with=[hesitate:8]"]
    trusting = policy_config(compose("probe", [*words, "trust_plugins=true"]))
    ProbeChoice.from_config(trusting).check()
    with pytest.raises(UserError, match="name='hesitate'"):
        ProbeChoice.from_config(policy_config(compose("probe", words))).check()
