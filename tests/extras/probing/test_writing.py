"""The score of writing: its definitions on synthetic episodes, and that it separates evidence from
chance on tasks.
"""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers.rollout_fakes import quick_policy
from mme_vla import UserError
from mme_vla.envs.base import environment
from mme_vla.envs.episodes import choose_episodes
from mme_vla.envs.facts import Fact
from mme_vla.envs.metadata import TASK_NAMES
from mme_vla.extras.probing.cli.analyse import main
from mme_vla.extras.probing.evidence import EvidenceEpisode, record_evidence
from mme_vla.extras.probing.writing import (
    FRAMES,
    LONGEST,
    operations_of,
    required_frames,
    score_episode,
    score_writing,
    writing_table,
)
from mme_vla.memory.extensions.events import Events
from mme_vla.memory.extensions.keyframes import Keyframes
from mme_vla.memory.extensions.retrieval import Retrieval
from mme_vla.memory.framesamp import FrameSamp
from mme_vla.memory.tokendrop import TokenDrop
from mme_vla.memory.ttt import TTT

REPOSITORY = Path(__file__).parents[3]
FACTS = {"a": np.arange(10), "b": np.arange(20, 30)}


def synthetic(length: int = 300, exec_start: int = 100, number: int = 0) -> EvidenceEpisode:
    """An episode with a reveal and three short events, the last of them in the execution."""
    facts = [Fact("open", "red", (0, 31))]
    for i, at in enumerate((50, 90, 170)):
        facts.append(Fact(f"event {i}", str(i), (at, at + 15)))
    states = np.random.default_rng(number).normal(size=(length, 8)).astype(np.float32)
    return EvidenceEpisode(
        "Task", number, length, exec_start, facts, np.array([0, 100, 200]), states, {}
    )


@pytest.mark.parametrize(
    ("selection", "precision", "recall", "lags"),
    [
        (
            lambda step: [0, 20],
            1.0,
            1.0,
            [0, 0],
        ),  # a selection that knows the future holds each fact at once
        (lambda step: [0, step], 0.5, 0.5, [0, 0]),  # `b` is held while it is seen, and then lost
        (
            lambda step: [max(step - 15, 0)],
            3 / 5,
            3 / 10,
            [0, 16],
        ),  # frame 15 … 35: three of five steps show `b`
        (lambda step: [step], 0.0, 0.0, [0, 0]),
        (lambda step: [], 0.0, 0.0, []),
    ],
)
def test_precision_recall_and_lag_of_a_known_selection(selection, precision, recall, lags) -> None:
    score = score_episode(
        lambda step: np.array([f for f in selection(step) if f <= step], np.int64),
        FACTS,
        length=50,
        exec_start=32,
    )
    assert score is not None and score.facts == 2
    assert (score.precision, score.recall) == pytest.approx((precision, recall))
    assert list(score.lags) == lags


def test_storage_and_update_are_counted_at_the_decisions() -> None:
    old = Fact("visit 0", "1", (0, 9), needed=(40, 60), changed=20)
    new = Fact("visit 1", "2", (20, 29), needed=(40, 60))
    unused = Fact("light", "red", (30, 35))
    facts = [old, new, unused]
    both = operations_of(lambda step: np.array([3, 22, 25, 33]), facts)
    assert (both.stored, both.updated, both.n_stored) == ([True] * 4, [True] * 2, [2, 2])
    stale = operations_of(lambda step: np.array([1, 3, 22]), facts)
    assert (stale.stored, stale.updated) == ([True] * 4, [False] * 2)
    lost = operations_of(lambda step: np.array([22] if step < 50 else [step]), facts)
    assert lost.stored == [False, True, False, False]
    assert (lost.updated, lost.n_stored) == ([True, False], [1, 0])
    later = operations_of(lambda step: np.array([3]), [Fact("a", "1", (0, 9), (15,), changed=20)])
    assert (later.stored, later.updated) == ([True], [])


def test_operations_stand_beside_the_score() -> None:
    episode = synthetic()
    facts = [replace(fact, needed=(200,)) for fact in episode.facts]
    facts[0] = replace(facts[0], changed=50)
    episodes = [replace(episode, facts=facts)]
    memory = FrameSamp(32, 16, budget=512, grid=4)
    mean = score_writing(memory, episodes).to_dict()["mean"]
    assert (mean["storage"], mean["compression"]) == (1, 4 / 512)
    assert mean["update"] == 0, "of a longer reveal more frames are kept than of what replaced it"
    oracle = score_writing("oracle", episodes).to_dict()["mean"]
    assert (oracle["storage"], oracle["update"], oracle["compression"]) == (1, 1, None)
    assert score_writing("oracle", [synthetic()]).to_dict()["mean"]["storage"] is None


def test_chance_is_the_expectation_for_as_many_frames_at_random() -> None:
    score = score_episode(lambda step: np.array([step]), FACTS, length=44, exec_start=40)
    assert score is not None, "the only step of the execution is 40"
    assert score.chance_precision == pytest.approx(
        20 / 41
    ) and score.chance_recall == pytest.approx(10 / 41)
    pair = score_episode(lambda step: np.array([0, step]), FACTS, length=44, exec_start=40)
    assert pair is not None and pair.chance_recall == pytest.approx(1 - (31 * 30) / (41 * 40))
    episodes = [synthetic(number=i) for i in range(20)]
    row = score_writing("random", episodes).to_dict()["mean"]
    assert row["score"] == pytest.approx(row["chance"], abs=0.02)


def test_an_episode_without_facts_has_no_score() -> None:
    assert score_episode(lambda step: np.array([step]), {}, length=50, exec_start=10) is None
    assert score_writing("oracle", []).tasks == {}, "no scene could be built"
    nothing, scored = score_writing("oracle", []), score_writing("oracle", [synthetic()])
    assert writing_table({"a": nothing, "oracle": scored}) == writing_table({"oracle": scored})
    assert (
        score_episode(
            lambda step: np.array([step]), {"late": np.array([49])}, length=50, exec_start=10
        )
        is None
    )


def test_the_oracle_keeps_what_is_needed_and_nothing_else() -> None:
    mean = score_writing("oracle", [synthetic()]).to_dict()["mean"]
    assert (mean["precision"], mean["recall"], mean["score"], mean["held"]) == (
        1,
        1,
        1,
        1,
    ) and mean["lag"] < 4
    assert score_writing("boundaries", [synthetic()]).to_dict()["mean"]["score"] < 0.7


def test_a_memory_that_selects_by_index_is_scored_without_an_image() -> None:
    memory = FrameSamp(32, 16, budget=512, grid=4)
    assert required_frames(memory) == frozenset()
    row = score_writing(memory, [synthetic()]).to_dict()
    assert row["mean"]["recall"] > 0.9 and 0.3 < row["mean"]["precision"] < 0.5
    assert abs(row["mean"]["score"] - row["mean"]["chance"]) < 0.1, (
        "evenly spaced frames are no better than random ones"
    )
    assert json.loads(json.dumps(row)) == row and "| `framesamp` |" in writing_table(
        {"framesamp": score_writing(memory, [synthetic()])}
    )


def test_images_are_required_of_the_frames_that_a_memory_scores_or_reads() -> None:
    scored = frozenset([0, *range(7, LONGEST, 8)])
    assert required_frames(TokenDrop(32, 16, grid=4)) == scored
    assert required_frames(Events(32, 16)) == scored, "its states need no image"
    assert required_frames(Retrieval(32, 16, every=8)) == scored


def test_memories_that_need_a_policy_or_keep_no_frames_are_refused() -> None:
    with pytest.raises(UserError, match="reads vision tokens"):
        score_writing(Keyframes(32, 16), [synthetic()])
    with pytest.raises(UserError, match="keeps none"):
        score_writing(TTT(32, 16, max_steps=8, max_video=4), [synthetic()])


@pytest.mark.parametrize("name", ["keyframes", "moment"])
def test_memories_that_read_tokens_are_scored_by_their_policy(name: str) -> None:
    policy = quick_policy(f"{name}_modul", 8).eval()
    memory, base = policy.require_memory(), synthetic(length=120, exec_start=60)
    images = {
        frame: np.full((64, 64, 3), 2 * frame, np.uint8)
        for frame in required_frames(memory)
        if frame < 120
    }
    facts = [fact for fact in base.facts if fact.frames[1] < 120]
    row = score_writing(memory, [replace(base, facts=facts, images=images)], policy).to_dict()[
        "mean"
    ]
    assert 0 < row["precision"] <= 1 and 0 < row["recall"] <= 1 and row["facts"] == 3


@pytest.mark.parametrize(
    "task",
    [
        "VideoUnmask",
        *(pytest.param(t, marks=pytest.mark.nightly) for t in TASK_NAMES if t != "VideoUnmask"),
    ],
)
def test_the_score_separates_evidence_from_chance_on_every_task(task: str) -> None:
    pytest.importorskip(
        "mani_skill", reason="the simulator is not installed: the extra `sim` has it"
    )
    (spec,) = choose_episodes(task, 1)
    episode = record_evidence(spec)
    assert episode is not None and episode.facts
    assert len(episode.facts) <= FRAMES, "the oracle has a place for each fact"
    oracle, chance = (
        score_writing(name, [episode]).to_dict()["mean"]["score"] for name in ("oracle", "random")
    )
    assert oracle >= 0.95 and chance < oracle - 0.1


def test_an_environment_of_ones_own_has_scores_from_its_facts(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.syspath_prepend(REPOSITORY / "examples" / "blink")
    words = (
        "writing --plugins blink --env blink --tasks Blink --episodes 2 --memories tokendrop oracle"
    )
    main(words.split())
    rows = capsys.readouterr().out.splitlines()
    assert next(row for row in rows if "`oracle`" in row).split("|")[8].strip() == "1.00"

    (spec,) = choose_episodes("Blink", 1, env="blink")
    episode = record_evidence(spec, frozenset([0, 2]), env="blink")
    assert episode is not None and episode.facts[0].needed == (4,)
    assert (episode.exec_start, sorted(episode.images)) == (4, [0, 2])
    assert episode.states.shape == (episode.length, 1) and episode.images[0].shape == (64, 64, 3)

    # An environment may leave images out where none is read.
    kind = type(environment("blink"))
    make = kind.make

    def blind(self: Any, spec: Any, render: bool = True) -> Any:
        env = make(self, spec, render)
        env.observe = lambda light=False: {"state": np.array([env.arm], np.float32)}
        return env

    with monkeypatch.context() as changes:
        changes.setattr(kind, "make", blind)
        unseen = record_evidence(spec, env="blink")
    assert unseen is not None and unseen.facts == episode.facts and not unseen.images

    # Frames that no policy sees: those after the last action.
    late = [Fact("light", "left", (0, 99), (4, 99)), Fact("end", "x", (99, 99))]
    monkeypatch.setattr(type(environment("blink")), "facts", lambda self, env: late)
    episode = record_evidence(spec, env="blink")
    assert episode is not None
    assert episode.facts == [Fact("light", "left", (0, episode.length - 1), (4,))]


@pytest.mark.nightly
def test_the_command_writes_scores_and_tables(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip(
        "mani_skill", reason="the simulator is not installed: the extra `sim` has it"
    )
    output = tmp_path / "writing.json"
    words = (
        "writing --memories anchors oracle --set memory.spacing=15 --tasks VideoUnmask --episodes 1"
        " --output"
    )
    main([*words.split(), str(output)])
    rows = json.loads(output.read_text())
    assert rows["oracle"]["mean"]["score"] == 1 and rows["anchors"]["mean"]["recall"] == 1, (
        "the cubes lie open at frame 0"
    )
    assert output.with_suffix(".md").read_text() in capsys.readouterr().out
