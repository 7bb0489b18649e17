"""Predictors with a model of their own: what they ask, what they make of any answer, and a tiny
Qwen3-VL.
"""

import logging
from functools import partial

import numpy as np
import pytest
from safetensors.torch import load_file, save_file

from helpers import subgoal_fakes
from mme_vla.errors import UserError
from mme_vla.registry import SUBGOALS
from mme_vla.subgoal import Memer, Oracle, QwenVL, build_predictor
from mme_vla.subgoal.clips import Clip
from mme_vla.subgoal.models.qwen3vl import VLM, Question
from mme_vla.subgoal.models.replies import Reply
from mme_vla.subgoal.models.tiny import make_tiny

pytest.importorskip("transformers", reason="needs the extra vlm")


class Scripted:
    """A fake `VLM`: returns these answers in turn and keeps the questions, batch by batch."""

    def __init__(self, *answers):
        self.answers, self.batches = list(answers), []

    def generate(self, questions, max_new_tokens):
        self.batches.append(list(questions))
        return [Reply(self.answers.pop(0), 100, 7) for _ in questions]


frames = partial(subgoal_fakes.frames, size=256)


def at_start(predictor, goal="Sort the Cubes", task="", video=0):
    episode = predictor.start_episode(goal, frames(video) if video else None, task)
    episode.observe(frames(1))
    return episode


def advance(episode, count=16):
    episode.observe(frames(count, episode.n_observed_frames))


@pytest.fixture(scope="module")
def tiny():
    return VLM.load("tiny", device="cpu")


def test_all_are_registered_and_built_by_name():
    assert set(SUBGOALS) == {"oracle", "qwenvl", "gemini", "memer", "openai", "notebook"}
    assert isinstance(build_predictor({"name": "oracle", "kind": "simple"}), Oracle)
    assert build_predictor({"name": "none"}) is build_predictor(None) is None
    with pytest.raises(UserError, match="'qwenvl'"):
        build_predictor({"name": "qwenlv"})
    with pytest.raises(UserError, match="speed"):
        build_predictor({"name": "oracle", "speed": 1})
    with pytest.raises(UserError, match=r"subgoal\.kind"):
        build_predictor({"name": "oracle", "kind": "ground"})


def test_the_oracle_says_what_the_environment_reports_and_keeps_it_at_the_end():
    oracle = Oracle("grounded")
    episode = oracle.start_episode("goal")
    episode.observe(frames(1), {"grounded_subgoal_online": "Pick up at <12, 200>"})
    (subgoal,) = oracle.predict([episode])
    assert (subgoal.text, subgoal.points) == ("pick up at <12, 200>", ((12, 200),))
    episode.observe(frames(16), {"grounded_subgoal_online": "Complete"})
    assert oracle.predict([episode])[0].text == "pick up at <12, 200>"
    episode.observe(frames(1), {})
    with pytest.raises(UserError, match="grounded_subgoal_online"):
        oracle.predict([episode])


def test_questions_carry_goal_history_points_image_and_video():
    vlm = Scripted("pick at <|box_start|>(390,706)<|box_end|>", "put it down")
    predictor = QwenVL("grounded", vlm=vlm)
    episode = at_start(predictor, video=40)
    assert predictor.predict([episode])[0].text == "pick at <99, 180>"
    advance(episode)
    assert predictor.predict([episode])[0].text == "put it down"
    first, second = (batch[0] for batch in vlm.batches)
    assert "The task goal is: sort the cubes\nThis is the initial turn" in first.user
    assert (
        first.videos[0].length == 40
        and (first.images[0] == 0).all()
        and (second.images[0] == 16).all()
    )
    assert "are: 1. pick at <|box_start|>(387,703)<|box_end|>\n<image>" in second.user
    assert "grounded language subgoals" in second.system


def test_many_episodes_are_queried_in_one_batch_and_only_those_that_are_due():
    vlm = Scripted("press the button", "pick it up", "put it down")
    predictor = QwenVL("simple", vlm=vlm)
    waiting, other = at_start(predictor, task="ButtonUnmask"), at_start(predictor)
    assert [s.text for s in predictor.predict([waiting, other])] == [
        "press the button",
        "pick it up",
    ]
    advance(waiting)
    advance(other)
    unchanged, new = predictor.predict([waiting, other])
    assert (unchanged.text, unchanged.queried, new.text, new.queried) == (
        "press the button",
        False,
        "put it down",
        True,
    )
    assert [len(batch) for batch in vlm.batches] == [2, 1]
    assert (
        predictor.usage.calls == 3
        and predictor.usage.input_tokens == 300
        and predictor.usage.output_tokens == 21
    )


@pytest.mark.parametrize(
    ("reply_text", "problem"), [("", "empty"), ("pick <|box_start|>(1", "malformed")]
)
def test_an_unusable_reply_keeps_the_last_subgoal_and_is_counted(reply_text, problem, caplog):
    predictor = QwenVL("grounded", vlm=Scripted(reply_text, "press", reply_text))
    episode = at_start(predictor)
    assert predictor.predict([episode])[0].text is None, "there is none to keep"
    advance(episode)
    predictor.predict([episode])
    advance(episode)
    with caplog.at_level(logging.WARNING):
        subgoal = predictor.predict([episode])[0]
    assert (subgoal.text, subgoal.problem, subgoal.reply) == ("press", problem, reply_text)
    assert predictor.usage.problems == {problem: 2} and problem in caplog.text
    assert episode.history.entries == ["press"]


def test_memer_shows_recent_frames_and_the_keyframes_it_chose():
    answers = (
        '{"current_subtask": "pick", "keyframe_positions": [1]}',
        (
            '{"current_subtask":"pick at <|box_start|>(500,500)<|box_end|>", "keyframe_positions":'
            " [4]}"
        ),
        "no idea",
        '{"current_subtask": "put", "keyframe_positions": [1, 8]}',
        '{"current_subtask": "put", "keyframe_positions": []}',
    )
    vlm = Scripted(*answers)
    predictor = Memer("grounded", vlm=vlm)
    episode = at_start(predictor, video=30)
    subgoals, frames = [], []
    for _ in answers:
        subgoals.append(predictor.predict([episode])[0])
        frames.append([int(image[0, 0, 0]) for image in vlm.batches[-1][0].images])
        advance(episode)
    assert frames == [
        [0],
        [0, *range(2, 17, 2)],
        [8, *range(18, 33, 2)],
        [8, *range(34, 49, 2)],
        [8, 34, 48, *range(50, 65, 2)],
    ], "0 and 8 are so near that only the later of the two stays"
    assert [s.text for s in subgoals] == [
        "pick",
        "pick at <128, 128>",
        "pick at <128, 128>",
        "put",
        "put",
    ]
    assert [s.problem for s in subgoals] == ["", "", "malformed", "", ""]
    assert (
        vlm.batches[1][0].user.count("<image>") == 9 and "setup: <video>" in vlm.batches[1][0].user
    )


def test_an_episode_without_a_frame_is_refused():
    for predictor in (QwenVL(vlm=Scripted()), Memer(vlm=Scripted())):
        with pytest.raises(UserError, match="call observe"):
            predictor.predict([predictor.start_episode("goal")])
        with pytest.raises(UserError, match="uint8"):
            predictor.start_episode("goal").observe(np.zeros((1, 8, 8, 3)))


def test_a_tiny_model_reads_conversations_in_qwens_format(tiny):
    question = Question(
        "be brief",
        "<video>go\n<image>at <|box_start|>(1,2)<|box_end|>",
        [frames(1)[0]],
        [Clip.of(frames(66))],
    )
    batch = tiny.encode([question])
    text = tiny.processor.tokenizer.decode(batch["input_ids"][0])
    assert text.startswith("<|im_start|>system\nbe brief<|im_end|>\n<|im_start|>user\n<")
    assert text.endswith("at <|box_start|>(1,2)<|box_end|><|im_end|>\n<|im_start|>assistant\n")
    assert text.count("<|image_pad|>") == 64, "256×256 pixels, 32 a token"
    assert text.count("<|video_pad|>") == 2 * 64 and text.count(" seconds>") == 2, (
        "four frames, two by two"
    )
    long = tiny.encode([Question("s", "<video>", videos=[Clip.of(frames(600))])])
    assert tiny.processor.tokenizer.decode(long["input_ids"][0]).count("<|video_pad|>") == 5 * 64
    large = tiny.encode([Question("s", "<image>", [frames(1, size=1024)[0]])])
    assert tiny.processor.tokenizer.decode(large["input_ids"][0]).count("<|image_pad|>") <= 256


def test_replies_do_not_depend_on_what_is_queried_beside(tiny):
    questions = [
        Question("s", "<image>" + "pick up the red cube " * n, [frames(1, 9 * n)[0]])
        for n in (1, 7, 3)
    ]
    together = tiny.generate(questions, 12)
    assert together == [tiny.generate([question], 12)[0] for question in questions]
    assert all(reply.output_tokens <= 12 for reply in together)


@pytest.mark.parametrize("name", ["qwenvl", "memer"])
def test_a_tiny_model_predicts_for_several_episodes(name, tiny):
    predictor = build_predictor({"name": name, "vlm": tiny, "max_new_tokens": 8})
    episodes = [at_start(predictor, video=20), at_start(predictor)]
    for _ in range(2):
        subgoals = predictor.predict(episodes)
        assert len(subgoals) == 2 and all(s.queried for s in subgoals)
        [advance(episode) for episode in episodes]
    assert predictor.usage.calls == 4 and predictor.usage.input_tokens > 4 * 64


def test_a_model_loads_from_a_folder_and_a_missing_one_is_named(tiny, tmp_path):
    for part in make_tiny():
        part.save_pretrained(tmp_path / "model")
    loaded = VLM.load(str(tmp_path / "model"), device="cpu", dtype="float32")
    question = Question("s", "<image>next?", [frames(1)[0]])
    assert loaded.generate([question], 8) == tiny.generate([question], 8)
    with pytest.raises(UserError, match="No Qwen3-VL model"):
        VLM.load(str(tmp_path / "nothing"), device="cpu")
    with pytest.raises(UserError, match="no LoRA adapter"):
        VLM.load("tiny", str(tmp_path), device="cpu")


def test_every_key_of_the_yaml_files_is_an_option_and_every_option_a_key():
    import inspect

    from omegaconf import OmegaConf

    from mme_vla.config.trees import config_dir
    from mme_vla.subgoal.models.api import PROVIDERS
    from mme_vla.subgoal.qwenvl import VLMPredictor

    settings = {name: vars(PROVIDERS[name]) for name in ("openai", "gemini")}
    settings["notebook"] = settings["openai"]
    for name in SUBGOALS:
        keys = dict(OmegaConf.load(config_dir() / "subgoal" / f"{name}.yaml"))
        assert keys.pop("name") == name
        defaults = dict(settings.get(name, {}))
        parents = [VLMPredictor] if name in ("qwenvl", "memer") else []
        for one in (SUBGOALS[name], *parents):
            parameters = inspect.signature(one).parameters.values()
            defaults |= {p.name: p.default for p in parameters if p.kind is not p.VAR_KEYWORD}
        assert {k: v for k, v in defaults.items() if k not in ("vlm", "client")} == keys


def query_steps(predictor, execute, chunks, task=""):
    episode = at_start(predictor, task=task)
    steps = []
    for _ in range(chunks):
        steps += [episode.step] if predictor.predict([episode])[0].queried else []
        advance(episode, execute)
    return steps


@pytest.mark.parametrize(
    ("interval", "execute", "expected"),
    [
        (48, 20, [0, 60, 100, 160]),
        (48, 16, [0, 48, 96, 144]),
        (16, 16, [*range(0, 160, 16)]),
        (1, 16, [*range(0, 160, 16)]),
    ],
)
def test_no_question_is_dropped_whatever_the_length_of_a_chunk(interval, execute, expected):
    predictor = QwenVL("simple", interval=interval, vlm=Scripted(*["a"] * 10))
    assert query_steps(predictor, execute, -(-160 // execute) + (execute == 20)) == expected


def test_what_came_due_while_a_subgoal_was_fixed_is_left_out():
    predictor = QwenVL("simple", interval=48, vlm=Scripted("press", "pick", "put"))
    assert query_steps(predictor, 16, 12, "ButtonUnmask") == [0, 96, 144]
    predictor = QwenVL("simple", interval=32, vlm=Scripted(*["press the first button"] * 3))
    assert query_steps(predictor, 16, 9, "ButtonUnmaskSwap") == [0, 128], (
        "112 would answer what came due at 96"
    )


def test_an_episode_that_is_joined_late_is_queried_at_once():
    predictor = QwenVL("simple", interval=48, vlm=Scripted("a"))
    episode = predictor.start_episode("goal")
    episode.observe(frames(21))
    assert predictor.predict([episode])[0].queried and episode.query_step == 20


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"device": "gpu"}, "device='gpu'"),
        ({"device": "cuda:99"}, "device=cuda:99"),
        ({"dtype": "float8"}, "dtype='float8'"),
        ({"dtype": "nn"}, "dtype='nn'"),
        ({"batch_size": 0}, "batch_size=0"),
        ({"max_new_tokens": 0}, "max_new_tokens=0"),
    ],
)
def test_options_of_a_model_that_cannot_work_are_named(options, named):
    with pytest.raises(UserError, match=named):
        build_predictor({"name": "qwenvl", "model": "tiny", "device": "cpu", **options})


@pytest.mark.parametrize("damage", ["shapes", "names"])
def test_an_adapter_of_another_model_is_refused_and_never_left_out(damage, tmp_path):
    peft = pytest.importorskip("peft", reason="needs the extra vlm")
    model, _ = make_tiny()
    lora = peft.LoraConfig(r=2, target_modules=["q_proj"], task_type="CAUSAL_LM")
    peft.get_peft_model(model, lora).save_pretrained(tmp_path)
    file = tmp_path / "adapter_model.safetensors"
    tensors = {}
    for name, tensor in load_file(file).items():
        if damage == "names":
            name = name.replace("language_model", "text_model")
        tensors[name] = tensor[:, :1].contiguous() if damage == "shapes" else tensor
    save_file(tensors, file)
    with pytest.raises(UserError, match="is no LoRA adapter of 'tiny'"):
        VLM.load("tiny", str(tmp_path), device="cpu")
