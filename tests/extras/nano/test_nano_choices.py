"""Demonstrations of choices, for robots that choose among options; and the scenes of the counting
row.
"""

from mme_vla import build_policy
from mme_vla.envs.make import make_env
from mme_vla.extras.nano.demonstrations import record

ROBOT = build_policy("pi05", backbone="tiny", embodiment="robomme_choice_front").embodiment


def test_a_demonstration_for_a_robot_that_chooses_is_its_choices_and_says_the_options(
    renderer: str,
) -> None:
    made = record("SwingXtimes", 3_000_001, "easy", [], ["front"], acts=ROBOT.action)
    assert (
        made is not None and "two times" in made.goal and "Options: a pick up the cube" in made.goal
    )
    letters = "".join("abcdefgh"[row] for row in made.motions.targets[:, :8].argmax(1))
    assert letters == "abbbbcd"
    across = made.motions.targets[1:5, 9]
    # right of the robot is left in the image
    assert across[0] == across[2] < across[1] == across[3]
    assert len(made.boundaries) == len(letters) + 1, "after the last one it is over"
    assert set(made.motions.decisions.tolist()) == set(made.images["front"])


def test_the_first_subgoal_after_a_video_is_the_one_that_a_policy_is_told(renderer: str) -> None:
    made = record("MoveCube", 3_000_001, "easy", [], ["front"], acts=ROBOT.action)
    env = make_env(
        "MoveCube", seed=3_000_001, difficulty="easy", action_space="multi_choice", render=False
    )
    _, info = env.reset()
    env.close()
    assert made is not None
    assert made.subgoals["simple"] == [
        info["simple_subgoal_online"].lower(),
        "place the cube onto the target",
    ]
