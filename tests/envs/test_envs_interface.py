"""The environment's contract: lists, infos, statuses, step counting, the conditioning video,
errors.
"""

import gc
import sys
import weakref
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip(
    "mani_skill", reason="the simulator is not installed: uv sync --inexact --extra sim"
)

from mme_vla.envs import make, make_env, rendering
from mme_vla.envs.grounding import Grounding, centroid, ground, project
from mme_vla.envs.observations import AngleTrack, Include, front_extrinsic
from mme_vla.envs.robomme.robot.control import PlanningError
from mme_vla.errors import UserError

STILL = np.array([0, 0, 0, -np.pi / 2, 0, np.pi / 2, np.pi / 4, 1], np.float32)


def test_a_closed_environment_gives_its_scene_up_at_once(make_unrendered) -> None:
    env = make_unrendered()
    env.reset()
    scene = weakref.ref(env._task.scene.sub_scenes[0])
    gc.disable()
    try:
        env.close()
        assert scene() is None
    finally:
        gc.enable()


def test_the_stick_s_video_leaves_out_what_is_not_recorded(make_unrendered) -> None:
    env = make_unrendered("PatternLock", "train", 8)
    texts: list[str] = []
    env.on_frame = lambda frame, info, in_video: texts.append(info["simple_subgoal_online"])
    observation, info = env.reset()
    assert len(texts) == len(observation["joint_state_list"])
    assert "NO RECORD" not in texts
    assert env.task.steps_done > len(texts)
    np.testing.assert_allclose(observation["joint_state_list"][-1], env.task.stored_qpos, atol=0.01)
    assert info["simple_subgoal_online"].startswith("move ")


# The contract -------------------------------------------------------------------------------------


def test_a_reset_takes_no_options(make_unrendered) -> None:
    env = make_unrendered("StopCube")
    env.reset(seed=3, options={})
    with pytest.raises(UserError, match="Unknown reset options video; there are none"):
        env.reset(options={"video": False})


def test_a_step_gives_lists_of_one_frame_and_the_official_info(make_unrendered) -> None:
    include = Include(front_camera_extrinsic=True, front_camera_intrinsic=True)
    env = make_unrendered(include=include)
    first, info = env.reset()
    assert {key: len(value) for key, value in first.items()} == dict.fromkeys(first, 1)
    observation, reward, terminated, truncated, info = env.step(STILL)
    dtypes = {key: (value[0].dtype.name, value[0].shape) for key, value in observation.items()}
    assert dtypes == {
        "joint_state_list": ("float32", (7,)),
        "eef_state_list": ("float64", (6,)),
        "gripper_state_list": ("float32", (2,)),
        "front_camera_extrinsic_list": ("float32", (3, 4)),
    }
    assert (reward.shape, terminated.shape, truncated.shape) == ((), (), ())
    assert set(info) == {
        "task_goal",
        "simple_subgoal_online",
        "grounded_subgoal_online",
        "status",
        "success",
        "fail",
        "elapsed_steps",
        "front_camera_intrinsic",
    }
    assert info["status"] == "ongoing"
    assert info["elapsed_steps"].tolist() == [2]
    assert info["grounded_subgoal_online"] == info["simple_subgoal_online"]


def test_multi_choice_provides_what_is_needed_to_choose(make_unrendered) -> None:
    env = make_unrendered(
        "PickXtimes", "train", 8, "multi_choice", include=Include(front_camera_extrinsic=False)
    )
    observation, info = env.reset()
    assert "front_camera_extrinsic_list" in observation
    assert info["front_camera_intrinsic"].shape == (3, 3)
    with pytest.warns(UserWarning, match="Unknown choice"):
        observation, _, terminated, truncated, info = env.step({"choice": "q"})
    assert all(frames == [] for frames in observation.values())
    assert (bool(terminated), bool(truncated), info["status"]) == (False, False, "ongoing")


def test_the_limit_counts_two_steps_more(make_unrendered) -> None:
    env = make_unrendered("VideoUnmask", "train", 4, max_steps=5)
    env.reset()
    assert env.steps_counted == 1
    statuses = []
    for _ in range(6):
        _, _, _, truncated, info = env.step(STILL)
        statuses.append((info["status"], bool(truncated)))
    assert statuses == [("ongoing", False)] * 5 + [("timeout", True)]


@pytest.mark.parametrize("action", [STILL[:6], np.full(8, np.nan), None, "up", [[0.0] * 8]])
def test_a_malformed_action_is_an_error_status(make_unrendered, action: Any) -> None:
    env = make_unrendered()
    env.reset()
    observation, reward, terminated, truncated, info = env.step(action)
    assert (observation, reward, terminated, truncated) == (None, 0.0, True, False)
    assert info["status"] == "error"
    assert info["exception_type"] == "UserError"
    assert env.step(STILL)[4]["status"] == "ongoing"


def test_an_unreachable_pose_is_an_error_status(make_unrendered) -> None:
    unreachable = [3.0, 0.0, 0.5, np.pi, 0.0, 0.0, 1.0]
    env = make_unrendered("PickXtimes", "train", 8, "ee_pose")
    env.reset()
    observation, _, terminated, _, info = env.step(unreachable)
    assert (observation, terminated, info["status"]) == ({}, True, "error")
    assert "IK failed" in info["error_message"]


def test_a_motion_that_cannot_be_planned_is_an_error_status(
    make_unrendered, monkeypatch: pytest.MonkeyPatch
) -> None:
    env = make_unrendered("PickXtimes", "train", 8, "waypoint")
    env.reset()

    def fail(*_: Any) -> None:
        raise PlanningError("no way")

    monkeypatch.setattr(type(env._run.demonstrator), "move_to", fail)
    observation, _, terminated, _, info = env.step([0.0, 0.0, 0.3, np.pi, 0.0, 0.0, 1.0])
    assert (observation, terminated, info["exception_type"]) == (None, True, "PlanningError")


def test_one_unplanned_video_motion_does_not_stop_the_video(
    make_unrendered, monkeypatch: pytest.MonkeyPatch
) -> None:
    env = make_unrendered("VideoUnmask", "train", 4)

    def fail(*_: Any) -> None:
        raise PlanningError("no way")

    monkeypatch.setattr("mme_vla.envs.robomme.robot.control.RobotControl.hold", fail)
    observation, info = env.reset()
    assert len(observation["joint_state_list"]) == 1
    assert info["status"] == "ongoing"


def test_a_closed_or_unstarted_environment_says_so(make_unrendered) -> None:
    env = make_unrendered()
    with pytest.raises(UserError, match="call reset"):
        env.step(STILL)
    env.close()
    env.close()
    for use in (env.reset, lambda: env.step(STILL), env.render):
        with pytest.raises(UserError, match="closed"):
            use()


# Making -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"task": "PickXTimes"}, "Did you mean 'PickXtimes'"),
        ({"task": "PickXtimes", "split": "eval"}, "Unknown split"),
        ({"task": "PickXtimes", "episode": 50}, "expected 0 to 49"),
        ({"task": "PickXtimes", "action_space": "joint"}, "Unknown action space"),
        ({"task": "PickXtimes", "difficulty": "easy"}, "needs a seed"),
        ({"task": "PickXtimes", "seed": 1, "difficulty": "tough"}, "Unknown difficulty"),
        ({"task": "PickXtimes", "max_steps": 0, "render": False}, "positive integer"),
    ],
)
def test_unknown_names_are_refused_with_what_exists(arguments: dict[str, Any], words: str) -> None:
    with pytest.raises(UserError, match=words):
        make_env(**arguments)


def test_what_an_observation_holds_is_yes_or_no() -> None:
    with pytest.raises(UserError, match="front_depth is 'yes'; expected True or False"):
        Include(front_depth="yes")  # type: ignore[arg-type]


def test_a_missing_simulator_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(make, "find_spec", lambda name: None)
    with pytest.raises(UserError, match="uv sync --inexact --extra sim"):
        make_env("PickXtimes", render=False)


SUMMARY = "GPU: llvmpipe (LLVM 15)\n  Supported: {}\n  Present:   0\n"


@pytest.mark.parametrize(
    ("summary", "mesa", "words"),
    [
        (None, 25, "cannot render"),
        (SUMMARY.format(0), 25, "new enough"),
        (SUMMARY.format(1), 22, "too old"),
    ],
)
def test_missing_or_old_vulkan_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, summary: str | None, mesa: int, words: str
) -> None:
    def describe() -> str:
        if summary is None:
            raise RuntimeError("failed to find a rendering device")
        return summary

    def device(name: str) -> Any:
        raise RuntimeError(f'failed to find device "{name}"')

    fake = SimpleNamespace(render=SimpleNamespace(get_device_summary=describe), Device=device)
    monkeypatch.setitem(sys.modules, "sapien", fake)  # type: ignore[arg-type]
    monkeypatch.setattr(rendering, "mesa_version", lambda: mesa)
    monkeypatch.setattr(rendering, "_find_backend", rendering._find_backend.__wrapped__)
    with pytest.raises(UserError, match=f"{words}[\\s\\S]*install_vulkan.sh"):
        rendering.render_backend()


# Parts --------------------------------------------------------------------------------------------


def test_angles_exceed_half_a_rotation() -> None:
    from scipy.spatial.transform import Rotation

    track = AngleTrack()
    yaws = np.linspace(3.0, 7.0, 30)
    quaternions = [
        Rotation.from_euler("xyz", [np.pi, 0, yaw]).as_quat(scalar_first=True) for yaw in yaws
    ]
    angles = np.array([track.follow(q * (-1) ** k) for k, q in enumerate(quaternions)])
    np.testing.assert_allclose(np.diff(angles[:, 2]), np.diff(yaws), atol=1e-6)
    assert np.abs(np.diff(angles[:, :2])).max() < 7
    assert abs(AngleTrack().follow(quaternions[-1])[2]) <= np.pi


def test_the_front_camera_is_the_official_one() -> None:
    expected = [
        [0, 1, 0, 0],
        [0.894427, 0, -0.447214, -0.089443],
        [-0.447214, 0, -0.894427, 0.491935],
    ]
    np.testing.assert_allclose(front_extrinsic(), expected, atol=2e-6)
    np.testing.assert_allclose(project(np.array([0.0, 0.0, -0.2])), [128, 128], atol=1e-4)
    assert project(np.array([0.0, 0.1, 0.0]))[1] > 128


class _Thing:
    def __init__(self, *ids: int) -> None:
        self.segmentation_ids = list(ids)


def test_a_text_is_grounded_once_its_objects_are_visible() -> None:
    segmentation = np.zeros((256, 256), np.int16)
    segmentation[10:13, 20:24] = 5
    assert centroid(segmentation, [5]) == (11, 21)
    assert centroid(segmentation, [6]) is None
    assert ground("at <> to <>", [_Thing(5), _Thing(6)], segmentation) is None  # type: ignore[list-item]
    assert ground("at <>", [_Thing(5), _Thing(6)], segmentation) == "at <11, 21>"  # type: ignore[list-item]
    with pytest.raises(ValueError, match="2 places for 1"):
        ground("at <> to <>", [_Thing(5)], segmentation)  # type: ignore[list-item]
    subtask: Any = SimpleNamespace(text="pick", grounded_text="pick at <>", targets=[_Thing(5)])
    empty = np.zeros_like(segmentation)
    retrying, once = Grounding(), Grounding(retry=False)
    texts = [retrying.update(subtask, lambda p=p: p) for p in (empty, segmentation, empty)]
    assert texts == ["pick", "pick at <11, 21>", "pick at <11, 21>"]
    assert [once.update(subtask, lambda p=p: p) for p in (empty, segmentation)] == ["pick", "pick"]
