"""The worked example of docs/extend/add-a-task.md: checked, made, evaluated and recorded like the
benchmark's own.
"""

from pathlib import Path

import h5py
import pytest

from helpers import REPOSITORY
from mme_vla import evaluate, make_env
from mme_vla.cli import record
from mme_vla.config.composition import compose
from mme_vla.config.plugins import import_plugins
from mme_vla.testing import check_task
from mme_vla.testing.small import SMALL_VISION, small_policy

pytest.importorskip("mani_skill", reason="the simulator is not installed: the extra `sim` has it")
EXAMPLE = REPOSITORY / "examples" / "two_buttons"


@pytest.fixture(autouse=True)
def known(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(EXAMPLE)
    monkeypatch.chdir(EXAMPLE)
    import_plugins(["two_buttons"])


def test_the_page_shows_the_file_that_is_tested() -> None:
    page = (REPOSITORY / "docs" / "extend" / "add-a-task.md").read_text()
    assert (EXAMPLE / "two_buttons.py").read_text().strip() in page


def test_it_meets_the_task_contract_and_samples_its_order() -> None:
    check_task("TwoButtons")


def test_make_env_gives_it_the_benchmarks_interface_and_draws_its_order() -> None:
    goals = set()
    for episode in range(6):
        env = make_env("TwoButtons", episode=episode, render=False)
        _, info = env.reset()
        goals.add(str(info["task_goal"]))
        env.close()
    assert len(goals) == 2


def test_gymnasium_gives_it_too() -> None:
    from mme_vla.envs.gym import GymTask

    env = GymTask("TwoButtons", episode=0, images=False)
    _, info = env.reset()
    assert "button" in info["goal"]
    env.close()


def test_a_policy_is_evaluated_on_it_in_a_worker_process(tmp_path: Path) -> None:
    policy = small_policy(
        "framesamp_context", backbone={"vision": {**SMALL_VISION, "patch_size": 16}}
    )
    run = evaluate(
        policy,
        "TwoButtons",
        [0],
        output=tmp_path,
        workers=1,
        render=False,
        max_steps=2,
        flow_steps=1,
        show_progress=False,
    )
    assert [(r.task, r.episode, r.success) for r in run.records] == [("TwoButtons", 0, False)]


@pytest.mark.slow
@pytest.mark.usefixtures("renderer")
def test_its_demonstrations_are_recorded(tmp_path: Path) -> None:
    selection = "frames=[0]"  # an image takes its time
    words = [
        "tasks=TwoButtons",
        "episodes=1",
        "lerobot=false",
        selection,
        f"hdf5={tmp_path / 'h5'}",
        f"output={tmp_path / 'x'}",
    ]
    record.main(compose("record", words))
    (file,) = (tmp_path / "h5").glob("*TwoButtons*.h5")
    with h5py.File(file) as recorded:
        (episode,) = recorded.values()
        subgoals = {
            step["info/simple_subgoal"][()].decode() for step in episode.values() if "info" in step
        }
        first = episode["timestep_0/obs/front_rgb"][()]
    assert subgoals >= {"press the left button", "press the right button"}
    assert first.std() > 10, "the scene is not rendered"
