"""Demonstrations of choices, for robots that choose among options; and the scenes of the counting row."""

import pytest

from helpers import REPOSITORY
from mme_vla import build_policy
from mme_vla.config.composition import compose
from mme_vla.envs.episodes import choose_episodes
from mme_vla.envs.rendering import render_backend
from mme_vla.errors import UserError
from mme_vla.evaluation.store import find_records, read_folders
from mme_vla.nano.demonstrations import record

ROBOT = build_policy("pi05", backbone="tiny", embodiment="robomme_choice_front").embodiment


def test_a_demonstration_for_a_robot_that_chooses_is_its_choices_and_says_the_options() -> None:
    pytest.importorskip("mani_skill", reason="needs the simulator: uv sync --inexact --extra sim")
    try:
        render_backend()
    except UserError as error:
        pytest.skip(str(error))
    made = record("SwingXtimes", 3_000_001, "easy", [], ["front"], acts=ROBOT.action)
    assert made is not None and "two times" in made.goal and "Options: a pick up the cube" in made.goal
    letters = "".join("abcdefgh"[row] for row in made.motions.targets[:, :8].argmax(1))
    assert letters == "abbbbcd"
    across = made.motions.targets[1:5, 9]
    assert across[0] == across[2] < across[1] == across[3]  # right of the robot is left in the image
    assert set(made.motions.decisions.tolist()) == set(made.images["front"])


@pytest.mark.parametrize(("task", "level"), [("SwingXtimes", "easy"), ("VideoRepick", "hard")])
def test_a_row_by_choices_is_of_a_hundred_scenes_of_one_difficulty(task: str, level: str) -> None:
    config = compose("nano", [f"nano={task}", f"task={task}"])
    specs = choose_episodes(task, list(config.episodes), config.split)
    assert len({spec.seed for spec in specs}) == 100 and {spec.difficulty for spec in specs} == {level}


@pytest.mark.parametrize(
    ("task", "model"),
    [
        ("SwingXtimes", "framesamp_modul"),
        ("SwingXtimes", "pi05"),
        ("VideoRepick", "actions_modul"),
        ("VideoRepick", "pi05"),
    ],
)
def test_the_figures_of_rows_by_choices_follow_from_the_records(task: str, model: str) -> None:
    read = read_folders(find_records([REPOSITORY / "benchmarks" / "nano" / task / model]))
    records = {record.episode: record for record in read}.values()  # one that ended in an error was tried twice
    page = (REPOSITORY / "docs" / "evidence" / "nano.md").read_text()
    (row,) = [line for line in page.splitlines() if line.startswith(f"| {task}, ") and f"choices | `{model}`" in line]
    done = sum(record.success for record in records)
    assert f"| {len(records)} |" in row and f"{100 * done / len(records):.0f} % (" in row
