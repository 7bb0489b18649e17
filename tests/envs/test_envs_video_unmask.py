"""VideoUnmask: layout, covering, success and failure, and the official episodes replayed."""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mani_skill", reason="the simulation needs the extra 'sim'")

from helpers.env_scenes import replay, setup
from helpers.env_unmask import lift, make, names, skip_place, texts, under, wait, yaw_of
from mme_vla.envs.scene.motions import COVER_STEPS
from mme_vla.envs.scene.placement import CONTAINER_HALF, TRIALS, Draws, Region
from mme_vla.envs.tasks.video_unmask import VideoUnmask

OFFICIAL = [("robomme_h5", 4, "easy"), ("robomme_h5_full", 6, "medium")]


@pytest.fixture(scope="module")
def hard() -> Iterator[VideoUnmask]:
    env = make(VideoUnmask, 6300, "hard")
    yield env
    env.close()


@pytest.mark.parametrize(
    ("seed", "difficulty", "counts"),
    [(1, "easy", {3}), (2, "easy", {3}), (3, "medium", {5}), (4, "medium", {5}), (5, "hard", {4, 5, 6})],
)
def test_containers_stand_apart_where_the_stream_puts_them(seed, difficulty, counts):
    env = make(VideoUnmask, seed, difficulty)
    stream = Draws(seed)
    for container in env.containers:
        assert skip_place(stream, Region((0, 0), 0.2), container) == pytest.approx(yaw_of(container), abs=1e-6)
    if difficulty == "hard":  # one more found no place
        for _ in range(TRIALS):
            Region((0, 0), 0.2).place(stream, CONTAINER_HALF)
    assert len(env.containers) in counts and env.colours == names(stream)
    places = np.array([container.initial_pose.p[:2] for container in env.containers])
    assert np.abs(places).max() <= 0.2 - CONTAINER_HALF
    distances = np.linalg.norm(places[:, None] - places, axis=-1)[np.triu_indices(len(places), 1)]
    assert distances.min() > 0.0675
    env.close()


def test_cubes_lie_open_for_half_of_the_video_and_are_covered_then(hard):
    hard.reset()
    cubes = [thing for thing in hard.things if thing not in hard.containers]
    wait(hard, 32)
    assert min(container.position[0] for container in hard.containers) > 9
    wait(hard, 1)
    assert max(container.position[0] for container in hard.containers) < 0.2
    wait(hard, 10)
    assert under(cubes, hard.containers[:3]) and [cube.colour for cube in cubes] == hard.colours


def test_the_video_lasts_64_steps_without_motion_and_nothing_fails_in_it(hard):
    hard.reset()
    wait(hard, 40)
    assert lift(hard, hard.containers[3]) == (False, False)
    hard.containers[3].restore()
    wait(hard, COVER_STEPS - 42)
    assert hard.progress.index == 0
    wait(hard)
    assert hard.progress.index == 1


def test_the_first_container_then_the_second_one_is_success(hard):
    hard.reset()
    first, second = hard.containers[:2]
    wait(hard, COVER_STEPS)
    assert lift(hard, first) == (False, False) and hard.progress.index == 2
    wait(hard)
    assert hard.progress.index == 2  # still up
    first.restore()
    assert wait(hard) == (False, False) and hard.progress.index == 3
    assert lift(hard, second) == (True, False)
    assert wait(hard) == (True, False)


def test_a_container_is_not_put_down_while_it_is_grasped(hard, monkeypatch):
    hard.reset()
    wait(hard, COVER_STEPS)
    lift(hard, hard.containers[0])
    hard.containers[0].restore()
    monkeypatch.setattr(hard, "is_grasping", lambda thing: thing is hard.containers[0])
    wait(hard)
    assert hard.progress.index == 2


@pytest.mark.parametrize("stage", [1, 2, 3])
def test_lifting_another_container_fails_at_every_later_stage(hard, stage):
    hard.reset()
    wait(hard, COVER_STEPS)
    if stage > 1:
        lift(hard, hard.containers[0])
    if stage > 2:
        hard.containers[0].restore()
        wait(hard)
    assert hard.progress.index == stage
    assert lift(hard, hard.containers[0 if stage == 3 else 2]) == (False, True)


def test_texts_and_goals(hard):
    first, second, _ = hard.colours
    assert texts(hard) == [
        ("static", "static", ""),
        (f"pick up the container that hides the {first} cube",
         f"pick up the container at <> that hides the {first} cube", "a"),
        ("put down the container", "put down the container", "b"),
        (f"pick up the container that hides the {second} cube",
         f"pick up the container at <> that hides the {second} cube", "a"),
    ]  # fmt: skip
    assert [step.targets[0] for step in hard.progress.subtasks if step.pick] == hard.containers[:2]
    assert hard.goals() == [
        f"watch the video carefully, then pick up the container hiding the {first} cube, "
        f"finally pick up another container hiding the {second} cube"
    ]


@pytest.mark.parametrize(("folder", "episode", "difficulty"), OFFICIAL)
def test_the_recorded_actions_have_the_recorded_effect(shared: Path, folder, episode, difficulty):
    folder = shared / folder
    env = make(VideoUnmask, 6000 + 100 * episode, difficulty, recovery="xy")
    assert [goal.decode() for goal in setup(folder, "VideoUnmask", episode, "task_goal")] == env.goals()
    options = json.loads(setup(folder, "VideoUnmask", episode, "available_multi_choices"))
    assert options == [
        {"label": option.label, "action": option.action, "need_parameter": option.needs_point}
        for option in env.choices()
    ]
    env.recording = True
    assert replay(env, folder, episode).max() < 1e-4
    env.close()
