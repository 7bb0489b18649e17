"""The four Unmask tasks: covering, swaps, buttons, success and failure, and official episodes
replayed.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("mani_skill", reason="the simulation needs the extra 'sim'")

from helpers.env_scenes import replay, setup
from helpers.env_tasks import lift, make, push_down, released, under, wait
from mme_vla.envs.robomme.scene.motions import COVER_STEPS
from mme_vla.envs.robomme.scene.things import Thing, distance_xy
from mme_vla.envs.robomme.tasks.button_unmask import ButtonUnmask
from mme_vla.envs.robomme.tasks.button_unmask_swap import ButtonUnmaskSwap
from mme_vla.envs.robomme.tasks.video_unmask import VideoUnmask
from mme_vla.envs.robomme.tasks.video_unmask_swap import VideoUnmaskSwap

SEEDS = {VideoUnmask: 6300, ButtonUnmask: 8300, VideoUnmaskSwap: 5300, ButtonUnmaskSwap: 7300}
STILL, SWAPPING = (VideoUnmask, ButtonUnmask), (VideoUnmaskSwap, ButtonUnmaskSwap)


@pytest.fixture(params=SEEDS, ids=lambda task: task.__name__)
def env(build_task, request) -> Any:
    return build_task(request.param, SEEDS[request.param], "hard")


@pytest.fixture(params=SWAPPING, ids=lambda task: task.__name__)
def swap(build_task, request) -> Any:
    return build_task(request.param, SEEDS[request.param], "hard")


def hiding(env) -> list[Thing]:
    """The containers over the cubes that the goal names, in its order, then the third one."""
    return env.over_cubes if isinstance(env, SWAPPING) else env.containers[:3]


def buttons(env) -> list[Thing]:
    return {
        ButtonUnmask: lambda: [env.button],
        ButtonUnmaskSwap: lambda: [env.right, env.left],
    }.get(type(env), list)()


def go_to_picks(env) -> int:
    """Let the video end, or press the buttons; the index of the first pick."""
    wait(env, env.swapped_after + 10 if isinstance(env, SWAPPING) else COVER_STEPS)
    for button in buttons(env):
        assert push_down(env, button) == (False, False)
    assert env.progress.current.pick
    return env.progress.index


# Covering and swaps -------------------------------------------------------------------------------


@pytest.mark.parametrize("task", STILL)
def test_cubes_lie_open_for_half_of_the_time_and_are_covered_then(build_task, task):
    env = build_task(task, SEEDS[task], "hard")
    cubes = [thing for thing in env.things if thing not in [*env.containers, *buttons(env)]]
    assert env.progress.current.video == (task is VideoUnmask)
    wait(env, 32)
    assert min(container.position[0] for container in env.containers) > 9
    wait(env, 1)
    assert max(container.position[0] for container in env.containers) < 0.2
    wait(env, 10)
    assert under(cubes, env.containers[:3]) and [cube.colour for cube in cubes] == env.colours


def test_the_video_lasts_until_the_last_motion_has_ended(build_task):
    for task, length in ((VideoUnmask, COVER_STEPS), (VideoUnmaskSwap, 64 + 50 * 3)):
        env = build_task(task, SEEDS[task], "hard")
        wait(env, length - 1)
        assert env.progress.index == 0
        wait(env)
        assert env.progress.index == 1


def test_two_containers_change_places_at_a_time_and_the_others_stand_still(build_task):
    env = build_task(VideoUnmaskSwap, 5300, "hard")
    wait(env, 65)
    for initiator, _ in env.swapped:
        start = {container: container.pose for container in env.containers}
        others = [c for c in env.containers if c is not initiator]
        nearest = min(others, key=lambda c: distance_xy(c.position, initiator.position))
        wait(env, 25)
        for container in set(others) - {nearest}:
            assert np.abs(container.position[:2] - start[container].p[:2]).max() < 2e-3
        middle = (start[initiator].p + start[nearest].p) / 2
        aside = [distance_xy(c.position, middle) for c in (initiator, nearest)]
        assert aside == pytest.approx([0.07, 0.07], abs=3e-3)
        wait(env, 25)
        for mine, other in ((initiator, nearest), (nearest, initiator)):
            assert np.abs(mine.position[:2] - start[other].p[:2]).max() < 6e-3
            assert abs(float(mine.pose.q @ start[other].q)) > 0.9999


def test_cubes_are_away_while_containers_move_and_lie_under_the_same_ones_then(swap):
    before = [container.initial_pose.p for container in swap.containers]
    wait(swap, 64)
    assert under(swap.cubes, swap.over_cubes)
    wait(swap, 1)
    assert min(cube.position[0] for cube in swap.cubes) > 9
    wait(swap, swap.swapped_after - 65)
    assert min(cube.position[0] for cube in swap.cubes) > 9
    wait(swap, 10)
    assert (
        under(swap.cubes, swap.over_cubes) and [cube.colour for cube in swap.cubes] == swap.colours
    )
    after = [container.position for container in swap.containers]
    # Each stands where one stood before.
    nearest = [
        min(range(len(before)), key=lambda i: distance_xy(before[i], place)) for place in after
    ]
    assert sorted(nearest) == list(range(len(before)))


# Buttons, success and failure ---------------------------------------------------------------------


@pytest.mark.parametrize("reverse", [False, True])
def test_buttons_may_be_pressed_in_either_order_but_both_must_be(build_task, reverse):
    env = build_task(ButtonUnmaskSwap, 7300, "hard")
    wait(env, 40)
    first, second = [env.left, env.right][:: -1 if reverse else 1]
    for button, index in ((first, 1), (first, 1), (second, 2)):
        push_down(env, button)
        assert env.progress.index == index
        released(env, button)
    env.reset()
    wait(env, 40)
    push_down(env, second)
    assert env.progress.index == 1


def test_a_reset_releases_the_button(build_task):
    env = build_task(ButtonUnmask, 8300, "hard")
    push_down(env, env.button)
    env.reset()
    assert env.button.depth == 0
    released(env, env.button)
    assert env.progress.index == 0


def test_both_containers_in_their_order_are_success(env):
    pick = go_to_picks(env)
    first, second = hiding(env)[:2]
    back = first.pose
    assert lift(env, first) == (False, False) and env.progress.index == pick + 1
    assert wait(env) == (False, False) and env.progress.index == pick + 1  # still up
    first.move_to(back)
    assert wait(env) == (False, False) and env.progress.index == pick + 2
    assert lift(env, second) == (True, False)
    assert wait(env) == (True, False)


@pytest.mark.parametrize("stage", [0, 1, 2])
def test_another_container_fails_at_every_stage_from_the_first_pick_on(env, stage):
    pick = go_to_picks(env)
    first, second, third = hiding(env)
    back = first.pose
    if stage:
        lift(env, first)
    if stage == 2:
        first.move_to(back)
        wait(env)
    assert env.progress.index == pick + stage
    wrong = (second, third, first)[stage]
    home = wrong.pose
    assert lift(env, wrong) == (False, True)
    wrong.move_to(home)
    assert wait(env) == (False, False)  # judged anew at each step


def test_a_container_lifted_before_the_picks_fails_only_if_it_is_still_up(env):
    wait(env, 40)
    wrong = env.containers[3] if isinstance(env, VideoUnmask) else env.containers[1]
    home = wrong.pose
    assert lift(env, wrong) == (False, False)
    wrong.move_to(home)
    go_to_picks(env)


def test_a_container_is_not_put_down_while_it_is_grasped(env, monkeypatch):
    pick = go_to_picks(env)
    first = hiding(env)[0]
    back = first.pose
    lift(env, first)
    first.move_to(back)
    monkeypatch.setattr(env, "is_grasping", lambda thing: thing is first)
    wait(env)
    assert env.progress.index == pick + 1


@pytest.mark.parametrize(
    ("folder", "episode", "difficulty"),
    [("robomme_h5", 4, "easy"), ("robomme_h5_full", 6, "medium")],
)
def test_the_recorded_actions_have_the_recorded_effect(shared: Path, folder, episode, difficulty):
    folder = shared / folder
    env = make(VideoUnmask, 6000 + 100 * episode, difficulty, recovery="xy")
    assert [
        goal.decode() for goal in setup(folder, "VideoUnmask", episode, "task_goal")
    ] == env.goals()
    assert json.loads(setup(folder, "VideoUnmask", episode, "available_multi_choices")) == [
        {"label": option.label, "action": option.action, "need_parameter": option.needs_point}
        for option in env.choices()
    ]
    env.recording = True
    assert replay(env, folder, episode).max() < 1e-4
    env.close()
