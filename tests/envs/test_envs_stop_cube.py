"""StopCube: the cube's way, when stopping it counts, and everything that fails."""

from collections.abc import Iterator

import numpy as np
import pytest

pytest.importorskip("mani_skill", reason="the simulation needs the extra 'sim'")

from helpers.env_cubes import Flags, read_button
from helpers.env_unmask import make, push_down, texts, wait
from mme_vla.envs.robot.demonstrator import Demonstrator
from mme_vla.envs.scene.placement import Draws
from mme_vla.envs.scene.things import distance_xy
from mme_vla.envs.tasks.stop_cube import StopCube


def a_seed(interval: int, visit: int) -> int:
    """A seed whose cube takes `interval` steps for a pass and is to be stopped on its `visit`th one."""
    for seed in range(1000):
        stream = Draws(seed)
        stream.integer(27, 33)
        if ((60, 80, 120)[stream.integer(0, 3)], stream.integer(2, 6)) == (interval, visit):
            return seed
    raise AssertionError


@pytest.fixture(scope="module")
def second() -> Iterator[StopCube]:
    env = make(StopCube, a_seed(60, 2), "easy")  # crossings at steps 30, 90, 150, ...
    yield env
    env.close()


@pytest.fixture
def prepared(second: StopCube, monkeypatch: pytest.MonkeyPatch) -> StopCube:
    """The arm counts as being above the button."""
    second.reset()
    monkeypatch.setattr("mme_vla.envs.tasks.stop_cube.hovering", lambda *_: True)
    return second


def stop_at(env: StopCube, step: int) -> Flags:
    """Press the button so that the cube stops at a step."""
    wait(env, step - env.steps_done)
    flags = push_down(env, env.button)
    assert env.stopped_at == step
    return flags


@pytest.mark.parametrize(("seed", "difficulty"), [(1, "easy"), (2, "medium"), (3, "hard"), (4, "easy"), (5, "hard")])
def test_everything_comes_from_the_stream_in_order(seed, difficulty):
    env = make(StopCube, seed, difficulty)
    stream = Draws(seed)
    read_button(stream, env.button, (-0.2, 0), (0.1, 0.4))
    x, y = stream.between(-0.1, 0.1), stream.between(-0.1, 0.1)
    np.testing.assert_allclose(env.target.position, [x, y, 0.01], atol=1e-6)
    assert list(env.cube.colour) == stream.uniforms(3).tolist()
    stream = Draws(seed)
    stream.integer(27, 33)
    assert env.interval == (60, 80, 120)[stream.integer(0, 3)] and env.visit == stream.integer(2, 6)
    angle = np.deg2rad(stream.between(-30, 30))
    start = [x + 0.3 * np.sin(angle), y - 0.3 * np.cos(angle), 0.01]
    np.testing.assert_allclose(env.cube.position, start, atol=1e-6)
    env.close()


def test_the_cube_goes_back_and_forth_five_times_and_then_rests(second):
    second.reset()
    start, target = second.cube.position, second.target.position
    end = 2 * target - start
    second.latch_failure, places = False, {0: start}
    for k in range(1, 320):
        wait(second)
        places[k] = second.cube.position
    for k, expected in {30: target, 60: end, 90: target, 120: start, 270: target, 300: end, 319: end}.items():
        np.testing.assert_allclose(places[k][:2], expected[:2], atol=1e-6)
    share = np.linalg.norm(places[15] - start) / np.linalg.norm(end - start)
    assert share == pytest.approx(3 * 0.25**2 - 2 * 0.25**3, abs=1e-5)


@pytest.mark.parametrize("step", [87, 90, 93])
def test_stopped_near_the_target_on_the_right_crossing_is_success(prepared, step):
    assert stop_at(prepared, step) == (True, False)
    place = prepared.cube.position
    assert distance_xy(place, prepared.target.position) <= 0.06
    assert wait(prepared, 40) == (True, False) and (prepared.cube.position == place).all()


@pytest.mark.parametrize("step", [85, 95])
def test_stopped_off_the_target_fails_and_stays_failed(prepared, step):
    assert stop_at(prepared, step) == (False, True)
    prepared.button.restore()
    assert wait(prepared) == (False, True)


@pytest.mark.parametrize("step", [30, 31])
def test_stopped_on_an_earlier_crossing_fails(prepared, step):
    assert stop_at(prepared, step) == (False, True)
    assert distance_xy(prepared.cube.position, prepared.target.position) <= 0.06


def test_not_stopped_before_the_stay_is_over_fails(prepared):
    assert wait(prepared, 120) == (False, False)
    assert wait(prepared) == (False, True)


def test_stopped_in_time_but_not_announced_is_not_yet_success(second):
    second.reset()
    assert stop_at(second, 90) == (False, False) and second.progress.index == 0


@pytest.mark.parametrize(
    ("interval", "visit", "steps"),
    [(60, 2, [60]), (80, 2, [90]), (60, 4, [100, 180]), (120, 3, [100, 200, 270]),
     (120, 5, [100, 200, 300, 400, 500, 510])],
)  # fmt: skip
def test_waiting_is_cut_at_every_100th_step_and_ends_before_the_crossing(second, monkeypatch, interval, visit, steps):
    monkeypatch.setattr(second, "interval", interval)
    monkeypatch.setattr(second, "visit", visit)
    assert second.checkpoints() == steps


def test_texts_goals_and_choices(second):
    hover = "move to the top of the button"
    press = "press the button to stop the cube on the target"
    assert texts(second) == [
        (f"{hover} to prepare", f"{hover} at <> to prepare", "a"),
        ("remain static", "remain static", "b"),
        (press, f"{press} at <>", "c"),
    ]
    assert second.progress.subtasks[0].targets == [second.button]
    assert second.progress.subtasks[2].targets == [second.target]
    assert second.goals() == [
        "press the button to stop the cube just as it reaches the target for the second time",
        "press the button to stop the cube exactly at the target on its second visit",
    ]
    assert [option.needs_point for option in second.choices()] == [False] * 3


def test_choosing_to_wait_leads_to_the_next_checkpoint(second):
    second.reset()
    demo = Demonstrator(second, lambda action: second.step(np.asarray(action, np.float32)))
    second.choices()[1].run(demo, None)
    assert second.steps_done == 60  # whole gripper motions of six steps
