"""The tasks as plain Gymnasium environments: Gymnasium's own check, and PPO of
stable-baselines3.
"""

import os
import re
import subprocess
import sys

import numpy as np
import pytest

from helpers import REPOSITORY
from helpers.tiers import slow_or_nightly

pytest.importorskip("mani_skill", reason="the simulator is not installed: the extra `sim` has it")
import gymnasium
from gymnasium.utils.env_checker import check_env

import mme_vla.envs.gym
from mme_vla.envs import rendering
from mme_vla.errors import UserError


@pytest.mark.parametrize(
    "task", slow_or_nightly(["StopCube", "PatternLock"], lambda task: task == "StopCube")
)
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


@pytest.mark.slow
@pytest.mark.usefixtures("renderer")
def test_images_and_the_conditioning_video_are_numpy_arrays() -> None:
    env = gymnasium.make("mme_vla/PatternLock-v0", episode=0)
    try:
        observation, info = env.reset(seed=0)
        assert observation in env.observation_space
        assert len(info["video"]) > 10
        assert {(image.dtype, image.shape) for image in info["video"]} == {
            (np.dtype(np.uint8), (256, 256, 3))
        }
        assert info["video"][0].std() > 5, "nothing is rendered"
    finally:
        env.close()


def test_the_code_of_the_page_runs() -> None:
    (block,) = re.findall(
        r"```python\n(.*?)```", (REPOSITORY / "docs/extend/gymnasium.md").read_text(), re.DOTALL
    )
    names: dict[str, object] = {}
    exec(compile(block, "docs/extend/gymnasium.md", "exec"), names)
    assert names["info"]["status"] == "ongoing"  # type: ignore[index]


FRESH = {
    "an import": "import gymnasium, mme_vla.envs.gym\nname = 'mme_vla/StopCube-v0'",
    "a module before the name": "import gymnasium\nname = 'mme_vla.envs.gym:mme_vla/StopCube-v0'",
}
"""How the page says that a task is made."""
VECTORS = {
    "sync": (
        "envs = gymnasium.make_vec(name, num_envs=2, vectorization_mode='sync', images=False,"
        " episode=0)"
    ),
    "async": (
        "envs = gymnasium.make_vec(name, num_envs=2, vectorization_mode='async', images=True,"
        " episode=0)"
    ),
}


def run_fresh(code: str, seconds: int = 300) -> str:
    """What a new process prints, which has imported nothing before."""
    command = [sys.executable, "-W", "ignore", "-c", code]
    finished = subprocess.run(
        command, cwd=REPOSITORY, capture_output=True, text=True, check=False, timeout=seconds
    )
    assert finished.returncode == 0, finished.stderr[-2000:]
    return finished.stdout


@pytest.mark.parametrize("name", slow_or_nightly(FRESH, lambda name: name == "an import"))
def test_a_fresh_process_makes_a_task(name: str) -> None:
    code = (
        f"{FRESH[name]}\nenv = gymnasium.make(name,"
        " images=False)\nprint(env.reset(seed=0)[1]['status'])\nenv.close()"
    )
    assert run_fresh(code).split() == ["ongoing"]


@pytest.mark.nightly
@pytest.mark.usefixtures("renderer")
@pytest.mark.parametrize("made", VECTORS.values(), ids=VECTORS)
def test_vector_environments_step_in_a_fresh_process(made: str) -> None:
    code = f"""{FRESH["an import"]}
if __name__ == "__main__":
    {made}
    envs.reset(seed=0)
    print(envs.step(envs.action_space.sample())[4]["status"].tolist())
    envs.close()"""
    assert run_fresh(code).strip() == "['ongoing', 'ongoing']"


class Watched:
    """An environment whose conditioning video has so many frames."""

    steps_counted = 1

    def __init__(self, frames: int) -> None:
        images = [np.full((256, 256, 3), i, np.uint8) for i in range(frames + 1)]
        states = {"joint_state_list": [np.zeros(7)], "gripper_state_list": [np.zeros(2)]}
        self.frames = {"front_rgb_list": images, "wrist_rgb_list": images[-1:], **states}

    def reset(self) -> tuple[dict, dict]:
        return self.frames, {"status": "ongoing", "task_goal": ["watch"]}

    def step(self, action: np.ndarray) -> tuple:
        return (
            {**self.frames, "front_rgb_list": self.frames["front_rgb_list"][-1:]},
            0.0,
            True,
            False,
            {},
        )

    def close(self) -> None:
        pass


@pytest.mark.parametrize("mode", [gymnasium.vector.SyncVectorEnv, gymnasium.vector.AsyncVectorEnv])
def test_vector_environments_hand_on_videos_of_different_lengths(
    mode: type, monkeypatch: pytest.MonkeyPatch
) -> None:
    def begin(task: mme_vla.envs.gym.GymTask, number: int) -> Watched:
        task._env = Watched(number)  # type: ignore[assignment]
        return task._env  # type: ignore[return-value]

    monkeypatch.setattr(mme_vla.envs.gym.GymTask, "_open", begin)
    envs = mode(
        [lambda n=n: gymnasium.make("mme_vla/PatternLock-v0", episode=n) for n in (3, 0, 5)]
    )
    try:
        _, infos = envs.reset(seed=0)
        assert [len(video) for video in infos["video"]] == [3, 0, 5]
        assert [image[0, 0, 0] for image in infos["video"][2]] == [0, 1, 2, 3, 4]
        for _ in range(2):  # the second one begins an episode of its own accord
            infos = envs.step(envs.action_space.sample())[4]
        assert [len(video) for video in infos["video"]] == [3, 0, 5]
    finally:
        envs.close()


@pytest.mark.nightly
@pytest.mark.usefixtures("renderer")
def test_episodes_with_videos_begin_in_a_vector_environment_in_a_fresh_process() -> None:
    code = f"""{FRESH["an import"]}
if __name__ == "__main__":
    def make(episode):
        return lambda: gymnasium.make("mme_vla/PatternLock-v0", episode=episode)
    for mode in (gymnasium.vector.AsyncVectorEnv, gymnasium.vector.SyncVectorEnv):
        envs = mode([make(0), make(2)])
        videos = envs.reset(seed=0)[1]["video"]
        print(len(videos[0]) > 0, len(videos[0]) != len(videos[1]))
        envs.close()"""
    assert run_fresh(code).split() == ["True"] * 4


def test_a_process_forked_after_rendering_is_refused_by_name(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(rendering, "_process", os.getpid() + 1)
    with pytest.raises(UserError, match="spawn"):
        rendering.render_backend()


def test_making_a_task_opens_no_simulator() -> None:
    env = mme_vla.envs.gym.GymTask("PatternLock")
    assert env._env is None and env.action_space.shape == (7,)


@pytest.mark.parametrize(
    "bad", [[np.nan] * 8, [0.0] * 7, [np.inf] * 8], ids=["NaN", "seven numbers", "infinite"]
)
def test_an_episode_that_ends_in_an_error_says_why(bad: list[float]) -> None:
    env = mme_vla.envs.gym.GymTask("StopCube", images=False, episode=0)
    try:
        env.reset()
        info = env.step(np.array(bad))[4]
        assert info["status"] == "error" and len(info["error_message"]) > 10
    finally:
        env.close()


def test_an_exception_without_a_text_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    env = mme_vla.envs.gym.GymTask("StopCube", images=False, episode=0)
    try:
        env.reset()
        monkeypatch.setattr(
            env._env._space, "act", lambda control, action: (_ for _ in ()).throw(RuntimeError)
        )
        info = env.step(np.zeros(8))[4]
        assert info["status"] == "error" and info["error_message"].startswith("RuntimeError")
    finally:
        env.close()


@pytest.mark.parametrize("max_steps", [1, 4])
def test_an_episode_is_truncated_at_its_limit(max_steps: int) -> None:
    env = mme_vla.envs.gym.GymTask("StopCube", images=False, episode=0, max_steps=max_steps)
    try:
        env.reset()
        hold = np.append(env._observation["state"][:7], 1.0)
        truncated = [env.step(hold)[3] for _ in range(max_steps)]
        assert truncated == [False] * (max_steps - 1) + [True]
    finally:
        env.close()


@pytest.mark.nightly
def test_ppo_runs_on_a_task() -> None:
    sb3 = pytest.importorskip("stable_baselines3", reason="stable-baselines3 is not installed")
    env = gymnasium.make("mme_vla/StopCube-v0", images=False, max_steps=40, reward="subtask")
    try:
        model = sb3.PPO(
            "MultiInputPolicy", env, n_steps=50, batch_size=25, n_epochs=1, device="cpu", seed=0
        )
        model.learn(100)
        assert model.num_timesteps == 100
    finally:
        env.close()
