"""Players without hands: the oracle, a tiny Qwen3-VL, and a stand-in for the API; unusable answers
of every kind.
"""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from helpers.play_fakes import BLOCKS, MOTION, VIDEO, a_session
from helpers.subgoal_fakes import Client, kinds, response, turns
from mme_vla.config.composition import compose
from mme_vla.errors import UserError
from mme_vla.evaluation.store import read_records
from mme_vla.extras.play import GeminiPlayer, OraclePlayer, QwenPlayer, build_player
from mme_vla.extras.play.cli import main
from mme_vla.extras.play.game import Option
from mme_vla.extras.play.players import play
from mme_vla.extras.play.vlm_players import parse_choice
from mme_vla.subgoal.models.replies import Reply
from mme_vla.subgoal.text import MalformedReply

OPTIONS = (Option("a", "press the block", True), Option("b", "wait", False))


def says(name):
    """The right answer for a block, in thousandths."""
    return (
        'I see it. {"choice": "a", "point":'
        f" {[round(1000 * (v + 0.5) / 256) for v in BLOCKS[name]]}}}"
    )


# Answers ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("reply", "choice", "point"),
    [
        ('{"choice": "a", "point": [500, 250]}', "a", [128, 64]),
        ('The {blue} block.\n```json\n{"choice": "(A)", "point": [0, 1000]}\n```', "a", [0, 255]),
        ('First {"choice": "a", "point": [1, 1]}, no: {"choice": "b", "point": null}', "b", None),
        (
            '{"choice": "b.", "point": [5000, "x"]}',
            "b",
            None,
        ),  # a point that is not needed is not read
        ('{"choice": "b"} {not json}', "b", None),
    ],
)
def test_the_last_object_of_a_reply_counts(reply, choice, point):
    assert parse_choice(reply, OPTIONS) == {"choice": choice, "point": point}


@pytest.mark.parametrize(
    ("reply", "reason"),
    [
        ("  ", "empty"),
        ("a", "no JSON object"),
        ("{'choice': 'a'}", "no JSON object"),
        ('{"point": [1, 2]}', 'no "choice"'),
        ('{"choice": 1}', 'no "choice"'),
        ('{"choice": "z"}', "no option 'z'; the options are a, b"),
        ('{"choice": "a"}', 'needs "point"'),
        ('{"choice": "a", "point": [1]}', 'needs "point"'),
        ('{"choice": "a", "point": [1, true]}', "two numbers"),
        ('{"choice": "a", "point": [1, NaN]}', "two numbers"),
        ('{"choice": "a", "point": [1, 1001]}', "within 0 and 1000"),
        ('{"choice": "a", "point": [1, 1' + 400 * "0" + "]}", "within 0 and 1000"),
        ('{"choice": "a", "point": [1, ' + 5000 * "9" + "]}", "no JSON object"),
        ('{"choice": "a", "point": ' + 100_000 * "[" + 100_000 * "]" + "}", "no JSON object"),
    ],
)  # the long ones are more than Python reads
def test_a_reply_that_cannot_be_used_says_why(reply, reason):
    with pytest.raises(MalformedReply, match=reason):
        parse_choice(reply, OPTIONS)


# Models behind an endpoint ------------------------------------------------------------------------


def gemini(*answers, **options):
    client = Client(*[a if isinstance(a, Exception) else response(a) for a in answers])
    return GeminiPlayer(client=client, **options), client


def test_a_conversation_holds_the_frames_since_the_last_decision():
    player, client = gemini(says("blue"), '{"choice": "b"}', says("red"))
    session = play(a_session(), player)
    assert session.status == "success"
    first, second, third = map(turns, client.requests)
    assert kinds(first[0]) == [f"video of {VIDEO}", *["image"] * 4, "image", "text"]
    assert "a: press the block [point]\nb: wait\n" in first[0]["content"][-1]["text"]
    roles = [message["role"] for message in third]
    assert roles == ["user", "assistant", "user", "assistant", "user"]
    assert kinds(second[-1]) == [f"video of {MOTION}", *["image"] * 4, "image", "text"]
    assert second[-1]["content"][-1]["text"].startswith(
        "You chose a: press the block at [703, 742]; the video shows it"
    )
    assert kinds(third[-1]) == ["image", "text"]
    assert "nothing moved" in third[-1]["content"][-1]["text"]
    usage = player.notes()["usage"]
    assert (usage["calls"], usage["input_tokens"], usage["output_tokens"], usage["problems"]) == (
        3,
        3000,
        300,
        {},
    )


def test_an_unusable_reply_is_counted_and_requested_again_with_the_reason():
    player, client = gemini("no idea", says("blue"), '{"choice": "z"}', says("red"))
    session = play(a_session(), player)
    assert session.status == "success"
    assert (
        "could not be used: the answer holds no JSON object"
        in turns(client.requests[1])[-1]["content"][0]["text"]
    )
    assert player.notes()["usage"]["problems"] == {"malformed": 2}
    assert session.decisions[0].note == {"answers": ["no idea", says("blue")]}
    player.start(a_session())
    assert player.notes()["usage"]["problems"] == {}  # of the next episode


def test_a_model_that_never_answers_well_fails_and_a_broken_network_is_an_error():
    player, _ = gemini("x", "y", tries=2)
    session = play(a_session(), player)
    assert (session.status, session.ended_by) == (
        "fail",
        "2 replies in a row could not be used; the last one: 'y'",
    )
    player, _ = gemini(ConnectionError("gone"))
    session = play(a_session(), player)
    assert (session.status, session.record("gemini").error) == (
        "error",
        "no answer (failed): ConnectionError: gone",
    )


def test_an_empty_answer_is_requested_again_with_the_same_question():
    player, client = gemini("", says("blue"), '{"choice": "b"}', says("red"))
    session = play(a_session(), player)
    assert (session.status, player.notes()["usage"]["problems"]) == ("success", {"empty": 1})
    assert turns(client.requests[0]) == turns(client.requests[1])
    player, client = gemini("", "", "")
    session = play(a_session(), player)
    assert (session.status, player.notes()["usage"]["problems"]) == ("fail", {"empty": 3})
    assert len(client.requests) == 3


# Qwen3-VL -----------------------------------------------------------------------------------------


class Scripted:
    """Answers these in turn instead of generating, and keeps the questions; its processor only
    holds its limits.
    """

    def __init__(self, *answers):
        self.answers, self.queries = list(answers), []
        self.processor = SimpleNamespace(video_processor=SimpleNamespace(size=None))

    def generate(self, questions, max_new_tokens):
        self.queries += questions
        return [Reply(self.answers.pop(0), 10, 3)]


def test_every_question_tells_the_full_episode():
    vlm = Scripted(says("blue"), '{"choice": "b"}', "?", says("red"))
    player = QwenPlayer(vlm=vlm, clip_frames=4)
    assert play(a_session(), player).status == "success"
    first, _, third, again = vlm.queries
    assert first.user.startswith(
        "The task: press the blocks in the order of the video\nThe video that comes before you"
    )
    assert (len(first.videos), len(first.images)) == (1, 1)
    assert (first.videos[0].length, len(first.videos[0].frames)) == (VIDEO, 4)
    assert (
        "You chose a: press the block at [703, 742]: <video>\nYou chose b: wait: nothing moved.\n"
        in third.user
    )
    assert [video.length for video in third.videos] == [VIDEO, MOTION]
    assert "could not be used" not in third.user
    assert "could not be used: the answer holds no JSON object" in again.user
    usage = player.notes()["usage"]
    assert (usage["calls"], usage["input_tokens"], usage["output_tokens"]) == (4, 40, 12)


def test_a_tiny_qwen_plays_and_its_nonsense_is_survived():
    pytest.importorskip("transformers", reason="needs the extra vlm: uv sync --inexact --extra vlm")
    player = build_player(
        {
            "name": "qwenvl",
            "model": "tiny",
            "tries": 2,
            "max_new_tokens": 8,
            "clip_frames": 4,
            "device": "cpu",
            "dtype": "float32",
        }
    )
    session = play(a_session(), player)
    usage = player.notes()["usage"]
    assert (session.status, session.record(player.model).model) == ("fail", "tiny")
    assert usage["calls"] == usage["problems"]["malformed"] + usage["problems"].get("empty", 0) == 2
    # Two video frames make a token grid of 8×8; four frames and the image are read whole, nothing
    # is shrunk.
    assert usage["input_tokens"] > 2 * (2 * 64 + 64)
    frames = np.zeros((16, 256, 256, 3), np.uint8)
    grid = QwenPlayer(vlm=player.vlm, clip_frames=16).vlm.processor.video_processor(
        [frames], do_sample_frames=False, return_tensors="pt"
    )["video_grid_thw"]
    assert grid.tolist() == [[8, 16, 16]]


def test_options_of_players_are_checked():
    with pytest.raises(UserError, match=r"Unknown player 'gemni'.*gemini"):
        build_player({"name": "gemni"})
    with pytest.raises(UserError, match="does not take these options"):
        build_player({"name": "random", "sed": 1})
    with pytest.raises(UserError, match="clip_frames=3 must be even"):
        QwenPlayer(vlm=Scripted(), clip_frames=3)
    with pytest.raises(UserError, match="tries=0"):
        gemini(tries=0)


# The oracle ---------------------------------------------------------------------------------------


def test_the_oracle_is_this_librarys_or_the_environments_own(monkeypatch):
    session = a_session()
    session.start()
    with pytest.raises(UserError, match=r"Give it a method oracle\(\).*or use env=mme_vla"):
        OraclePlayer().choose(session)
    monkeypatch.setattr(session.env, "oracle", lambda: {"choice": "b"})
    assert OraclePlayer().choose(session) == ({"choice": "b"}, {})


def test_the_oracle_solves_episodes_without_rendering(tmp_path, capsys):
    pytest.importorskip(
        "mani_skill", reason="the simulator is not installed: uv sync --inexact --extra sim"
    )
    words = [
        "task=[VideoUnmask,VideoUnmaskSwap]",
        "episodes=[0]",
        "player=oracle",
        f"output={tmp_path / 'run'}",
    ]
    main(compose("play", words))
    first, second = read_records(tmp_path / "run" / "episodes.jsonl")
    assert (first.outcome, second.outcome) == ("success", "success")
    assert [d["choice"] for d in second.extra["decisions"]] == ["a", "b", "a"]
    assert (
        first.extra["decisions"][0]["note"]["subtask"]
        == "pick up the container that hides the green cube"
    )
    assert json.loads((tmp_path / "run" / "run.json").read_text())["settings"]["player"] == {
        "name": "oracle"
    }
    assert "Human (paper)" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["task=VideoUnmsk"], "VideoUnmask"),
        (["task=VideoUnmask", "episodes=77"], "first 77; VideoUnmask in 'test' has 50"),
        (["task=VideoUnmask", "player=gemni"], "gemini"),
        (["task=VideoUnmask", "player=random", "max_choices=0"], "max_choices=0"),
    ],
)
def test_what_cannot_work_is_reported_before_anything_begins(words, message, tmp_path):
    with pytest.raises(UserError, match=message):
        main(compose("play", [*words, f"output={tmp_path / 'run'}"]))
    assert not (tmp_path / "run").exists()
