"""Random places: the order of the draws, what counts as too near, and what happens when there is no
room.
"""

from collections.abc import Iterator

import numpy as np
import pytest
import torch

pytest.importorskip("mani_skill", reason="the simulation needs the extra 'sim'")

from helpers.env_scenes import Scene
from mme_vla.envs.robomme.scene.articulated import build_button
from mme_vla.envs.robomme.scene.objects import (
    H,
    build_board,
    build_container,
    build_cube,
    build_disc,
)
from mme_vla.envs.robomme.scene.placement import (
    CONTAINER_HALF,
    TRIALS,
    Box2D,
    Draws,
    Region,
    SceneError,
    board_boxes,
    button_box,
    draw_container,
    draw_cube,
    draw_disc,
    obstacle_box,
)

REGION = Region((-0.1, 0.0), 0.2)
EVERYWHERE = Box2D.aligned((0, 0), (1, 1))


@pytest.fixture(scope="module")
def scene() -> Iterator[Scene]:
    def fill(env: Scene) -> None:
        for i in range(12):
            env.add(build_cube(env, f"cube_{i}", "red", (0.1 * i, 0.5), 0.5 * i))
        env.add(build_disc(env, "target", 0.04, 0.005, "purple", (-0.1, 0.0)))
        env.add(build_button(env, (-0.2, 0.1)))
        env.add(build_board(env, (0.1, -0.1), 0.3))
        env.add(build_container(env, "container", (-0.1, 0.0), 0.4))

    env = Scene(fill)
    yield env
    env.close()


def named(scene: Scene, name: str):
    return next(thing for thing in scene.things if thing.name == name)


def stream(seed: int, n: int) -> list[float]:
    generator = torch.Generator().manual_seed(seed)
    return [torch.rand(1, generator=generator).item() for _ in range(n)]


def test_boxes_that_only_touch_intersect_and_boxes_apart_in_one_direction_do_not():
    box = Box2D.aligned((0, 0), (1, 1))
    assert box.intersects(Box2D.aligned((2, 0), (1, 1)))
    assert not box.intersects(Box2D.aligned((2.001, 0), (1, 1)))
    corner = Box2D.square(np.array([2.3, 0.0]), 1.0, np.pi / 4)  # its corner reaches to 0.886
    assert box.intersects(corner) and not box.intersects(
        Box2D.square(np.array([2.5, 0.0]), 1.0, np.pi / 4)
    )


def test_distance_to_a_box_is_zero_inside_and_counts_from_the_nearest_corner():
    box = Box2D.aligned((1, 1), (0.5, 0.25))
    assert box.distance(np.array([1.2, 0.9])) == 0
    assert box.distance(np.array([1.8, 1.65])) == pytest.approx(0.5)
    assert box.grown(0.1).distance(np.array([1.8, 1.65])) == pytest.approx(np.hypot(0.2, 0.3))


def test_a_box_with_one_upright_axis_is_a_line():
    line = Box2D(np.zeros(2), np.array([[0.0, 0.0], [0.0, 1.0]]), np.array([1.0, 1.0]))
    assert line.distance(np.array([0.3, 0.5])) == pytest.approx(0.3)
    assert line.intersects(Box2D.aligned((0.9, 0), (1, 1)))
    assert not line.intersects(Box2D.aligned((1.1, 0), (1, 1)))


def test_a_cubes_obstacle_is_its_square_or_a_line_through_its_middle(scene):
    boxes = [obstacle_box(named(scene, f"cube_{i}")) for i in range(12)]
    assert all(np.allclose(box.half, H, atol=1e-6) for box in boxes)
    lengths = np.array([np.linalg.norm(box.axes, axis=1) for box in boxes])
    assert set(lengths.round(6).ravel()) == {0.0, 1.0}
    assert [box.centre for box in boxes] == [pytest.approx([0.1 * i, 0.5]) for i in range(12)]


def test_a_cubes_full_square_is_turned_with_it(scene):
    for i in range(12):
        box = obstacle_box(named(scene, f"cube_{i}"))
        upright = np.linalg.norm(box.axes, axis=1) == 0
        angles = np.arctan2(box.axes[~upright, 1], box.axes[~upright, 0])
        assert np.sin(2 * (angles - 0.5 * i)) == pytest.approx(np.zeros(len(angles)), abs=1e-5)


def test_buttons_and_boards_have_separate_obstacles(scene):
    button = button_box(named(scene, "button"))
    assert button.half == pytest.approx([0.05625, 0.05625]) and button.centre == pytest.approx(
        [-0.2, 0.1]
    )
    strips = board_boxes(named(scene, "board"))
    assert [strip.centre for strip in strips[:2]] == [
        pytest.approx([0.1, -0.055]),
        pytest.approx([0.1, -0.145]),
    ]
    assert all((strip.axes == np.eye(2)).all() for strip in strips)


def test_what_cannot_be_touched_is_no_obstacle(scene):
    with pytest.raises(SceneError, match="target has no collision shape"):
        obstacle_box(named(scene, "target"))
    draw_cube(Draws(3), REGION, [named(scene, "target")])


@pytest.mark.parametrize(
    ("draw", "per_trial"),
    [
        (lambda draws: draw_cube(draws, REGION, [EVERYWHERE]), 3),
        (lambda draws: draw_disc(draws, REGION, 0.04, [EVERYWHERE]), 2),
        (lambda draws: draw_container(draws, REGION, [EVERYWHERE]), 2),
    ],
)
def test_without_free_space_the_draws_of_every_trial_are_used_up(draw, per_trial):
    draws = Draws(7)
    with pytest.raises(SceneError, match=r"^A (cube|target|container) finds no place\.$"):
        draw(draws)
    assert draws.uniform() == stream(7, TRIALS * per_trial + 1)[-1]


def test_a_target_keeps_clear_of_targets_as_circles_and_of_objects_as_boxes(scene):
    other, container = named(scene, "target"), named(scene, "container")
    for seed in range(40):
        xy = draw_disc(Draws(seed), REGION, 0.04, [other, container], gap=0.02)
        assert np.linalg.norm(xy - other.position[:2]) >= 0.1
        assert obstacle_box(container).distance(xy) >= 0.06
        assert np.abs(xy - REGION.centre).max() <= 0.16


def test_a_container_counts_the_gap_twice_for_objects_but_once_for_ready_made_boxes(scene):
    container = named(scene, "container")
    box = obstacle_box(container)
    from_thing = [draw_container(Draws(s), REGION, [container], gap=0.04)[0] for s in range(200)]
    from_box = [draw_container(Draws(s), REGION, [box], gap=0.04)[0] for s in range(200)]
    assert min(box.grown(0.04).distance(xy) for xy in from_thing) >= CONTAINER_HALF + 0.04
    assert (
        CONTAINER_HALF + 0.04 <= min(box.distance(xy) for xy in from_box) < CONTAINER_HALF + 0.045
    )
