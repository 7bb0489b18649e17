"""VideoPlaceButton and VideoPlaceOrder: layout, what the video shows, the last swap, success and failure."""

import numpy as np
import pytest

pytest.importorskip("mani_skill", reason="the simulation needs the extra 'sim'")

from helpers.env_tasks import (
    COLOURS,
    go_to,
    least_distance,
    read_button,
    read_cube,
    read_disc,
    steps_of_demonstration,
    wait,
)
from mme_vla.envs.scene.placement import Draws, Region
from mme_vla.envs.scene.things import distance_xy
from mme_vla.envs.tasks.families.video_place import VideoPlace
from mme_vla.envs.tasks.video_place_button import VideoPlaceButton
from mme_vla.envs.tasks.video_place_order import VideoPlaceOrder

NEAR, FAR = np.array([0.049, 0, 0]), np.array([0.051, 0, 0])
TABLE = Region((0, 0), 0.2)
PICK, PLACE = "pick up the cube", "place the cube onto the correct target"
AFTER = [PICK, "drop the cube onto table", "static", "static", "NO RECORD", PICK, PLACE]


@pytest.fixture(params=[(VideoPlaceOrder, 1), (VideoPlaceButton, 2)], ids=["order", "button"])
def env(request: pytest.FixtureRequest, build_task) -> VideoPlace:
    """Either task; the rules of the execution are the same."""
    return build_task(*request.param, "hard")


def read_scene(stream: Draws, env: VideoPlace, targets: int) -> None:
    """Read from a stream everything that both tasks draw alike, and compare."""
    read_disc(stream, Region((-0.1, 0), 0.1), env.spot)
    read_button(stream, env.button, (0.1, 0), (0.05, 0.3))
    count = 1 if env.difficulty == "easy" else 3
    assert [cube.colour for cube in env.cubes] == [COLOURS[i] for i in stream.permutation(3)][:count]
    for cube in env.cubes:
        read_cube(stream, TABLE, cube)
    assert len(env.targets) == targets
    for target in env.targets:
        read_disc(stream, TABLE, target)
    assert env.cube is env.cubes[stream.integer(0, len(env.cubes))]
    swapped = stream.permutation(targets)[:2] if env.difficulty == "hard" else []
    assert env._swapped == [env.targets[i] for i in swapped]


def keeps_apart(env: VideoPlace) -> bool:
    """Whether things keep the gap; a cube counts as a line only where its box happens to stand on end."""
    spot, button, cubes, targets = env.spot, env.button, env.cubes, env.targets
    pairs = [(targets, spot, 0.06 + spot.radius), (targets, button, 0.05625 + 0.06), (cubes, button, 0.05625 + 0.04)]
    pairs += [(targets, cube, 0.06) for cube in cubes]
    return (
        all(distance_xy(a.position, b.position) >= gap for things, b, gap in pairs for a in things)
        and least_distance(targets) >= 0.04 + 0.02 + 0.04
        and least_distance(cubes) >= 0.04
        and all(target.radius == 0.04 for target in targets)
    )


@pytest.mark.parametrize(("difficulty", "targets"), [("easy", 3), ("medium", 4), ("hard", 4)])
@pytest.mark.parametrize("seed", [2, 6])
def test_button_everything_comes_from_the_stream_in_order(build_task, seed, difficulty, targets):
    env, stream = build_task(VideoPlaceButton, seed, difficulty), Draws(seed)
    read_scene(stream, env, targets)
    assert env.before == (stream.uniform() < 0.5)
    assert env.spot.radius == 0.06 and env.spot.position[2] == pytest.approx(-0.05)
    assert keeps_apart(env)
    (first, second), steps = env.targets[:2], env.progress.subtasks
    video = [PICK, "drop the cube onto target", "press the button", PICK, "drop the cube onto target"]
    assert [step.text for step in steps] == video + AFTER
    assert (steps[1].targets, steps[4].targets) == ([first], [second])
    assert env.goal_target is (first if env.before else second) and steps[-1].targets == [env.goal_target]


@pytest.mark.parametrize("difficulty", ["easy", "medium", "hard"])
@pytest.mark.parametrize("seed", [6, 10])
def test_order_everything_comes_from_the_stream_in_order(build_task, seed, difficulty):
    env, stream = build_task(VideoPlaceOrder, seed, difficulty), Draws(seed)
    read_scene(stream, env, targets=4)
    visits = stream.integer(2, 5)
    assert env.visited == [env.targets[i] for i in stream.permutation(4)[:visits]] and 2 <= len(env.visited) <= 4
    assert env.rank == stream.integer(1, visits + 1) and 1 <= env.rank <= visits
    assert env.spot.radius == 0.1 and env.spot.position == pytest.approx([-0.1, 0, -0.05])
    assert keeps_apart(env)
    steps = env.progress.subtasks
    video = [PICK, "drop the cube onto target"] * visits
    video.insert(2 * stream.integer(0, visits) + 2, "press the button")
    assert [step.text for step in steps] == video + AFTER
    assert [step.targets[0] for step in steps if step.text == "drop the cube onto target"] == env.visited
    assert env.goal_target is env.visited[env.rank - 1] and steps[-1].targets == [env.goal_target]


def test_two_targets_change_places_at_the_end_of_a_hard_video(env):
    env.progress.index = len(env.progress.subtasks) - 4
    start = {target: target.position for target in env.targets}
    wait(env)  # the swap begins in the step after the one in which the stage was seen
    a, b = env._swapped
    wait(env, 26)
    aside = [distance_xy(target.position, (start[a] + start[b]) / 2) for target in (a, b)]
    assert aside == pytest.approx([0.1, 0.1], abs=1e-3)
    wait(env, 25)
    for target in env.targets:
        assert target.position == pytest.approx(start[{a: b, b: a}.get(target, target)], abs=1e-5)
    assert wait(env, 10) == (False, False) and env.progress.displayed.text == "NO RECORD"


def test_the_cube_on_the_right_target_is_success(env, hand):
    go_to(env, PICK)
    assert hand.carry(env.cube) == (False, False) and env.progress.current.text == PLACE
    assert hand.carry(env.cube, over=env.goal_target) == (False, False)
    assert hand.release() == (False, False)  # beside every target
    hand.carry(env.cube)
    assert hand.release(env.goal_target.position + NEAR) == (True, False)


def test_the_cube_on_another_target_fails(env, hand):
    go_to(env, PLACE)
    other = next(target for target in env.targets if target is not env.goal_target)
    assert hand.carry(env.cube, over=other, z=0.03) == (False, False)  # not let go
    assert hand.release(other.position + FAR) == (False, False)
    hand.carry(env.cube)
    assert hand.release(other.position + NEAR) == (False, True)
    hand.carry(env.cube)
    assert hand.release(env.goal_target.position) == (True, False)  # judged anew at each step


def test_another_cube_picked_up_fails_instead_of_the_cube_only(env, hand):
    other = next(cube for cube in env.cubes if cube is not env.cube)
    go_to(env, PICK)
    assert hand.carry(other) == (False, True)
    assert hand.release() == (False, False)
    go_to(env, PLACE)
    assert hand.carry(other) == (False, False)


def test_a_demonstration_ends_in_success(build_task):
    env = build_task(VideoPlaceButton, 10000, "easy")
    assert steps_of_demonstration(env) is not None
    assert distance_xy(env.cube.position, env.goal_target.position) < 0.05
