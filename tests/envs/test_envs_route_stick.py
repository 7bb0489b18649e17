"""RouteStick: the sampled route, the sense of each turn, and everything that fails."""

from itertools import pairwise

import pytest

pytest.importorskip("mani_skill", reason="the simulation needs the extra 'sim'")

from helpers.env_tasks import Ear, Flags, Tip, wait
from mme_vla.envs.robomme.robot.demonstrator import arc
from mme_vla.envs.robomme.scene.objects import Disc
from mme_vla.envs.robomme.scene.placement import Draws
from mme_vla.envs.robomme.tasks.route_stick import RouteStick

MOVES = {"easy": ((2, 3), False), "medium": ((4, 5), False), "hard": ((4, 7), True)}
"""How many, and whether they may turn back."""
OTHER = {"clockwise": "counterclockwise", "counterclockwise": "clockwise"}

SCENE = (RouteStick, 4, "medium")


def circle(tip: Tip, start: Disc, goal: Disc, direction: str) -> Flags:
    """Follow the demonstrator's arc; the flags at its end."""
    return [tip.put(point) for point in arc(start.position, goal.position, direction)][-1]


def follow(env: RouteStick, tip: Tip) -> list[Flags]:
    """Do every move as it is to be done."""
    return [
        circle(tip, *leg, direction)
        for leg, direction in zip(pairwise(env.path), env.directions, strict=True)
    ]


def watch(env: RouteStick, tip: Tip) -> None:
    """Go through the video and back to its first disc."""
    tip.put(env.path[0])
    assert follow(env, tip) == [(False, False)] * len(env.directions)
    tip.back_to_start(env.path[0])
    assert env.progress.index == len(env.directions) + 3


def test_obstacles_are_thin_along_the_row(env):
    obstacles = [thing for thing in env.things if thing.name.startswith("obstacle")]
    shapes = [thing.entity._bodies[0].collision_shapes[0] for thing in obstacles]
    # the row is their y
    assert [shape.half_size for shape in shapes] == [pytest.approx([0.03, 0.015, 0.05])] * 4


@pytest.mark.parametrize("difficulty", ["easy", "medium", "hard"])
def test_routes_go_to_neighbours_and_may_return_only_where_they_may(env, monkeypatch, difficulty):
    for name in ("difficulty", "path", "directions"):
        monkeypatch.setattr(env, name, difficulty)
    counts, returns, (moves, may_return) = set(), 0, MOVES[difficulty]
    for seed in range(100):
        env._draw_route(Draws(seed))
        route = [env.discs.index(disc) for disc in env.path]
        assert (
            all(abs(a - b) == 1 for a, b in pairwise(route))
            and len(env.directions) == len(route) - 1
        )
        returns += sum(
            a == c and 0 < b < 4 for a, b, c in zip(route, route[1:], route[2:], strict=False)
        )
        counts.add(len(env.directions))
    assert counts == set(range(moves[0], moves[1] + 1)) and (returns > 0) == may_return


def test_the_same_route_again_is_success(env, tip):
    watch(env, tip)
    assert follow(env, tip) == [(False, False)] * (len(env.directions) - 1) + [(True, False)]


def test_a_target_is_reached_within_three_centimetres_and_below_fifteen(env, tip):
    tip.put(env.path[0], aside=(0.02, 0))
    assert env.progress.index == 0  # the first approach is exact
    tip.put(env.path[0])
    way = list(arc(env.path[0].position, env.path[1].position, env.directions[0]))
    for point in way[:30]:
        tip.put(point)
    for z, aside in ((0.151, 0), (0.149, 0.031)):
        tip.put(env.path[1], z=z, aside=(aside, 0))
        assert env.progress.index == 1
    assert (
        tip.put(env.path[1], z=0.149, aside=(0.029, 0)) == (False, False)
        and env.progress.index == 2
    )


@pytest.mark.parametrize("stage", ["video", "execution"])
@pytest.mark.parametrize("move", [0, 1])
def test_the_wrong_way_around_fails_at_the_target_and_stays_failed(env, tip, stage, move):
    watch(env, tip) if stage == "execution" else tip.put(env.path[0])
    legs = list(zip(pairwise(env.path), env.directions, strict=True))
    for leg, direction in legs[:move]:
        assert circle(tip, *leg, direction) == (False, False)
    (start, goal), direction = legs[move]
    assert [tip.put(point) for point in arc(start.position, goal.position, OTHER[direction])[:30]][
        -1
    ] == (False, False)
    assert tip.put(goal) == (False, True)
    assert circle(tip, start, goal, direction) == (False, True)


def test_every_disc_not_due_fails_even_one_hidden_under_an_obstacle(env, monkeypatch):
    for place in set(env.all_discs) - set(env.path[:2]):
        env.reset()
        tip = Tip(env, monkeypatch)
        watch(env, tip)
        assert tip.put(place, z=0.101) == tip.put(place, aside=(0.011, 0)) == (False, False)
        assert tip.put(place, z=0.099, aside=(0.009, 0)) == tip.put((0.4, 0.4)) == (False, True)


def test_a_target_is_highlighted_for_40_steps_after_the_tip_was_near(env, tip):
    disc, mark = env.path[0], env._marks[env.discs.index(env.path[0])]
    tip.put(disc, aside=(0.029, 0))
    wait(env)
    tip.put((0.4, 0.4))
    wait(env, 40)
    assert mark.position == pytest.approx(disc.position - [0, 0, 0.01])
    wait(env)
    assert mark.position[2] < -5


def test_an_option_goes_to_the_neighbour_on_its_side(env, tip):
    order = [
        (side, direction)
        for direction in ("clockwise", "counterclockwise")
        for side in ("left", "right")
    ]
    for here in range(5):
        tip.put(env.discs[here], aside=(0.02, 0.02))
        for option, (side, direction) in zip(env.choices(), order, strict=True):
            ear, there = Ear(), here + (1 if side == "left" else -1)
            option.run(ear, None)
            assert ear.calls == ([(env.discs[there], direction)] if 0 <= there < 5 else [])
