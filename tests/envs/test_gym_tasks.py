"""The tasks as plain Gymnasium environments: Gymnasium's own check, and PPO of stable-baselines3."""

import re
import tomllib

import numpy as np
import pytest

from helpers import REPOSITORY

pytest.importorskip("mani_skill", reason="the simulator is not installed: the extra `sim` has it")
import gymnasium
from gymnasium.utils.env_checker import check_env

import mme_vla.envs.gym  # noqa: F401


@pytest.mark.parametrize("task", ["StopCube", "PatternLock"])
def test_tasks_of_gripper_and_stick_pass_gymnasiums_check(task: str) -> None:
    env = gymnasium.make(f"mme_vla/{task}-v0", images=False, max_steps=50)
    try:
        assert np.isfinite(env.action_space.low).all() and np.isfinite(env.action_space.high).all()
        check_env(env.unwrapped, skip_render_check=True)
        _, info = env.reset(seed=3)
        _, reward, terminated, truncated, stepped = env.step(env.action_space.sample())
        assert info["goal"] and isinstance(reward, float)
        assert (type(terminated), type(truncated), type(stepped["success"])) == (bool, bool, bool)
    finally:
        env.close()


def test_a_seed_fixes_the_episodes_and_an_option_names_one() -> None:
    env = gymnasium.make("mme_vla/StopCube-v0", images=False)
    try:
        firsts = [[env.reset(seed=1)[1]["episode"], env.reset()[1]["episode"]] for _ in range(2)]
        assert firsts[0] == firsts[1]
        assert env.reset(options={"episode": 4})[1]["episode"] == 4
    finally:
        env.close()


@pytest.mark.usefixtures("renderer")
def test_images_and_the_conditioning_video_are_numpy_arrays() -> None:
    env = gymnasium.make("mme_vla/PatternLock-v0", episode=0)
    try:
        observation, info = env.reset(seed=0)
        assert observation in env.observation_space
        assert info["video"].dtype == np.uint8 and len(info["video"]) > 10
        assert info["video"][0].std() > 5, "nothing is rendered"
    finally:
        env.close()


def test_the_code_of_the_page_runs() -> None:
    (block,) = re.findall(r"```python\n(.*?)```", (REPOSITORY / "docs/extend/gymnasium.md").read_text(), re.DOTALL)
    names: dict[str, object] = {}
    exec(compile(block, "docs/extend/gymnasium.md", "exec"), names)
    assert names["info"]["status"] == "ongoing"  # type: ignore[index]


def test_the_package_declares_gymnasiums_entry_point() -> None:
    project = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]
    module, _, name = project["entry-points"]["gymnasium.envs"]["mme_vla"].partition(":")
    assert callable(getattr(__import__(module, fromlist=[name]), name))


@pytest.mark.slow
def test_ppo_runs_on_a_task() -> None:
    sb3 = pytest.importorskip("stable_baselines3", reason="stable-baselines3 is not installed")
    env = gymnasium.make("mme_vla/StopCube-v0", images=False, max_steps=40, reward="subtask")
    try:
        model = sb3.PPO("MultiInputPolicy", env, n_steps=50, batch_size=25, n_epochs=1, device="cpu", seed=0)
        model.learn(100)
        assert model.num_timesteps == 100
    finally:
        env.close()
