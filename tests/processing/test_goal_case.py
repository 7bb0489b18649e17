"""Goals are spelled alike in training and acting for a robot of one's own; the benchmark's stay as
they are given.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers.lerobot_tables import custom_robot
from mme_vla.embodiment import ROBOMME_JOINT
from mme_vla.errors import UserError
from mme_vla.processing.processor import Processor
from mme_vla.processing.prompt import goal_case
from mme_vla.testing.small import small_policy

GOAL = "Fold the Blue Towel"


def ids(processor: Any, goal: str, **more: Any) -> list[int]:
    return processor.prompt(goal, **more)[0].tolist()


def custom_processor(**settings: Any) -> Processor:
    sections = {
        "backbone": small_policy("pi05").config["backbone"],
        "processor": {"tokenizer": "sample", **settings},
        "embodiment": custom_robot(horizon=20).to_dict(),
    }
    return Processor.from_sections(sections)


def test_a_new_policy_of_ones_own_robot_reads_what_it_was_trained_on(tmp_path: Path) -> None:
    processor = custom_processor()
    assert ids(processor, GOAL) == ids(processor, GOAL.lower())
    processor.save(tmp_path)
    assert json.loads((tmp_path / "processor.json").read_text())["goal_case"] == "lower"
    loaded = Processor.load(tmp_path)
    assert ids(loaded, GOAL) == ids(processor, GOAL.lower())


def test_subgoals_are_spelled_alike_too() -> None:
    processor = custom_processor(prompt="subgoal")
    assert ids(processor, GOAL, subgoal="Grasp IT") == ids(processor, GOAL, subgoal="grasp it")
    goal_text = custom_processor(prompt="subgoal", goal_case="given")
    assert ids(goal_text, GOAL, subgoal="Grasp IT") != ids(goal_text, GOAL, subgoal="grasp it")


def test_a_checkpoint_from_before_keeps_its_tokens(tmp_path: Path) -> None:
    processor = custom_processor()
    processor.save(tmp_path)
    path = tmp_path / "processor.json"
    settings = json.loads(path.read_text())
    del settings["goal_case"]
    path.write_text(json.dumps(settings))
    loaded = Processor.load(tmp_path)
    assert ids(loaded, GOAL) != ids(loaded, GOAL.lower())
    assert "goal_case" not in loaded.to_config()  # nor does it get a rule by being saved again


def test_the_benchmarks_robots_take_goals_as_they_are_given(tmp_path: Path) -> None:
    processor = small_policy("pi05").require_processor()
    assert ids(processor, GOAL) != ids(processor, GOAL.lower())
    assert "goal_case" not in processor.to_config()
    assert goal_case(ROBOMME_JOINT) == "given" and goal_case(custom_robot()) == "lower"


def test_the_rule_can_be_chosen_and_a_wrong_word_is_named() -> None:
    assert ids(custom_processor(goal_case="given"), GOAL) != ids(custom_processor(), GOAL)
    with pytest.raises(UserError, match=r"processor.goal_case='upper'"):
        custom_processor(goal_case="upper")


def test_an_episode_without_a_goal_is_refused_when_its_prompt_is_made() -> None:
    policy = small_policy("pi05")
    episode = policy.start_episode("")  # environments give it later
    image = np.zeros((1, 32, 32, 3), np.uint8)
    episode.observe(
        dict.fromkeys(policy.embodiment.camera_names, image), np.zeros((1, 8), np.float32)
    )
    with pytest.raises(UserError, match=r"The goal is ''"):
        _ = episode.prompt
    episode.goal = "press the button"
    assert len(episode.prompt[0]) == len(policy.require_processor().prompt("press the button")[0])


@pytest.mark.parametrize("goal", ["", "   ", ["", "press the button"]])
def test_a_server_refuses_a_request_without_a_goal(goal: Any) -> None:
    from mme_vla.embodiment import ROBOMME_JOINT
    from mme_vla.serving.requests import RequestReader

    image = np.zeros((16, 16, 3), np.uint8)
    message = {
        "observation/image": image,
        "observation/wrist_image": image,
        "observation/state": np.zeros(8, np.float32),
        "prompt": goal,
    }
    with pytest.raises(UserError, match=r"prompt is '.*': a policy is told what to do in words"):
        RequestReader(ROBOMME_JOINT, 10).parse(message)


def test_simplememvla_spells_alike() -> None:
    from mme_vla.extras.methods.simplememvla.processor import PromptSettings, SimpleMemVlaProcessor

    robot = custom_robot(horizon=20)
    goal_text, lower = (
        SimpleMemVlaProcessor(PromptSettings(tokenizer="bytes", goal_case=case), robot, 32)
        for case in (None, "lower")
    )
    assert GOAL in goal_text.prompt(GOAL)
    assert GOAL.lower() in lower.prompt(GOAL) and GOAL not in lower.prompt(GOAL)
