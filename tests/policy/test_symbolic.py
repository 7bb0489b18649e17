"""Symbolic memory and past actions: what the prompt says in training and in an episode."""

import json
import re

import numpy as np
import pytest

from mme_vla import UserError, build_policy
from mme_vla.data.dataset import TrainingDataset
from mme_vla.data.episodes import EpisodeSource
from mme_vla.data.recording import Recording
from mme_vla.memory.transforms import map_frames
from mme_vla.processing.prompt import POINT, SubgoalText, perturb_point
from mme_vla.testing.small import moving_frames, small_policy

TEXTS = {
    "simple_subgoal": "put it down",
    "simple_subgoal_online": "pick it up",
    "grounded_subgoal": "pick at <10, 20>",
    "grounded_subgoal_online": "pick at <30, 40>",
}


@pytest.fixture(scope="module")
def source():
    return EpisodeSource("sample")


def words(policy, item) -> str:
    return policy.processor.tokenizer.decode(item["prompt"][item["prompt_mask"]].tolist())


def test_point_noise_has_the_released_range_and_deviation(parity):
    golden = json.loads((parity / "pipeline_text.json").read_text())["grounding_noise"]
    rng = np.random.default_rng(0)
    shifted = [perturb_point("pick at <100, 100>", golden["max"], rng) for _ in range(5000)]
    shifts = np.array([[int(x) - 100 for x in POINT.search(text).groups()] for text in shifted])
    assert shifts.min() == golden["min"] and shifts.max() == golden["maxv"]
    assert shifts.std() == pytest.approx(golden["sample_std"], rel=0.03)
    assert abs(np.corrcoef(shifts.T)[0, 1]) < 0.05, "both numbers move independently"


def test_point_noise_applies_where_the_released_one_does(parity):
    cases = json.loads((parity / "pipeline_text.json").read_text())[
        "grounding_augmentation_applies"
    ]
    rng = np.random.default_rng(1)
    for case in cases:
        changed = any(perturb_point(case["in"], 8, rng) != case["in"] for _ in range(50))
        assert changed is case["changed"], case


def test_half_of_the_texts_are_the_online_ones():
    choose, rng = SubgoalText("simple_subgoal"), np.random.default_rng(0)
    online = [choose(TEXTS, rng) == "pick it up" for _ in range(2000)]
    assert np.mean(online) == pytest.approx(0.5, abs=0.04)
    assert SubgoalText("simple_subgoal", online_probability=0)(TEXTS, rng) == "put it down"


def test_a_dataset_without_the_online_texts_trains_on_the_others(caplog):
    source = EpisodeSource("sample")
    source.subgoal_names = ("simple_subgoal",)
    policy = build_policy("simplesg")
    policy.processor.stats = small_policy("pi05").processor.stats
    choose = SubgoalText.from_config(policy.config["subgoal_text"])
    data = TrainingDataset([source], policy.processor, subgoal=choose)
    assert "has no column simple_subgoal_online" in caplog.text
    prompts = set()
    for epoch in range(8):
        data.set_epoch(epoch)
        prompts.add(words(policy, data[5]))
    assert len(prompts) == 1 and source.subgoals(0, data.step(5).index)[
        "simple_subgoal"
    ] in " ".join(prompts.pop().split())


@pytest.mark.parametrize("model", ["simplesg", "groundsg"])
def test_training_prompts_hold_goal_and_subgoal(model, source):
    policy = build_policy(model)
    policy.processor.stats = small_policy("pi05").processor.stats
    data = TrainingDataset(
        [source], policy.processor, subgoal=SubgoalText.from_config(policy.config["subgoal_text"])
    )
    item = data[5]
    pattern = rf"Task: {re.escape(item['goal'])}; Current Subgoal: .+; Action:"
    assert re.search(pattern, re.sub(r"\s+", " ", words(policy, item)))
    assert ("at <" in words(policy, item)) is (model == "groundsg")
    assert len(item["prompt"]) == 128


def test_a_prompt_that_reads_a_subgoal_needs_its_text(source):
    policy = build_policy("simplesg")
    policy.processor.stats = small_policy("pi05").processor.stats
    with pytest.raises(UserError, match=r"subgoal_text\.kind"):
        TrainingDataset([source], policy.processor)
    with pytest.raises(UserError, match="simple_subgoal"):
        SubgoalText.from_config({"kind": "simple"})


def test_the_subgoal_of_an_episode_changes_its_actions():
    policy, frames = small_policy("simplesg"), moving_frames(1)
    episode = policy.start_episode("sort the cubes", seed=1)
    episode.observe({"front": frames, "wrist": frames}, np.zeros((1, 8)))
    chunks = []
    for subgoal in ("pick up the red cube", "press the button"):
        episode.subgoal = subgoal
        assert subgoal in policy.processor.tokenizer.decode(
            episode.prompt[0][episode.prompt[1]].tolist()
        )
        again = policy.start_episode("sort the cubes", seed=1)
        again.observe({"front": frames, "wrist": frames}, np.zeros((1, 8)))
        again.subgoal = subgoal
        chunks.append(policy.act([again]))
    assert not np.allclose(*chunks)


def test_past_actions_of_training_are_the_ones_right_before_the_chunk(source):
    policy = build_policy("pi05_past_actions")
    policy.processor.stats = small_policy("pi05").processor.stats
    data = TrainingDataset([source], policy.processor)
    start = int(source.exec_starts[0])

    def past(data: TrainingDataset, index: int) -> np.ndarray:
        step = data.step(index)
        return data.past_actions(step, map_frames((), step.index + 1, step.exec_start))

    assert past(data, 0).shape == (0, 8), "the video's actions are not the robot's own"
    assert np.array_equal(past(data, 3), source.actions(0, start, start + 3))
    assert np.array_equal(past(data, 40), source.actions(0, start + 24, start + 40))
    later = TrainingDataset([source], policy.processor, action_offset=1)
    assert past(later, 0).shape == (0, 8), "no action comes before the first frame of the execution"
    assert np.array_equal(past(later, 3), source.actions(0, start + 1, start + 4))
    assert int(data[40]["prompt_mask"].sum()) < 640, "all 128 numbers fit"
    assert len(re.findall(r"\d+", words(policy, data[40]).split("Past actions:")[1])) == 128


@pytest.mark.parametrize("offset", [0, 1])
def test_a_recording_shows_the_past_actions_that_training_reads(source, offset):
    policy = small_policy("pi05_past_actions")
    data = TrainingDataset([source], policy.processor, action_offset=offset)
    recording = Recording(source, 0, offset)
    start = recording.exec_start
    no_frames = np.zeros(0, np.int64)
    for index in (0, 1, 20):
        identity = map_frames((), start + index + 1, start)
        expected = data.past_actions(data.step(index), identity)
        at_once, stepwise = (policy.start_episode("press the button") for _ in range(2))
        recording.show(at_once, 0, start + index + 1, no_frames)
        for first, stop in ((0, start - 3), (start - 3, start + 1), (start + 1, start + index + 1)):
            recording.show(stepwise, first, stop, no_frames)
        for episode in (at_once, stepwise):
            assert episode.n_observed_frames == start + index + 1
            assert np.array_equal(episode._executed, expected), index


def test_an_episode_knows_its_executed_actions_by_the_frames_that_follow():
    policy, frames = small_policy("pi05_past_actions"), moving_frames(40)

    def observe(episode, count, **options):
        view = {"front": frames[:count], "wrist": frames[:count]}
        episode.observe(view, np.zeros((count, 8)), **options)

    episode = policy.start_episode("press the button")
    observe(episode, 5, is_demo=True)
    observe(episode, 1)
    first = policy.act([episode])[0]
    observe(episode, 10)
    assert np.array_equal(episode._executed, first[:10])
    second = policy.act([episode])[0]
    observe(episode, 16)
    assert np.array_equal(episode._executed, second[:16])
    other = np.ones((3, 8), np.float32)
    observe(episode, 3, actions=other)
    assert np.array_equal(episode._executed, np.concatenate([second[3:16], other]))
    with pytest.raises(UserError, match="actions must be"):
        observe(episode, 2, actions=other[:1])


def test_hybrid_reads_subgoal_and_memory_and_both_change_its_actions(source):
    policy, frames = small_policy("hybrid"), moving_frames(40)
    data = TrainingDataset(
        [source], policy.processor, subgoal=SubgoalText.from_config(policy.config["subgoal_text"])
    )
    assert re.search(r"Current Subgoal: .+ at <\d+", re.sub(r"\s+", " ", words(policy, data[5])))

    def act(past, subgoal):
        episode = policy.start_episode("sort the cubes", seed=1)
        episode.observe({"front": past, "wrist": past}, np.zeros((len(past), 8)))
        episode.subgoal = subgoal
        return policy.act([episode])

    baseline = act(frames, "press the button at <1, 2>")
    assert not np.allclose(baseline, act(frames, "put it down"))
    assert not np.allclose(
        baseline,
        act(np.concatenate([frames[:39][::-1], frames[39:]]), "press the button at <1, 2>"),
    )


@pytest.mark.slow
def test_hybrid_keeps_memory_and_subgoal_within_one_budget():
    policy = build_policy("hybrid")
    most = policy.processor.subgoal_length
    assert policy.memory.budget + most == policy.config["token_budget"] == 512
    with pytest.warns(UserWarning, match="subgoal_length=64"):
        _, mask = policy.processor.prompt("goal", subgoal="pick up the red cube at <10, 20> " * 30)
    _, without = policy.processor.prompt("goal", subgoal="")
    assert int(mask.sum()) - int(without.sum()) <= most
    for wrong in ({"memory": {"budget": 512}}, {"processor": {"subgoal_length": 80}}):
        with pytest.raises(UserError, match="more than token_budget=512"):
            build_policy("hybrid", device="meta", **wrong)
    with pytest.raises(UserError, match=r"processor\.subgoal_length"):
        build_policy("hybrid", processor={"subgoal_length": None})
    assert build_policy("hybrid", memory={"budget": 256}).memory.budget == 256


def test_hybrid_is_saved_and_loaded_with_its_limits(tmp_path):
    from mme_vla import MMEPolicy

    small_policy("hybrid").save_pretrained(tmp_path)
    loaded = MMEPolicy.from_pretrained(tmp_path)
    assert (
        loaded.processor.subgoal_length,
        loaded.memory.budget,
        loaded.config["token_budget"],
    ) == (64, 448, 512)
