"""The official episodes at hand, replayed: same words, same sub-tasks, same image, same success, in
every action space.

`MME_VLA_ROBOMME_H5` names another folder of `record_dataset_<Task>.h5` files; every episode in it
is replayed.
"""

import json
import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from itertools import groupby
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

pytest.importorskip("mani_skill", reason="needs the simulator: uv sync --inexact --extra sim")

from helpers.env_tasks import touches
from mme_vla.data.hdf5 import EpisodeRef, find_files, list_episodes
from mme_vla.envs import make_env
from mme_vla.envs.base import Hold
from mme_vla.envs.make import make_task
from mme_vla.envs.observations import Include, RenderRequest
from mme_vla.envs.robomme.recording.recorder import RecordedStep, Recorder
from mme_vla.envs.subtasks import COMPLETED, NO_RECORD

FOLDER = Path(
    os.environ.get("MME_VLA_ROBOMME_H5")
    or Path(__file__).resolve().parents[3] / "shared" / "robomme_h5"
).expanduser()
REFS = list_episodes(find_files([FOLDER])) if FOLDER.is_dir() else []
RECOVERY = ("z", "z", "z", "xy", "xy", "xy")  # of train episodes 0 to 5
SPACES = ("joint_angle", "ee_pose", "waypoint", "multi_choice")
BEFORE_CONTACT, AFTER_CONTACT, AFTER_CONTACT_STEPS = 1e-5, 2e-2, 10
"""Differences allowed in states (rad, metres), and in the step at which a sub-task of a video or of
a replay ends.

Until the robot first touches something, in the video or after it, only rounding differs: recorded
states are single precision. From then on contacts amplify what differs by less: the execution
begins one step after that of a recording, when objects have moved or settled for one step more, and
makers of CPUs compute contacts between boxes with different reciprocals (`rcpps`). Before the first
contact no step may differ.
"""
WAITING = {"StopCube": "remain static"}
"""Tasks whose demonstrations wait, and the text: no waypoint says so, and they are replayed at the
recorded times.
"""
PIXELS = 1.0
"""Mean absolute difference allowed between the first images, of 255."""
PIXELS_ALONG = 0.5
"""The same along an episode."""
MOST_PICTURES = 12


@pytest.fixture(
    scope="module",
    params=REFS or [None],
    ids=lambda ref: f"{ref.task}-{ref.index}" if ref else "none",
)
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
        """Steps with an image of their own, spread over the episode; small files link others to the
        one before.
        """
        paths = [f"timestep_{k}/obs/{view}" for k in range(self.length)]
        places = [h5py.h5o.get_info(self._group[path].id).addr for path in paths]
        changes = [k for k in range(self.length) if k == 0 or places[k] != places[k - 1]]
        return [
            changes[i]
            for i in np.linspace(0, len(changes) - 1, min(most, len(changes))).astype(int)
        ]

    def texts(self, key: str) -> list[str]:
        """The different texts in the order they appear, each once in a row."""
        return in_order(self.words(key, range(self.length)))

    def words(self, key: str, steps: Iterable[int]) -> list[str]:
        """The text of each of these steps."""
        return [text(self.at(k, f"info/{key}")) for k in steps]

    def actions(self, space: str) -> list[Any]:
        """What to do in an action space from the first execution frame on."""
        return [action for _, action in self.timed_actions(space)]

    def timed_actions(self, space: str) -> list[tuple[int, Any]]:
        """The same, each with the step of the recording at which it begins."""
        steps = range(self.execution, self.length)
        if space == "multi_choice":
            choices = [
                (k, json.loads(text(self.at(k, "action/choice_action"))))
                for k in steps
                if self.at(k, "info/is_subgoal_boundary")
            ]
            return [(k, choice) for k, choice in choices if choice["choice"]]
        key = {
            "joint_angle": "joint_action",
            "ee_pose": "eef_action",
            "waypoint": "waypoint_action",
        }[space]
        actions = [(k, self.at(k, f"action/{key}")) for k in steps]
        if space != "waypoint":
            return actions
        named = [(k, action) for k, action in actions if not np.isnan(action).any()]
        return [
            a for i, a in enumerate(named) if i == 0 or not np.array_equal(a[1], named[i - 1][1])
        ]


@dataclass(frozen=True)
class Displayed:
    """A frame of a replay: its text, whether it belongs to the video, and whether the robot touches
    something.
    """

    text: str
    in_video: bool
    touches: bool


def text(value: Any) -> str:
    return value.decode() if isinstance(value, bytes) else str(value)


def in_order(texts: Iterable[str]) -> list[str]:
    """Each text once in a row."""
    return [word for word, _ in groupby(texts)]


def first_contact(displayed: list[Displayed]) -> int:
    """The first frame in which the robot touches something; the number of frames where there is
    none.
    """
    return next((k for k, frame in enumerate(displayed) if frame.touches), len(displayed))


def ends(texts: list[str]) -> list[int]:
    """The steps before which the text changes."""
    return [k for k in range(1, len(texts)) if texts[k] != texts[k - 1]]


def test_the_goal_and_the_sub_tasks_have_the_recorded_words(episode: Episode) -> None:
    env = make_task(episode.ref.task, render=False, **episode.scene)
    env.reset()
    assert env.goals() == episode.goals
    words = [s.text for s in env.progress.subtasks if s.text != NO_RECORD] + [COMPLETED]
    env.close()
    recorded = episode.texts("simple_subgoal")
    wait = WAITING.get(episode.ref.task)
    if wait not in recorded:  # its time had passed when it began
        words = [word for word in words if word != wait]
    # A sub-task that follows one of the same words does not show in the file.
    assert in_order(words) == recorded


@pytest.mark.parametrize("space", SPACES)
def test_replaying_the_execution_succeeds(episode: Episode, space: str) -> None:
    include = Include(wrist_camera_extrinsic=True, available_multi_choices=True)
    env = make_env(
        episode.ref.task,
        action_space=space,
        render=False,
        max_steps=5000,
        **episode.scene,
        include=include,
    )
    # drops and waits are judged as when the episode was recorded
    env.task.recording = space == "joint_angle"
    displayed: list[Displayed] = []
    env.on_frame = lambda frame, info, in_video: displayed.append(
        Displayed(info["simple_subgoal_online"], in_video, touches(env.task))
    )
    observation, info = env.reset()
    assert info["task_goal"] == episode.goals and info["available_multi_choices"] == episode.options
    assert not displayed[-1].in_video
    check_video(episode, displayed[:-1], observation["joint_state_list"][:-1])
    start = len(displayed)
    for k, action in episode.timed_actions(space):
        waited = k - episode.execution - (env.steps_counted - 1)
        if space == "waypoint" and episode.ref.task in WAITING and waited > 0:
            env.step(Hold(waited))
        observation, _, terminated, _, info = env.step(action)
        if space == "joint_angle":
            check_states(episode, k, observation, touched=first_contact(displayed) < len(displayed))
        if bool(terminated):
            break
    env.close()
    assert info["status"] == "success", info.get("error_message")
    words = [frame.text for frame in displayed[start:]]
    recorded = episode.words("simple_subgoal_online", range(episode.execution, episode.length))
    assert in_order(words) == in_order(recorded)
    if space == "joint_angle":
        check_ends(words, recorded, first_contact(displayed) - start)


def check_video(episode: Episode, displayed: list[Displayed], states: list[np.ndarray]) -> None:
    """The video has the recorded frames, each with its text and its joint positions."""
    official = episode.words("simple_subgoal_online", range(episode.execution))
    contact = first_contact(displayed)
    assert all(frame.in_video for frame in displayed)
    words, announced = [frame.text for frame in displayed], list[str]()
    for word in official:
        # A frame whose recorded text is none goes on with the text of the sub-task that is
        # demonstrated.
        announced.append(word if word != NO_RECORD else announced[-1])
    assert in_order(words) == in_order(announced)
    check_ends(words, announced, contact)
    assert abs(len(displayed) - len(official)) <= (
        AFTER_CONTACT_STEPS if contact < len(displayed) else 0
    )
    for k in range(min(len(displayed), len(official))):
        tolerance = BEFORE_CONTACT if k < contact else AFTER_CONTACT
        np.testing.assert_allclose(
            states[k], episode.at(k, "obs/joint_state"), atol=tolerance, err_msg=f"video, {k}"
        )


def check_ends(words: list[str], recorded: list[str], contact: int) -> None:
    """Each sub-task but the last ends with the recorded step, after a contact nearly so."""
    for end, official in zip(ends(words), ends(recorded), strict=True):
        tolerance = 0 if end <= contact else AFTER_CONTACT_STEPS
        assert abs(end - official) <= tolerance, (
            f"a text begins at {end} instead of {official}; contact at {contact}"
        )


def check_states(episode: Episode, step: int, observation: dict[str, Any], touched: bool) -> None:
    """The state after an action is the recorded one."""
    tolerance = AFTER_CONTACT if touched else BEFORE_CONTACT
    for key in ("joint_state", "eef_state", "gripper_state", "wrist_camera_extrinsic"):
        (actual,) = observation[f"{key}_list"]
        official = episode.at(step, f"obs/{key}")
        np.testing.assert_allclose(
            actual, official, atol=tolerance, err_msg=f"{key} of step {step}"
        )


@pytest.mark.usefixtures("renderer")
def test_images_along_the_replay_are_the_recorded_ones(episode: Episode) -> None:
    steps_of = {
        view: episode.image_steps(view, MOST_PICTURES) for view in ("front_rgb", "wrist_rgb")
    }
    # The list that an episode begins with ends with a frame that no step was stored for.
    numbers = {
        view: frozenset(k + (k >= episode.execution) for k in steps)
        for view, steps in steps_of.items()
    }
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
        assert len(steps) >= 0.8 * len(steps_of[view]), (
            "the replay ends long before the recording does"
        )
        for k in steps:
            difference = np.abs(
                images[k].astype(int) - episode.at(k, f"obs/{view}").astype(int)
            ).mean()
            assert difference < PIXELS_ALONG, (
                f"{view} of step {k} differs by {difference:.2f} of 255 on average"
            )


def test_a_local_demonstration_is_stored_as_the_official_one(episode: Episode) -> None:
    env = make_task(episode.ref.task, render=False, **episode.scene)
    frames: list[RecordedStep] = []
    touching: list[bool] = []

    def keep(step: RecordedStep) -> None:
        frames.append(step)
        touching.append(touches(env))

    Recorder(env, render=False, on_step=keep).record()
    env.close()
    if len(frames) != episode.length:
        pytest.skip(
            f"this demonstration has {len(frames)} steps here and {episode.length} in the file"
        )
    steps = list(enumerate(frames))
    for name in ("simple_subgoal", "simple_subgoal_online"):
        assert [s.info[name] for _, s in steps] == [
            text(episode.at(k, f"info/{name}")) for k, _ in steps
        ]
    for name in ("is_video_demo", "is_subgoal_boundary", "is_completed"):
        assert [bool(s.info[name]) for _, s in steps] == [
            bool(episode.at(k, f"info/{name}")) for k, _ in steps
        ]
    for k, s in steps:
        local, official = (
            json.loads(text(a))
            for a in (s.action["choice_action"], episode.at(k, "action/choice_action"))
        )
        assert local.get("choice") == official.get("choice")
        # A place that the robot has touched may round to the next pixel.
        np.testing.assert_allclose(local.get("point") or 0, official.get("point") or 0, atol=1)
    contact = next((k for k, now in enumerate(touching) if now), len(touching))
    for part, name in (
        ("action", "joint_action"), ("action", "eef_action"), ("action", "waypoint_action"),
        ("obs", "joint_state"), ("obs", "eef_state"), ("obs", "gripper_state"),
    ):  # fmt: skip
        for k, s in steps:
            tolerance = BEFORE_CONTACT if k < contact else AFTER_CONTACT
            actual, official = getattr(s, part)[name], episode.at(k, f"{part}/{name}")
            np.testing.assert_allclose(
                actual, official, atol=tolerance, err_msg=f"{name} of step {k}"
            )


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
    assert steps[0].info["grounded_subgoal_online"] == text(
        episode.at(0, "info/grounded_subgoal_online")
    )
    for view in ("front_rgb", "wrist_rgb", "front_depth", "wrist_depth"):
        assert steps[0].obs[view].shape == episode.at(0, f"obs/{view}").shape
        difference = np.abs(
            steps[0].obs[view].astype(int) - episode.at(0, f"obs/{view}").astype(int)
        ).mean()
        assert difference < PIXELS, f"{view} differs by {difference:.2f} of 255 on average"
