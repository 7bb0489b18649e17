"""Subgoals in words: prompts as in the paper, replies of every kind, histories and keyframes."""

import json
import re

import pytest

from mme_vla.subgoal.answers import SubgoalHistory, hold_until, merge_keyframes, recent_frames
from mme_vla.subgoal.text import (
    MEMER_SYSTEM,
    MalformedReply,
    mark_points,
    memer_reply,
    memer_user,
    numbered,
    parse_gemini,
    parse_memer,
    parse_subgoal,
    pixels_of_pairs,
    says_done,
    split_media,
    subgoal_system,
    subgoal_user,
    to_pixels,
    to_thousandths,
    write_boxes,
)


@pytest.fixture(scope="module")
def golden(parity):
    return json.loads((parity / "pipeline_text.json").read_text())


@pytest.fixture(scope="module")
def figures(shared):
    """The messages of the paper's three example prompts."""
    source = (shared / "paper" / "robomme_paper.tex").read_text()
    listings = re.findall(
        r"Example Prompt for [^\n]*\n.*?\\begin\{lstlisting\}.*?\n(.*?)\\end\{lstlisting\}",
        source,
        re.S,
    )
    rows = []
    for text in listings[:3]:
        without_trailing_commas = re.sub(r",(\s*[\]}])", r"\1", text)
        rows.append(
            [message["content"] for message in json.loads(without_trailing_commas)["messages"]]
        )
    return dict(zip(("simple", "grounded", "memer"), rows, strict=True))


@pytest.mark.parametrize("kind", ["simple", "grounded"])
def test_prompts_are_the_papers(figures, kind):
    system, user, _ = figures[kind]
    goal = re.search(r"The task goal is: (.*)\n", user)[1]
    past = re.search(r"subgoals are: (.*)\n", user)[1]
    history = [re.sub(r"^\d+\. ", "", entry) for entry in past.split("; ")]
    assert numbered(history) == past
    assert subgoal_system(kind) == system
    assert subgoal_user(kind, goal, history, video=True) == user


def test_memer_prompts_are_the_papers(figures):
    system, user, reply = figures["memer"]
    goal = re.search(r"The task goal is: (.*)\n", user)[1]
    assert system == MEMER_SYSTEM
    assert memer_user(goal, 4, 8, video=True) == user
    assert memer_reply("pick up the correct cube at <bbox> for the third time", [4]) == reply


def test_a_first_message_has_no_history_and_no_video_mark():
    text = subgoal_user("simple", "press the button", [], video=False)
    assert text.startswith(
        "The task goal is: press the button\nThis is the initial turn for prediction\n<image>"
    )
    assert split_media(text)[1] == "<image>"


def test_answers_are_read_as_released(golden):
    for case in golden["qwen_response_parsing_image_256"]:
        parsed = parse_subgoal(case["response"])
        assert parsed.text == case["for_policy"]
        assert [parsed.entry, [list(p) for p in parsed.points]] == case["history_entry"]


def test_histories_grow_as_released(golden):
    for case in golden["qwen_histories"]:
        history = SubgoalHistory()
        for response in case["responses"]:
            parsed = parse_subgoal(response)
            history.add(parsed.entry, parsed.points)
        assert history.entries == case["history"]
        assert [list(p) for p in history.points] == case["points"]
        assert numbered(history.entries) == case["history_text"]


def test_keyframes_are_merged_as_released(golden):
    for case in golden["memer_keyframe_merge_distance_8"]:
        assert merge_keyframes(case["in"]) == case["out"]


def test_prompted_answers_are_read_as_released(golden):
    for case in golden["gemini_parsing"]:
        if case["parsed"] is None:
            with pytest.raises(MalformedReply):
                parse_gemini(case["text"])
            continue
        text = parse_gemini(case["text"])
        assert {"subgoal": text} == case["parsed"]
        assert pixels_of_pairs(text).text == case["normalised"]


def test_labels_give_up_their_points_as_released(golden):
    inputs = ["pick at <12, 200>", "press", "from <1, 2> at <3, 4> at <5, 6>"]
    for text, (stripped, points) in zip(
        inputs, golden["training_grounded_preprocess"], strict=True
    ):
        assert mark_points(text) == (stripped, [tuple(p) for p in points])


@pytest.mark.parametrize(
    "answer",
    [
        "",
        "  \n",
        "pick at <|box_start|>(12",
        "at <|box_start|>(1,2,3,4)<|box_end|>",
        "at <|box_start|>(1,1001)<|box_end|>",
    ],
)
def test_a_damaged_reply_is_named_so(answer):
    with pytest.raises(MalformedReply):
        parse_subgoal(answer)


def test_memer_answers():
    box = "<|box_start|>(500,250)<|box_end|>"
    reply = (
        f'```json\n{{"current_subtask": "pick at {box}", "keyframe_positions": [9, 3, 3, 0]}}```'
    )
    parsed, positions = parse_memer(reply, 8)
    assert (parsed.text, parsed.points, positions) == ("pick at <128, 64>", ((128, 64),), [3])
    for reply in (
        "no",
        "{",
        '{"keyframe_positions": []}',
        '{"current_subtask": "x", "keyframe_positions": "2"}',
        "[1]",
    ):
        with pytest.raises(MalformedReply):
            parse_memer(reply, 8)


def test_a_prompted_reply_may_carry_what_it_likes_around_it():
    assert parse_gemini(
        'Sure!\n{"subgoal_sequence": ["a", "b"],\n "subgoal": "press the button"}\nGood luck'
    ) == ("press the button")
    assert parse_gemini('{"subgoal":\n "press"}') == "press"
    assert pixels_of_pairs("move to <-5, 2000>").points == ((0, 256),)
    assert says_done("The task is complete.") and not says_done("complete the row")


def test_coordinates_go_there_and_back():
    assert [to_pixels(v) for v in (0, 999, 1000)] == [0, 255, 256]
    assert all(abs(to_pixels(to_thousandths(p)) - p) <= 1 for p in range(257))
    assert write_boxes("a <bbox> b <bbox>", [(128, 64), (0, 256)]) == (
        "a <|box_start|>(500,250)<|box_end|> b <|box_start|>(0,1000)<|box_end|>"
    )
    with pytest.raises(ValueError, match="1 <bbox> marks for 0 points"):
        write_boxes("a <bbox>", [])


def test_holding_rules_of_the_three_tasks():
    assert [
        hold_until(t, None)
        for t in ("ButtonUnmask", "PickHighlight", "ButtonUnmaskSwap", "BinFill")
    ] == [
        90,
        90,
        0,
        0,
    ]
    assert hold_until("ButtonUnmaskSwap", "Press the first button at <1, 2>") == 100
    assert hold_until("ButtonUnmaskSwap", "press the second button") == 250
    assert hold_until("ButtonUnmaskSwap", "pick up the container") == 0


def test_recent_frames_count_back_from_the_newest():
    assert recent_frames(0, queried_before=False) == [0]
    assert recent_frames(16, queried_before=True) == [2, 4, 6, 8, 10, 12, 14, 16]
    assert recent_frames(5, queried_before=True) == [1, 3, 5]


DIGITS = "9" * 5000  # more than Python turns into a number


@pytest.mark.parametrize(
    "read",
    [
        lambda: parse_subgoal(f"pick at <|box_start|>({DIGITS},1)<|box_end|>"),
        lambda: parse_memer(f'{{"current_subtask": "a", "keyframe_positions": [{DIGITS}]}}', 8),
        lambda: parse_memer('{"current_subtask": ' + "[" * 200_000 + "]" * 200_000 + "}", 8),
        lambda: parse_memer(r'{"current_subtask": "a \ud800"}', 8),
        lambda: parse_gemini(f'{{"subgoal" : {DIGITS}}}'),
        lambda: parse_gemini('{"subgoal": ' + "[" * 200_000 + "]" * 200_000 + "}"),
        lambda: pixels_of_pairs(f"move to <{DIGITS}, 3>"),
    ],
    ids=["box", "position", "deep", "half a character", "number", "deep gemini", "pair"],
)
def test_answers_that_python_itself_cannot_read_are_malformed(read):
    with pytest.raises(MalformedReply):
        read()


def test_numbers_too_long_for_a_point_are_no_point():
    text = f"pick at <{DIGITS}, 1>"
    assert mark_points(text) == (text, [])


def test_escapes_of_json_in_a_reply_are_decoded():
    reply = '{"subgoal": "pick up the \\"red\\" cube at \\u003c500, 250\\u003e"}'
    assert parse_gemini(reply) == 'pick up the "red" cube at <500, 250>'
    assert pixels_of_pairs(parse_gemini(reply)).points == ((128, 64),)
    assert parse_gemini(r'{"subgoal": "press \d"}') == r"press \d"


@pytest.mark.parametrize("mark", ["<bbox>", "<image>", "<video>"])
def test_a_reply_that_holds_a_mark_of_questions_is_malformed(mark):
    with pytest.raises(MalformedReply, match="mark of questions"):
        parse_subgoal(f"pick up the cube at {mark}")
