"""Twins of the test scenes: the needed fact is in view, a tally agrees with the judge, and nothing
else is changed.
"""

from collections import Counter
from typing import Any

import numpy as np
import pytest

pytest.importorskip("mani_skill", reason="the simulation needs the extra 'sim'")

from sapien import physx

from helpers.env_tasks import Hand, built, wait
from mme_vla.embodiment.robomme import SIDE
from mme_vla.envs import make_env
from mme_vla.envs.grounding import project
from mme_vla.envs.metadata import TASK_NAMES
from mme_vla.envs.robomme.robot.demonstrator import arc
from mme_vla.envs.robomme.scene.motions import TALLY_RADIUS, TALLY_X

TALLIED = ("BinFill", "PickXtimes", "SwingXtimes", "StopCube", "VideoRepick")
FOREMOST = 0.28
"""Nothing is nearer to the front: StopCube's cube at the end of a line as far forward and as
slanted as any; metres.
"""


def lying(env: Any) -> list[tuple[str, float, np.ndarray]]:
    """Colour, radius and place of the discs that are to be seen when the next step begins."""
    env._show_cues()
    discs = [(cue.colour, cue.radius, disc.position) for disc, cue in env._cues]
    return [disc for disc in discs if disc[2][2] > 0]


def tallied(env: Any) -> list[np.ndarray]:
    return [place for _, radius, place in lying(env) if radius == TALLY_RADIUS]


@pytest.mark.slow
@pytest.mark.parametrize("task", TASK_NAMES)
def test_in_a_twin_the_fact_is_in_view_and_nothing_else_is_changed(task: str) -> None:
    original, twin = built(task), built(task, in_view=True)
    for env in (original, twin):
        wait(env, 40)
    for one, other in zip(original.things, twin.things, strict=True):
        assert one.name == other.name and np.array_equal(
            [*one.pose.p, *one.pose.q], [*other.pose.p, *other.pose.q]
        )
    assert [step.text for step in original.progress.subtasks] == [
        step.text for step in twin.progress.subtasks
    ]
    assert np.array_equal(original.qpos, twin.qpos) and not original._cues
    in_words = task in ("MoveCube", "PatternLock", "InsertPeg")
    assert (original.goals() != twin.goals()) == in_words and (twin._cues or in_words)
    for disc, cue in twin._cues:
        body = disc.entity._objs[0].find_component_by_type(physx.PhysxRigidDynamicComponent)
        assert not body.collision_shapes, "a disc can be touched"
        place = cue.place()
        assert (
            disc.position[2] < 0 if place is None else np.allclose(disc.position, place, atol=1e-3)
        )
    original.close()
    twin.close()


@pytest.mark.parametrize("task", TALLIED)
def test_a_tally_lies_in_the_image_below_all_that_the_task_is_about(task: str) -> None:
    env = built(task, in_view=True)
    rows, columns = np.array([project(place) for place in tallied(env)]).T
    assert rows.max() < SIDE - 20 and columns.min() > 20 and columns.max() < SIDE - 20
    assert max(thing.initial_pose.p[0] for thing in env.things) < FOREMOST
    assert rows.min() - 10 > project(np.array([FOREMOST, 0, 0]))[0]
    env.close()


@pytest.mark.parametrize("task", ["PickXtimes", "SwingXtimes", "VideoRepick"])
def test_a_tally_is_what_the_pointer_has_still_to_come_to(task: str) -> None:
    env = built(task, in_view=True)
    words = {
        "PickXtimes": "place ",
        "SwingXtimes": "move to the top",
        "VideoRepick": "put it down",
    }[task]
    texts = [step.text for step in env.progress.subtasks]
    tallies = []
    for env.progress.index in range(len(texts) + 1):
        assert len(tallied(env)) == sum(
            text.startswith(words) for text in texts[env.progress.index :]
        )
        tallies.append([round(float(place[1] / 0.045), 1) for place in tallied(env)])
    assert (
        len(tallies[0]) == env.repetitions * (2 if task == "SwingXtimes" else 1)
        and tallies[-1] == []
    )
    if task == "SwingXtimes":  # where the right one has fewer, the left target is next
        sides = [(sum(y < 0 for y in ys), sum(y > 0 for y in ys)) for ys in tallies[1:4]]
        assert sides == [(env.repetitions, env.repetitions), (env.repetitions - 1, env.repetitions),
                         (env.repetitions - 1, env.repetitions - 1)]  # fmt: skip
    env.close()


def test_a_disc_goes_when_the_judge_has_counted_the_repetition(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    env = built("PickXtimes", episode=3, in_view=True)
    hand = Hand(env, monkeypatch)
    left = [len(tallied(env))]
    for place in (None, env.target.position):  # put down beside the target it does not count
        hand.carry(env.cube)
        hand.release(place)
        left.append(len(tallied(env)))
    assert (
        left == [env.repetitions, env.repetitions, env.repetitions - 1] and env.progress.index == 2
    )
    env.reset()
    assert len(tallied(env)) == env.repetitions
    env.close()


def test_the_bins_tally_has_the_colours_of_the_cubes_that_it_lacks() -> None:
    env = built("BinFill", episode=3, in_view=True)
    assert len(env.goal) > 1
    for colour in env.goal.elements():
        assert Counter(disc[0] for disc in lying(env)) == env.goal - env.filled
        env.filled[colour] += 1
    env.filled["red"] += 1  # one too many is no disc less than none
    assert lying(env) == []
    env.close()


def test_the_last_disc_lies_there_during_the_pass_in_which_to_stop_the_cube() -> None:
    env = built("StopCube", in_view=True)
    last = []
    for k in range(0, env.deadline + 1, 10):
        env._elapsed_steps[:] = k
        last.append(len(tallied(env)) == 1)
        assert last[-1] == (env.deadline - env.interval <= k < env.deadline)
    assert any(last)
    env.stopped_at = env.deadline - 1  # stopped in time, whatever the time is now
    assert len(tallied(env)) == 1
    env.close()


def test_the_next_move_of_the_route_is_highlighted_and_none_during_the_video() -> None:
    env = built("RouteStick", episode=3, in_view=True)
    moves, steps = len(env.directions), len(env.progress.subtasks)
    for env.progress.index in range(steps + 1):
        move = env.progress.index - (steps - moves)
        discs = [place[:2] for _, _, place in lying(env)]
        if not 0 <= move < moves:
            assert discs == []
            continue
        start, end = (disc.position for disc in env.path[move : move + 2])
        way = arc(start, end, env.directions[move])[:, :2]
        assert np.allclose(discs[0], end[:2]) and len(discs) > 3
        assert all(np.linalg.norm(way - disc, axis=1).min() < 1e-6 for disc in discs)
    env.close()


def test_a_tally_stands_on_the_tables_edge_from_the_first_frame_on() -> None:
    env: Any = make_env("PickXtimes", "twin", 1, render=False)
    env.reset()
    assert [float(place[0]) for place in tallied(env.task)] == pytest.approx(
        [TALLY_X] * env.task.repetitions
    )
    env.close()
