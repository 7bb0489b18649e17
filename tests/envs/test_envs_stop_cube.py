"""StopCube: the cube's way, when stopping it counts, and everything that fails."""

import numpy as np
import pytest

pytest.importorskip("mani_skill", reason="the simulation needs the extra 'sim'")

from helpers.env_tasks import Flags, push_down, wait
from mme_vla.envs.robomme.robot.demonstrator import Demonstrator
from mme_vla.envs.robomme.scene.placement import Draws
from mme_vla.envs.robomme.scene.things import distance_xy
from mme_vla.envs.robomme.tasks.stop_cube import StopCube


def a_seed(interval: int, visit: int) -> int:
    """A seed whose cube takes `interval` steps for a pass and is to be stopped on its `visit`th
    one.
    """
    for seed in range(1000):
        stream = Draws(seed)
        stream.integer(27, 33)
        if ((60, 80, 120)[stream.integer(0, 3)], stream.integer(2, 6)) == (interval, visit):
            return seed
    raise AssertionError


SCENE = (StopCube, a_seed(60, 2), "easy")  # crossings at steps 30, 90, 150, ...


@pytest.fixture
def prepared(env: StopCube, monkeypatch: pytest.MonkeyPatch) -> StopCube:
    """The arm counts as being above the button."""
    monkeypatch.setattr("mme_vla.envs.robomme.tasks.stop_cube.hovering", lambda *_: True)
    return env


def stop_at(env: StopCube, step: int) -> Flags:
    """Press the button so that the cube stops at a step."""
    wait(env, step - env.steps_done)
    flags = push_down(env, env.button)
    assert env.stopped_at == step
    return flags


def test_the_cube_goes_back_and_forth_five_times_and_then_rests(env):
    start, target = env.cube.position, env.target.position
    end = 2 * target - start
    env.latch_failure, places = False, {0: start}
    for k in range(1, 320):
        wait(env)
        places[k] = env.cube.position
    for k, expected in {
        30: target,
        60: end,
        90: target,
        120: start,
        270: target,
        300: end,
        319: end,
    }.items():
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


def test_stopped_in_time_but_not_announced_is_not_yet_success(env):
    assert stop_at(env, 90) == (False, False) and env.progress.index == 0


@pytest.mark.parametrize(
    ("interval", "visit", "steps"),
    [(60, 2, [60]), (80, 2, [90]), (60, 4, [100, 180]), (120, 3, [100, 200, 270]),
     (120, 5, [100, 200, 300, 400, 500, 510])],
)  # fmt: skip
def test_waiting_is_cut_at_every_100th_step_and_ends_before_the_crossing(
    env, monkeypatch, interval, visit, steps
):
    monkeypatch.setattr(env, "interval", interval)
    monkeypatch.setattr(env, "visit", visit)
    assert env.checkpoints() == steps


def test_choosing_to_wait_leads_to_the_next_checkpoint(env):
    demo = Demonstrator(env, lambda action: env.step(np.asarray(action, np.float32)))
    env.choices()[1].run(demo, None)
    assert env.steps_done == 60  # whole gripper motions of six steps
