"""A robot that chooses among options: its numbers, its data, training, rollouts and serving, and
real recordings.
"""

import json
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import torch

from helpers.h5_files import OPTIONS, choice_at, robomme_robot, write_file
from helpers.rollout_fakes import InlineEnvs, quick_policy, roll
from helpers.serving_fakes import Served, challenge
from mme_vla import UserError
from mme_vla.data.dataset import TrainingDataset
from mme_vla.data.episodes import EpisodeSource
from mme_vla.data.hdf5 import EpisodeRef, find_files, list_episodes, open_episode
from mme_vla.data.statistics import compute_norm_stats
from mme_vla.data.waypoints import find_motions, row_of
from mme_vla.embodiment import Embodiment
from mme_vla.embodiment.action_space import Option, read_options
from mme_vla.embodiment.robomme import CHOICE_SPACE, benchmark_action, choice_action
from mme_vla.envs.vector.pool import Job
from mme_vla.processing.processor import Processor
from mme_vla.processing.tokenizer import Tokenizer

EIGHT = [{"label": letter, "action": "move", "need_parameter": False} for letter in "abcdefgh"]
CHOOSER = robomme_robot("robomme_choice")
SPACE = CHOOSER.action


# Numbers ------------------------------------------------------------------------------------------


def test_a_choice_survives_the_way_through_the_robots_numbers() -> None:
    for letter, point in (("a", [54, 145]), ("h", [255, 0]), ("c", [])):
        row = torch.from_numpy(choice_action(CHOICE_SPACE, {"choice": letter, "point": point}))
        state = torch.zeros(8)
        back = SPACE.to_absolute(SPACE.to_relative(row[None], state), state)
        action = benchmark_action(SPACE, SPACE.decide(back, read_options(EIGHT, 8))[0].numpy())
        assert action == {"choice": letter.upper(), "point": pytest.approx(point or [128, 128])}


@pytest.mark.parametrize(("stick", "width"), [(False, 8), (True, 7)])
def test_numbers_beyond_the_robots_do_not_reach_the_environment(stick: bool, width: int) -> None:
    joints = robomme_robot("robomme_joint").action
    action = benchmark_action(joints, np.arange(32.0), stick)
    assert isinstance(action, np.ndarray) and action.tolist() == [*range(width)]


def test_the_best_of_the_offered_letters_is_taken_and_no_other() -> None:
    scores = torch.zeros(2, 10)
    scores[0, [1, 3, 6]] = torch.tensor([0.2, 0.4, 0.9])
    scores[1, :8] = -1 - torch.arange(8)  # all below zero: still one of them
    scores[:, 8:] = torch.tensor([-0.5, 1.5])
    among = tuple(Option(letter, "go") for letter in "bd")
    decided = SPACE.decide(scores, among)
    assert decided[:, :8].argmax(1).tolist() == [3, 1] and decided[:, :8].sum(1).tolist() == [1, 1]
    assert decided[:, 8:].tolist() == [[0, 1], [0, 1]], "a point lies in the image"
    assert SPACE.decide(scores, read_options(EIGHT, 8))[0, :8].argmax() == 6
    with pytest.raises(UserError, match="offers none"):
        SPACE.decide(scores, ())


def test_other_robots_decide_nothing_and_say_nothing_of_options() -> None:
    joints = robomme_robot("robomme_joint").action
    actions = torch.randn(3, 8)
    assert joints.decide(actions, ()) is actions and joints.worded("go", ()) == "go"
    assert "choice" not in joints.to_dict(), (
        "configurations of earlier versions stay what they were"
    )


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"choice": [0, 10]}, "choice must list numbers from 0 to 9"),
        ({"point": [8]}, "the two numbers y, x"),
        ({"point": [7, 8]}, "the two numbers y, x"),
        ({"choice": []}, "the two numbers y, x"),
        ({"frames": 1}, "frames=null"),
        ({"options_length": -1}, "options_length=-1 must be a whole number from 0 to 65536"),
    ],
)
def test_impossible_choices_are_refused_by_the_key(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(UserError, match=message):
        Embodiment.from_dict({**CHOOSER.to_dict(), "action": {**SPACE.to_dict(), **changes}})


@pytest.mark.parametrize(
    "given",
    [
        None,
        [],
        "abc",
        [{"label": "z", "action": "go"}],
        [{"label": "a"}],
        EIGHT + EIGHT[:1],
        EIGHT[:1] * 2,
        [{"label": "a", "action": "go", "possible": False}],
        [{"label": "a", "action": "go", "need_parameter": "yes"}],
        [{"label": "a", "action": "go " * 200}],
    ],
)
def test_options_that_nobody_can_choose_among_are_refused(given: Any) -> None:
    with pytest.raises(UserError, match="option"):
        read_options(given, 8)


# Data ---------------------------------------------------------------------------------------------


def test_every_choice_is_decided_on_one_frame_before_it_begins_even_the_same_twice() -> None:
    rows = np.zeros((12, 10), np.float32)
    for frame, letter in ((2, "a"), (5, "b"), (9, "b")):
        rows[frame] = choice_action(CHOICE_SPACE, {"choice": letter})
    choices = find_motions(rows, 50, SPACE.choice)
    assert choices.decisions.tolist() == [50, 54, 58] and choices.targets[:, 1].tolist() == [
        0,
        1,
        1,
    ]
    assert find_motions(np.zeros((3, 10), np.float32), 0, SPACE.choice).decisions.tolist() == []


def test_recorded_choices_are_converted_and_read_as_decisions(folder: Path) -> None:
    source = EpisodeSource(folder, robot=CHOOSER)
    assert [option.to_dict() for option in source.options(0)] == OPTIONS
    # Chosen at every fourth frame, but at 12 nothing; the execution of episode 0 begins at frame 8.
    assert source.decisions(0).tolist() == [8, 15, 19] and source.decisions(1).tolist() == [
        0,
        3,
        7,
        15,
    ]
    chunk, recorded = source.action_chunk(0, 15, 4)
    assert recorded.tolist() == [True, True, False, False]
    expected = [choice_at(number) for number in (4, 5, 5, 5)]
    assert np.array_equal(chunk, [choice_action(CHOICE_SPACE, c) for c in expected])


def test_letters_that_are_seldom_selected_stay_numbers_of_ordinary_size(folder: Path) -> None:
    source = EpisodeSource(folder, robot=CHOOSER)
    stats = compute_norm_stats([source], horizon=4, robot=CHOOSER, extremes=True)
    for low, high in (stats.actions.bounds("quantiles"), stats.actions.bounds("extremes")):
        assert low[:8].tolist() == [0] * 8 and high[:8].tolist() == [1] * 8
    processor = Processor(28, Tokenizer.load("sample"), stats=stats, embodiment=CHOOSER)
    data = TrainingDataset([source], processor)
    assert len(data) == 7
    item = data[0]
    assert item["actions"].abs().max() < 2, "letters are −1 and 1; the point is about as large"
    back = SPACE.decide(
        processor.absolute_actions(item["actions"], item["state"]), source.options(0)
    )
    assert torch.allclose(back, torch.from_numpy(source.action_chunk(0, 8, 4)[0]), atol=1e-5)


def test_the_prompt_lists_what_is_offered(folder: Path) -> None:
    tokenizer = Tokenizer.load("sample")
    source = EpisodeSource(folder, robot=CHOOSER)
    processor = Processor(
        28, tokenizer, embodiment=CHOOSER, stats=compute_norm_stats([source], robot=CHOOSER)
    )
    item = TrainingDataset([source], processor)[0]
    words = tokenizer.decode(item["prompt"][item["prompt_mask"]].tolist())
    assert (
        words.strip()
        == "do task 0. Options: a pick up the cube (point), b press the button, c wait"
    )
    assert item["goal"] == "do task 0"


def test_the_longest_options_of_the_benchmark_fit_the_prompt() -> None:
    """RouteStick's, with its longest goal; a warning would say that the prompt was cut."""
    directions = ("clockwise", "counterclockwise")
    texts = [
        f"move to the nearest {side} target by circling around the stick {t}"
        for t in directions
        for side in ("left", "right")
    ]
    options = tuple(Option("abcd"[i], text) for i, text in enumerate(texts))
    goal = (
        "watch the video carefully, then use the stick attached to the robot to navigate around the"
        " sticks on the "
    )
    goal += "table, following the same path shown in the video"
    processor = Processor(28, Tokenizer.load("sample"), embodiment=CHOOSER)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        _, mask = processor.prompt(SPACE.worded(goal, options))
    assert mask.sum() < len(mask)


def test_a_dataset_that_lost_its_options_says_so(folder: Path) -> None:
    source = EpisodeSource(folder, robot=CHOOSER)
    source.__dict__["records"] = [
        {key: v for key, v in r.items() if key != "options"} for r in source.records
    ]
    with pytest.raises(UserError, match="does not say which options episode 1 offered"):
        source.options(1)


@pytest.mark.parametrize(
    "text",
    ["{", "[]", '{"choice": "K"}', '{"choice": "AB"}', '{"choice": "A", "point": [1]}',
     '{"choice": "A", "point": ["y", "x"]}', '{"choice": "A", "point": [1e999, 2]}'],
)  # fmt: skip
def test_what_is_no_choice_is_refused(text: str) -> None:
    with pytest.raises(UserError, match="is no choice"):
        row_of(text)


def test_a_damaged_choice_is_reported_with_its_place(tmp_path: Path) -> None:
    write_file(tmp_path / "record_dataset_Alpha.h5", [8], choices=True)
    with h5py.File(tmp_path / "record_dataset_Alpha.h5", "r+") as file:
        del file["episode_0/timestep_4/action/choice_action"]
        file["episode_0/timestep_4/action/choice_action"] = json.dumps({"choice": "Q"})
    (ref,) = list_episodes(find_files([tmp_path]))
    with (
        open_episode(ref) as episode,
        pytest.raises(UserError, match=r"timestep_4/action/choice_action: .* is no choice"),
    ):
        episode.choice_actions()


# Training, rollouts, serving ----------------------------------------------------------------------


class ChoiceEnvs(InlineEnvs):
    """Environments in which every choice moves the arm for three frames, and "C" not at all."""

    def start(self, worker: int, job: Job, **how: Any) -> None:
        self.taken: list[Any] = getattr(self, "taken", [])
        super().start(worker, job, **how)
        env = self.made[job]
        joints = env.step

        def choose(action: dict[str, Any]) -> Any:
            self.taken.append(action)
            if action["choice"] == "C":
                frames = {key: [] for key in joints(np.zeros(8))[0]}
                return frames, 0.0, False, False, env._info("ongoing")
            steps = [joints(np.full(8, len(self.taken) + i, float)) for i in range(3)]
            observation = {key: [x for step in steps for x in step[0][key]] for key in steps[0][0]}
            return observation, *steps[-1][1:]

        env.step = choose  # type: ignore[method-assign, assignment]


class Offering(ChoiceEnvs):
    """The same, and the reset says what there is to choose."""

    offered = OPTIONS[:2]

    def start(self, worker: int, job: Job, **how: Any) -> None:
        super().start(worker, job, **how)
        reply = self._replies[-1]
        reply.info = replace(reply.info, options=self.offered)


def test_a_rollout_asks_after_each_choice_and_takes_what_is_offered_only() -> None:
    policy = quick_policy(
        "framesamp_modul", patch_size=8, embodiment="robomme_choice", memory={"budget": 64}
    )
    envs = Offering(robot=CHOOSER)
    (record,) = roll(policy, [Job("VideoUnmask", "test", 1)], envs, max_steps=9)
    assert record.outcome in ("success", "timeout") and record.action_space == "multi_choice"
    assert record.chunks == len(envs.taken) == record.steps // 3
    assert {action["choice"] for action in envs.taken} <= {"A", "B"}
    assert all(0 <= share <= 256 for action in envs.taken for share in action["point"])


def test_choices_that_move_nothing_come_to_an_end() -> None:
    class Idle(Offering):
        offered = OPTIONS[2:]

    policy = quick_policy("pi05", embodiment="robomme_choice")
    (record,) = roll(
        policy, [Job("PickXtimes", "test", 0)], Idle(robot=CHOOSER, max_steps=5), max_steps=5
    )
    assert (record.outcome, record.chunks, record.steps) == ("timeout", 6, 0)


def test_an_environment_without_options_is_no_place_for_a_policy_that_chooses() -> None:
    policy = quick_policy("pi05", embodiment="robomme_choice")
    with pytest.raises(UserError, match="chooses among options, and the episode offers none"):
        roll(policy, [Job("PickXtimes", "test", 0)], ChoiceEnvs(robot=CHOOSER))


def test_a_policy_that_chooses_is_served_with_its_choices_in_words() -> None:
    policy = quick_policy("pi05", embodiment="robomme_choice")
    frames, states = [np.zeros((32, 32, 3), np.uint8)] * 2, np.zeros((2, 8), np.float32)
    request = challenge(frames, frames, states, True)
    with Served(policy) as served, served.client() as client:
        about = client.metadata
        assert (about["action_space"], about["action_dim"], about["execute"]) == (
            "multi_choice",
            10,
            1,
        )
        reply = client.infer({**request, "available_multi_choices": OPTIONS[1:2]})
        assert reply["actions"].shape == (1, 10) and reply["actions"][0, 1] == 1
        assert reply["choices"][0]["choice"] == "B"
        assert np.allclose(reply["choices"][0]["point"], reply["actions"][0, 8:] * 256)
        later = client.infer({**challenge(frames[:1], frames[:1], states[:1], False)})
        assert later["choices"][0]["choice"] == "B", (
            "options stay as they were until others are given"
        )
        again = client.infer(challenge(frames[:0], frames[:0], states[:0], False))
        assert again["actions"].shape == (1, 10), "a choice that moved nothing shows no frame"
        with pytest.raises(UserError, match="is_first_step holds 0 frames"):
            client.infer(challenge(frames[:0], frames[:0], states[:0], True))
        with pytest.raises(UserError, match="cannot be chosen"):
            client.infer({**request, "available_multi_choices": [{"label": "Z", "action": "go"}]})
    with (
        Served(policy) as served,
        served.client() as client,
        pytest.raises(UserError, match="offers none"),
    ):
        client.infer(request)


# Real recordings ----------------------------------------------------------------------------------


def test_choices_of_real_episodes_are_those_of_the_official_files(h5_folder: Path) -> None:
    counts = {}
    for task, number in (("PickXtimes", 8), ("PatternLock", 8)):
        with open_episode(
            EpisodeRef(h5_folder / f"record_dataset_{task}.h5", number, task)
        ) as episode:
            rows, first = episode.choice_actions()[episode.exec_start :], episode.exec_start
            motions = find_motions(rows, first, SPACE.choice)
            actions = [benchmark_action(SPACE, row) for row in motions.targets]
            counts[task] = (
                motions.decisions.tolist(),
                [c["choice"] for c in actions],
                [c["point"] for c in actions],
            )
    assert counts["PickXtimes"] == (
        [0, 143, 237],
        ["A", "B", "C"],
        [[54, 145], [93, 109], [66, 101]],
    )
    assert counts["PatternLock"][:2] == ([74, 109], ["A", "H"])
