"""Fine-tuning: rows become questions and labels, and the whole path from demonstrations to
predictions runs.
"""

import json

import numpy as np
import pytest
import torch

from mme_vla.config.composition import compose
from mme_vla.errors import UserError
from mme_vla.subgoal import build_predictor
from mme_vla.subgoal.clips import read_image
from mme_vla.subgoal.finetuning.collecting import build, open_input
from mme_vla.subgoal.finetuning.rows import (
    IGNORED,
    Collator,
    RowDataset,
    RowOptions,
    TrainingRow,
    hf_dataset,
    question_of,
    read_rows,
    texts_of,
)
from mme_vla.subgoal.finetuning.training import accumulation, find_checkpoint, fine_tune
from mme_vla.subgoal.models.qwen3vl import VLM
from mme_vla.subgoal.text import BBOX

pytest.importorskip("peft", reason="needs the extra vlm")
SETS = ["simple", "grounded", "memer"]


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    folder = tmp_path_factory.mktemp("subgoal") / "data"
    build([e for e in open_input("sample") if e.number == 6], folder, SETS, RowOptions())
    return folder


@pytest.fixture(scope="module")
def tiny():
    return VLM.load("tiny", device="cpu")


def settings(data, output, **words):
    options = {
        "rows": data / "grounded.jsonl",
        "output": output,
        "vlm": "tiny",
        "steps": 14,
        "batch": 2,
        "lr": 1e-2,
        "per_device_batch": 1,
        "workers": 0,
        "log_every": 1,
        "save_every": 7,
        "report_to": "null",
        "device": "cpu",
        "gradient_checkpointing": "false",
        **words,
    }
    return compose("subgoal_train", [f"{key}={value}" for key, value in options.items()])


def losses(output):
    state = json.loads((output / "checkpoint-14" / "trainer_state.json").read_text())
    return [entry["loss"] for entry in state["log_history"] if "loss" in entry]


def test_points_of_a_row_go_to_the_question_first_and_to_the_reply_then():
    messages = [
        {"role": "system", "content": "s"},
        {"role": "user", "content": "1. at <bbox>"},
        {"role": "assistant", "content": "at <bbox>"},
    ]
    objects = {"ref": [], "bbox": [[128, 64], [0, 255]]}
    row = TrainingRow(messages=messages, objects=objects)
    expected = (
        "s",
        "1. at <|box_start|>(500,250)<|box_end|>",
        "at <|box_start|>(0,996)<|box_end|>",
    )
    assert texts_of(row) == expected


@pytest.mark.parametrize("name", SETS)
def test_only_the_reply_is_learnt(name, data, tiny):
    collate = Collator(tiny)
    rows = read_rows(data / f"{name}.jsonl")
    questions = [question_of(rows[i], data) for i in (0, len(rows) - 1)]
    batch = collate(questions)
    for question, labels in zip(questions, batch["labels"], strict=True):
        learnt = tiny.processor.tokenizer.decode(labels[labels != IGNORED])
        assert learnt == question.target + "<|im_end|>"
    with torch.no_grad():
        assert tiny.model(**batch).loss.isfinite()


def test_training_and_prediction_ask_in_the_same_words(data, tiny):
    row = read_rows(data / "grounded.jsonl")[0]
    question = question_of(row, data)
    predictor = build_predictor({"name": "qwenvl", "vlm": tiny})
    goal = row.messages[1].content.split("goal is: ")[1].split("\n")[0]
    video = np.zeros((question.videos[0].length, *question.images[0].shape), np.uint8)
    episode = predictor.start_episode(goal, video)
    episode.observe(question.images[0][None])
    query = predictor.question(episode)
    assert (query.system, query.user) == (question.system, question.user)
    prompt, learnt = tiny.encode([query])["input_ids"][0], Collator(tiny)([question])
    start = int((learnt["labels"][0] != IGNORED).nonzero()[0])
    assert prompt.tolist() == learnt["input_ids"][0][:start].tolist()


def test_rows_that_are_too_long_are_left_out(data, tiny):
    tokenizer, file = tiny.processor.tokenizer, data / "memer.jsonl"
    lengths = [
        len(tiny.encode([question_of(row, data)])["input_ids"][0]) for row in read_rows(file)
    ]
    everything = RowDataset(file, tokenizer)
    assert len(everything) == len(lengths) and everything.left_out == 0
    limit = int(np.median(lengths))
    rows = RowDataset(file, tokenizer, limit)
    assert 0 < len(rows) <= sum(n <= limit for n in lengths) and rows.left_out > 0
    with pytest.raises(UserError, match="max_length=10"):
        RowDataset(file, tokenizer, 10)


def test_rows_are_a_hugging_face_dataset(data):
    dataset, rows = hf_dataset(data / "memer.jsonl"), read_rows(data / "memer.jsonl")
    assert len(dataset) == len(rows)
    one = dataset[len(rows) - 1]
    parts = one["messages"][1]["content"]
    assert [m["role"] for m in one["messages"]] == ["system", "user", "assistant"]
    assert sum(p["type"] == "image" for p in parts) == len(one["images"]) == len(rows[-1].images)
    assert sum(p["type"] == "video" for p in parts) == len(one["videos"]) == 1
    assert np.array_equal(
        np.asarray(one["images"][0].convert("RGB")), read_image(data / rows[-1].images[0])
    )


def test_damaged_rows_and_missing_images_are_named(tmp_path, data):
    (tmp_path / "rows.jsonl").write_text('{"messages": []}\n')
    with pytest.raises(UserError, match="line 1"):
        read_rows(tmp_path / "rows.jsonl")
    with pytest.raises(UserError, match="mme-vla subgoal-build"):
        read_rows(tmp_path / "nothing.jsonl")
    with pytest.raises(UserError, match="is missing; expected an image"):
        question_of(read_rows(data / "simple.jsonl")[0], tmp_path)


@pytest.mark.parametrize(
    ("messages", "words"),
    [
        (3, "messages=3 must be a list"),
        ([1, 2, 3], r"messages\[0\]=1 must be a section of keys"),
        ([{"role": "robot", "content": "a"}], r"messages\[0\]\.role='robot'\. .*assistant"),
        ([{"role": "user", "content": "\ud800"}], r"half a character in messages\[0\]\.content"),
        ([{"role": "user", "content": BBOX}], "one message each of system, user and assistant"),
        (
            [{"role": role, "content": BBOX} for role in ("system", "user", "assistant")],
            "has 2 marks <bbox> for 0 points",
        ),
    ],
)
def test_messages_that_are_no_conversation_are_named(messages, words, tmp_path):
    (tmp_path / "rows.jsonl").write_text(json.dumps({"messages": messages}) + "\n")
    with pytest.raises(UserError, match=words):
        read_rows(tmp_path / "rows.jsonl")


@pytest.mark.slow
def test_the_full_path_learns_resumes_and_predicts(data, tmp_path):
    straight = fine_tune(settings(data, tmp_path / "straight"))
    values = losses(tmp_path / "straight")
    assert np.mean(values[-5:]) < 0.5 * values[0], values
    with pytest.raises(UserError, match="resume=auto"):
        fine_tune(settings(data, tmp_path / "straight"))

    halved = tmp_path / "halved"
    assert find_checkpoint(halved, "auto") is None
    (tmp_path / "straight" / "checkpoint-7").rename(tmp_path / "checkpoint-7")
    halved.mkdir()
    (tmp_path / "checkpoint-7").rename(halved / "checkpoint-7")
    fine_tune(settings(data, halved, resume="auto"))
    assert losses(halved) == pytest.approx(values, rel=1e-4), (
        "the resumed run ends as the straight one"
    )

    subgoals = {}
    for adapter in (None, str(straight)):
        options = {
            "name": "qwenvl",
            "model": "tiny",
            "device": "cpu",
            "max_new_tokens": 24,
            "adapter": adapter,
        }
        predictor = build_predictor(options)
        row = question_of(read_rows(data / "grounded.jsonl")[0], data)
        episode = predictor.start_episode("goal", row.videos[0].frames)
        episode.observe(row.images[0][None])
        subgoals[adapter] = predictor.predict([episode])[0]
    assert subgoals[str(straight)].reply != subgoals[None].reply
    assert (
        "pick up" in subgoals[str(straight)].reply or "container" in subgoals[str(straight)].reply
    )


def test_the_effective_batch_is_what_was_requested():
    assert (
        accumulation(64, 4, 4) == 4 and accumulation(48, 4, 4) == 3 and accumulation(64, 4, 1) == 16
    )
    with pytest.raises(UserError, match="no positive multiple"):
        accumulation(64, 4, 3)
    recipe = compose("subgoal_train", ["rows=x"])
    assert (
        recipe.lora.rank,
        recipe.lora.alpha,
        recipe.lr,
        recipe.batch,
        recipe.epochs,
        recipe.warmup,
    ) == (
        16,
        32,
        1e-4,
        64,
        2,
        0.05,
    )


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ({"per_device_batch": 0}, "no positive multiple of per_device_batch=0"),
        ({"batch": 0}, "batch=0 is no positive multiple"),
        ({"steps": -3}, "steps=-3 1 or more"),
        ({"steps": "null", "epochs": 0}, "epochs=0 must be above 0"),
        ({"lora.rank": 0}, "settings of the training do not work.* 0"),
        ({"lora.dropout": 2}, "settings of the training do not work.* 2"),
        ({"report_to": "tensorbord"}, "tensorbord is not supported"),
    ],
)
def test_settings_of_a_training_that_cannot_work_are_named(data, tmp_path, words, message):
    with pytest.raises(UserError, match=message):
        fine_tune(settings(data, tmp_path / "run", **words))


@pytest.mark.parametrize(
    ("rows", "use"),
    [
        ("memer", "subgoal=memer subgoal.kind=grounded"),
        ("simple", "subgoal=qwenvl subgoal.kind=simple"),
    ],
)
def test_the_end_of_a_training_names_the_predictor_of_its_rows(data, tmp_path, capsys, rows, use):
    output = tmp_path / "run"
    fine_tune(settings(data, output, rows=data / f"{rows}.jsonl", steps=1))
    assert f"{use} subgoal.adapter={output / 'adapter'}" in capsys.readouterr().out
