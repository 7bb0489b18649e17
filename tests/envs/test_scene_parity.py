"""The official episodes at hand, replayed: same words, same image, same success, in every action space.

`MME_VLA_ROBOMME_H5` names another folder of `record_dataset_<Task>.h5` files; every episode in it is replayed.
"""

import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

pytest.importorskip("mani_skill", reason="needs the simulator: uv sync --inexact --extra sim")

from mme_vla.data.hdf5 import EpisodeRef, find_files, list_episodes
from mme_vla.envs import make_env
from mme_vla.envs.make import make_task
from mme_vla.envs.observations import RenderRequest
from mme_vla.envs.recording.recorder import RecordedStep, Recorder
from mme_vla.envs.subtasks import COMPLETED, NO_RECORD

FOLDER = Path(
    os.environ.get("MME_VLA_ROBOMME_H5") or Path(__file__).resolve().parents[3] / "shared" / "robomme_h5"
).expanduser()
REFS = list_episodes(find_files([FOLDER])) if FOLDER.is_dir() else []
RECOVERY = ("z", "z", "z", "xy", "xy", "xy")  # of train episodes 0 to 5
SPACES = ("joint_angle", "ee_pose", "waypoint", "multi_choice")
STATES = 1e-3
"""Differences allowed in states along an episode: rad, metres."""
PIXELS = 1.0
"""Mean absolute difference allowed between the first images, of 255."""
PIXELS_ALONG = 0.5
"""The same along an episode."""
MOST_PICTURES = 12


@pytest.fixture(scope="module", params=REFS or [None], ids=lambda ref: f"{ref.task}-{ref.index}" if ref else "none")
def episode(request: pytest.FixtureRequest) -> Iterator["Episode"]:
    if request.param is None:
        pytest.skip(f"no official episodes: {FOLDER} is absent (set MME_VLA_ROBOMME_H5)")
    with h5py.File(request.param.file) as file:
        yield Episode(request.param, file[request.param.group])


class Episode:
    """What a file says of one demonstration."""

    def __init__(self, ref: EpisodeRef, group: Any) -> None:
        self.ref, self._group = ref, group
        self.length = sum(name.startswith("timestep_") for name in group)
        self.execution = next(k for k in range(self.length) if not self.at(k, "info/is_video_demo"))
        recovery = RECOVERY[ref.index] if ref.index < len(RECOVERY) else None
        seed, difficulty = int(group["setup/seed"][()]), text(group["setup/difficulty"][()])
        self.scene: dict[str, Any] = {"seed": seed, "difficulty": difficulty, "recovery": recovery}
        self.options = json.loads(group["setup/available_multi_choices"][()])
        self.goals = [text(goal) for goal in group["setup/task_goal"][()]]

    def at(self, step: int, key: str) -> Any:
        return self._group[f"timestep_{step}/{key}"][()]

    def image_steps(self, view: str, most: int) -> list[int]:
        """Steps with an image of their own, spread over the episode; small files link others to the one before."""
        paths = [f"timestep_{k}/obs/{view}" for k in range(self.length)]
        places = [h5py.h5o.get_info(self._group[path].id).addr for path in paths]
        changes = [k for k in range(self.length) if k == 0 or places[k] != places[k - 1]]
        return [changes[i] for i in np.linspace(0, len(changes) - 1, min(most, len(changes))).astype(int)]

    def texts(self, key: str) -> list[str]:
        """The different texts in the order they appear, each once in a row."""
        every = [text(self.at(k, f"info/{key}")) for k in range(self.length)]
        return [now for i, now in enumerate(every) if i == 0 or now != every[i - 1]]

    def actions(self, space: str) -> list[Any]:
        """What to do in an action space from the first execution frame on."""
        steps = range(self.execution, self.length)
        if space == "multi_choice":
            choices = [
                text(self.at(k, "action/choice_action")) for k in steps if self.at(k, "info/is_subgoal_boundary")
            ]
            return [choice for choice in map(json.loads, choices) if choice["choice"]]
        key = {"joint_angle": "joint_action", "ee_pose": "eef_action", "waypoint": "waypoint_action"}[space]
        actions = [self.at(k, f"action/{key}") for k in steps]
        if space != "waypoint":
            return actions
        named = [action for action in actions if not np.isnan(action).any()]
        return [a for i, a in enumerate(named) if i == 0 or not np.array_equal(a, named[i - 1])]


def text(value: Any) -> str:
    return value.decode() if isinstance(value, bytes) else str(value)


def test_the_goal_and_the_sub_tasks_have_the_recorded_words(episode: Episode) -> None:
    env = make_task(episode.ref.task, render=False, **episode.scene)
    env.reset()
    assert env.goals()[0] == episode.goals[0]
    # A sub-task that follows one of the same words does not show in the file.
    words = [s.text for s in env.progress.subtasks if s.text != NO_RECORD] + [COMPLETED]
    assert [w for i, w in enumerate(words) if i == 0 or w != words[i - 1]] == episode.texts("simple_subgoal")
    env.close()


@pytest.mark.parametrize("space", SPACES)
def test_replaying_the_execution_succeeds(episode: Episode, space: str) -> None:
    included = {"include_wrist_camera_extrinsic": True, "include_available_multi_choices": True}
    env = make_env(episode.ref.task, action_space=space, render=False, max_steps=5000, **episode.scene, **included)
    env.task.recording = space == "joint_angle"  # drops are judged as when the episode was recorded
    visible: list[tuple[str, bool]] = []
    env.on_frame = lambda frame, info, in_video: visible.append((info["simple_subgoal_online"], in_video))
    observation, info = env.reset()
    video = range(episode.execution)
    assert info["task_goal"] == episode.goals and info["available_multi_choices"] == episode.options
    official = [text(episode.at(k, "info/simple_subgoal_online")) for k in video]
    # A frame whose recorded text is none has the text of the demonstrated sub-task here.
    assert [now if word != NO_RECORD else word for (now, _), word in zip(visible, official, strict=False)] == official
    assert [in_video for _, in_video in visible] == [True] * len(official) + [False]
    for k, joints in zip(video, observation["joint_state_list"][:-1], strict=True):
        np.testing.assert_allclose(joints, episode.at(k, "obs/joint_state"), atol=1e-5)
    for k, action in enumerate(episode.actions(space), episode.execution):
        observation, _, terminated, _, info = env.step(action)
        if space == "joint_angle":
            for key in ("joint_state", "eef_state", "gripper_state", "wrist_camera_extrinsic"):
                (actual,) = observation[f"{key}_list"]
                np.testing.assert_allclose(actual, episode.at(k, f"obs/{key}"), atol=STATES, err_msg=key)
            assert info["simple_subgoal_online"] == text(episode.at(k, "info/simple_subgoal_online"))
        if bool(terminated):
            break
    env.close()
    assert info["status"] == "success", info.get("error_message")


@pytest.mark.usefixtures("renderer")
def test_images_along_the_replay_are_the_recorded_ones(episode: Episode) -> None:
    steps_of = {view: episode.image_steps(view, MOST_PICTURES) for view in ("front_rgb", "wrist_rgb")}
    # The list that an episode begins with ends with a frame that no step was stored for.
    numbers = {view: frozenset(k + (k >= episode.execution) for k in steps) for view, steps in steps_of.items()}
    env = make_env(episode.ref.task, max_steps=5000, **episode.scene)
    # An image takes as long as dozens of steps.
    env.render_request = RenderRequest(
        {"front": numbers["front_rgb"], "wrist": numbers["wrist_rgb"]}, now=(), grounded=False
    )
    observation, _ = env.reset()
    assert len(observation["front_rgb_list"]) == episode.execution + 1
    views = {view: observation[f"{view}_list"][:-1] for view in steps_of}
    for action in episode.actions("joint_angle"):
        observation, _, terminated, _, _ = env.step(action)
        for view, images in views.items():
            images += observation[f"{view}_list"]
        if bool(terminated):
            break
    env.close()
    for view, images in views.items():
        steps = [k for k in steps_of[view] if k < len(images)]
        assert len(steps) >= 0.8 * len(steps_of[view]), "the replay ends long before the recording does"
        for k in steps:
            difference = np.abs(images[k].astype(int) - episode.at(k, f"obs/{view}").astype(int)).mean()
            assert difference < PIXELS_ALONG, f"{view} of step {k} differs by {difference:.2f} of 255 on average"


def test_a_local_demonstration_is_stored_as_the_official_one(episode: Episode) -> None:
    env = make_task(episode.ref.task, render=False, **episode.scene)
    recorded = Recorder(env, render=False).record()
    env.close()
    if len(recorded.frames) != episode.length:
        pytest.skip(f"this demonstration has {len(recorded.frames)} steps here and {episode.length} in the file")
    steps = list(enumerate(recorded.frames))
    for name in ("simple_subgoal", "simple_subgoal_online"):
        assert [s.info[name] for _, s in steps] == [text(episode.at(k, f"info/{name}")) for k, _ in steps]
    for name in ("is_video_demo", "is_subgoal_boundary", "is_completed"):
        assert [bool(s.info[name]) for _, s in steps] == [bool(episode.at(k, f"info/{name}")) for k, _ in steps]
    for k, s in steps:
        local, official = (
            json.loads(text(a)) for a in (s.action["choice_action"], episode.at(k, "action/choice_action"))
        )
        assert local.get("choice") == official.get("choice")
        # A place that the robot has touched may round to the next pixel.
        np.testing.assert_allclose(local.get("point") or 0, official.get("point") or 0, atol=1)
    # Contacts of a press amplify rounding: the arm rests a little differently after it.
    tolerance = 2e-2 if any("button" in s.info["simple_subgoal"] for _, s in steps) else 1e-4
    for name, atol in (("joint_action", tolerance), ("eef_action", tolerance), ("waypoint_action", 1e-4)):
        actual = np.stack([s.action[name] for _, s in steps])
        official = np.stack([episode.at(k, f"action/{name}") for k, _ in steps])
        np.testing.assert_allclose(actual, official, atol=atol, err_msg=name)
    for name in ("joint_state", "eef_state", "gripper_state"):
        actual = np.stack([s.obs[name] for _, s in steps])
        official = np.stack([episode.at(k, f"obs/{name}") for k, _ in steps])
        np.testing.assert_allclose(actual, official, atol=max(tolerance, 5e-3), err_msg=name)


class FirstStepError(Exception):
    """The first stored step has been seen."""


@pytest.mark.usefixtures("renderer")
def test_the_first_image_is_the_recorded_one(episode: Episode) -> None:
    env = make_task(episode.ref.task, render=True, **episode.scene)
    steps: list[RecordedStep] = []

    def stop(step: RecordedStep) -> None:
        steps.append(step)
        raise FirstStepError

    with pytest.raises(FirstStepError):
        Recorder(env, on_step=stop).record()
    env.close()
    assert steps[0].info["grounded_subgoal_online"] == text(episode.at(0, "info/grounded_subgoal_online"))
    for view in ("front_rgb", "wrist_rgb", "front_depth", "wrist_depth"):
        assert steps[0].obs[view].shape == episode.at(0, f"obs/{view}").shape
        difference = np.abs(steps[0].obs[view].astype(int) - episode.at(0, f"obs/{view}").astype(int)).mean()
        assert difference < PIXELS, f"{view} differs by {difference:.2f} of 255 on average"
