"""MIKASA-Robo-VLA's scenes by its protocol, and the scripts that demonstrate them."""

from collections.abc import Iterator

import numpy as np
import pytest

from mme_vla.envs import base
from mme_vla.envs.base import EpisodeEnv, environment
from mme_vla.errors import UserError
from mme_vla.extras.mikasa.catalog import BULB, FAMILIES, STEPS

pytest.importorskip("mani_skill", reason="the simulator is not installed: the extra `sim`")
pytest.importorskip(
    "mikasa_robo_suite", reason="MIKASA-Robo-VLA is not installed: the extra `mikasa`"
)


@pytest.fixture(autouse=True)
def no_kept_scenes() -> Iterator[None]:
    yield
    while base._idle:
        base._idle.popitem()[1].close()


def opened(task: str, episode: int = 0, env: str = "mikasa", render: bool = False) -> EpisodeEnv:
    env = environment(env).open(task, "test", episode, render=render)
    assert isinstance(env, EpisodeEnv)
    return env


def test_the_catalog_is_what_the_package_registers() -> None:
    import mikasa_robo_suite.vla.memory_envs  # noqa: F401
    from mani_skill.utils.registration import REGISTERED_ENVS

    limits = {
        f"{task}-VLA-v0": REGISTERED_ENVS[f"{task}-VLA-v0"].max_episode_steps for task in STEPS
    }
    assert limits == {f"{task}-VLA-v0": steps for task, steps in STEPS.items()}


def test_no_action_moves_the_robot_while_the_cue_is_shown() -> None:
    env = opened("RememberColor3")
    frames, _ = env.reset()
    states = [frames["state_list"][-1]]
    for _ in range(env.env.frozen + 1):
        frames, *_ = env.step(np.array([0, 1, -1, 0, 0, 0, 1]))
        states.append(frames["state_list"][-1])
    moved = np.abs(np.diff(np.stack(states)[:, :3], axis=0)).max(axis=1)
    assert env.env.frozen >= 2 and moved[:-1].max() < 0.02 < moved[-1] + 0.015
    assert states[0].shape == (7,)


def test_the_cue_can_be_a_conditioning_video() -> None:
    env = opened("RememberColor3", env="mikasa_video")
    frames, _ = env.reset()
    assert len(frames["state_list"]) == env.env.frozen + 1 > 2
    assert env.env.time == env.env.cue_end


@pytest.mark.usefixtures("renderer")
def test_images_on_demand_are_the_simulators_own_but_for_the_wrist_cameras_body() -> None:
    import gymnasium

    env = opened("RememberColor3", render=True)
    frames, info = env.reset()
    assert info["task_goal"] == [
        "Observe the cube's color, wait, then touch the cube of the same color."
    ]
    reference = gymnasium.make(
        "RememberColor3-VLA-v0", num_envs=1, obs_mode="rgb", control_mode="pd_ee_delta_pose",
        reward_mode="normalized_dense", sim_backend="physx_cpu", render_backend="cpu",
    )  # fmt: skip
    observation, _ = reference.reset(seed=env.spec.seed)
    action = np.zeros(7, np.float32)
    for _ in range(3):
        for name, camera in (("top", "base_camera"), ("wrist", "hand_camera")):
            image = observation["sensor_data"][camera]["rgb"][0].numpy()
            differs = (frames[f"{name}_rgb_list"][-1] != image).any(-1)
            most = {"top": 0.01, "wrist": 0}[name]  # the wrist camera does not see itself
            assert differs.mean() <= most, f"{differs.sum()} pixels of {name} differ"
        frames, *_ = env.step(action)
        observation, *_ = reference.step(action)
    reference.close()


@pytest.mark.parametrize(
    "task",
    [
        "RememberShape5",
        "FindImposterColor9",
        "TakeItBack",
        "RotateStrictPos",
        "RotateLenientPos",
        "InterceptFast",
        "InterceptGrabSlow",
        "BunchOfColors3",
        "ChainOfColors3",
    ],
)
def test_scripts_solve_tasks_of_all_kinds_of_memory_that_run(task: str) -> None:
    for episode in range(2):
        env = opened(task, episode)
        steps = sum(1 for _ in env.demonstration())
        assert env.success and steps < STEPS[task]
        env.close()


def test_the_same_seed_is_the_same_scene_in_a_kept_environment() -> None:
    first = [action for _, action, _ in opened("FindImposterShape3", 3).demonstration()]
    env = opened("FindImposterShape3", 4)
    list(env.demonstration())
    env.close()
    again = [action for _, action, _ in opened("FindImposterShape3", 3).demonstration()]
    np.testing.assert_allclose(np.stack(again), np.stack(first), atol=1e-5)


@pytest.mark.usefixtures("renderer", "lamp_model")
@pytest.mark.parametrize(
    "family", [name for name, kind in FAMILIES.items() if kind.needs == (BULB,)]
)
def test_tasks_with_a_lamp_run_once_its_model_is_there(family: str) -> None:
    env = opened(next(iter(FAMILIES[family].tasks)), render=True)
    _, info = env.reset()
    assert info["task_goal"][0]
    frames, *_, report = env.step(np.array([0, 0, 0, 0, 0, 0, 1]))
    assert report["status"] == "ongoing" and frames["top_rgb_list"][-1].std() > 10
    env.close()
    with pytest.raises(UserError, match="no script that demonstrates"):
        list(opened(env.spec.task).demonstration())
