"""PatternLock: the grid, the sampled path, what counts as visited, and everything that fails."""

from collections.abc import Iterator

import numpy as np
import pytest

pytest.importorskip("mani_skill", reason="the simulation needs the extra 'sim'")

import torch

from helpers.env_tasks import Ear, Tip, wait
from mme_vla.envs.scene.placement import Draws
from mme_vla.envs.tasks.pattern_lock import DIRECTIONS, PatternLock

WORDS = ("forward", "backward", "left", "right", "forward-left", "forward-right", "backward-left", "backward-right")
LENGTHS = {"easy": {2, 3, 4}, "medium": {3, 4, 5}, "hard": {4, 5, 6, 7, 8}}

SCENE = (PatternLock, 3, "hard")


def read_path(seed: int, n: int, lengths: set[int]) -> list[int]:
    """The path by a search with a stack of what is still to be tried, from a fresh generator."""
    generator = torch.Generator().manual_seed(seed)

    def around(node: int) -> Iterator[int]:
        row, column = divmod(node, n)
        steps = [(-1, 0), (1, 0), (0, -1), (0, 1), (-1, -1), (-1, 1), (1, -1), (1, 1)]
        inside = [(row + r) * n + column + c for r, c in steps if 0 <= row + r < n and 0 <= column + c < n]
        return iter([inside[i] for i in torch.randperm(len(inside), generator=generator)])

    while True:
        start, goal = torch.randperm(n * n, generator=generator)[:2].tolist()
        path, visited, untried = [start], {start}, [around(start)]
        while path[-1] != goal:
            following = next((node for node in untried[-1] if node not in visited), None)
            if following is None:
                path.pop(), untried.pop()
                continue
            path.append(following), visited.add(following)
            if following != goal:
                untried.append(around(following))
        if len(path) in lengths:
            return path


def watch(env: PatternLock, tip: Tip) -> None:
    """Go through the video and back to its first disc."""
    assert [tip.put(disc) for disc in env.path] == [(False, False)] * len(env.path)
    tip.back_to_start(env.path[0])
    assert env.progress.index == len(env.path) + 2


@pytest.mark.parametrize(("difficulty", "n"), [("easy", 3), ("medium", 4), ("hard", 5)])
def test_the_grid_and_the_path_over_it(build_task, difficulty, n):
    env = build_task(PatternLock, 1, difficulty)
    line = (np.arange(n) - (n - 1) / 2) * 0.1
    places = [(-0.1 + x, y, 0.01) for x in line for y in line]
    np.testing.assert_allclose([disc.position for disc in env.discs], places, atol=1e-6)
    assert [env.discs.index(disc) for disc in env.path] == read_path(1, n, LENGTHS[difficulty])
    paths = [env._draw_path(Draws(seed), n) for seed in range(60)]
    assert paths == [read_path(seed, n, LENGTHS[difficulty]) for seed in range(60)]
    assert {len(path) for path in paths} == LENGTHS[difficulty]
    for path in paths:
        steps = np.abs(np.diff([divmod(node, n) for node in path], axis=0))
        assert len(set(path)) == len(path) and (steps.max(1) == 1).all()


def test_the_same_path_again_is_success(env, tip):
    watch(env, tip)
    results = [tip.put(disc) for disc in env.path]
    assert results == [(False, False)] * (len(env.path) - 1) + [(True, False)]


@pytest.mark.parametrize(("aside", "z", "motion"), [(0.009, 0.099, 1), (0.011, 0.07, 0), (0, 0.101, 0)])
def test_a_disc_is_visited_within_a_centimetre_and_below_ten(env, tip, aside, z, motion):
    tip.put(env.path[0], z=z, aside=(0, aside))
    assert env.progress.index == motion


@pytest.mark.parametrize("stage", ["video", "execution"])
def test_a_disc_that_is_not_due_fails_in_every_move(env, tip, stage):
    if stage == "execution":
        watch(env, tip)
    for previous, goal in zip(env.path, env.path[1:], strict=False):
        assert tip.put(previous) == (False, False)
        wrong = [disc for disc in env.discs if disc not in (previous, goal)]
        assert {tip.put(disc) for disc in wrong} == {(False, True)}
        assert tip.put(wrong[0], z=0.11) == (False, False)  # judged anew: passing high above is no visit
        tip.put(goal)


def test_a_detour_over_another_disc_is_no_success_at_the_end(env, tip):
    watch(env, tip)
    for disc in env.path[:-1]:
        tip.put(disc)
    tip.put(next(disc for disc in env.discs if disc not in env.path))
    assert tip.put(env.path[-1]) == (False, False) and env.progress.succeeded
    assert env.visited[-3] is env.path[-2]


def test_staying_over_a_disc_or_returning_to_it_counts_once(env, tip):
    watch(env, tip)
    for disc in env.path:
        for place in (disc, (0.4, 0.4), disc, disc):
            flags = tip.put(place)
    assert flags == (True, False) and env.visited == env.path


def test_a_reached_disc_is_highlighted_for_40_steps_after_the_stay(env, tip):
    disc = env.path[0]
    mark = env._marks[env.discs.index(disc)]
    tip.put(disc)
    wait(env)
    assert mark.position == pytest.approx(disc.position - [0, 0, 0.01])
    tip.put((0.4, 0.4))
    wait(env, 40)
    assert mark.position == pytest.approx(disc.position - [0, 0, 0.01])
    wait(env)
    assert mark.position[2] < -5


@pytest.mark.parametrize("here", [12, 0, 4, 20, 24])
def test_a_direction_means_the_neighbour_on_that_side(env, tip, here):
    tip.put(env.discs[here], aside=(0.01, -0.02))
    for option, word in zip(env.choices(), WORDS, strict=True):
        row, column = np.add(divmod(here, 5), DIRECTIONS[word])
        ear = Ear()
        option.run(ear, None)
        assert ear.calls == ([(env.discs[5 * row + column],)] if 0 <= row < 5 and 0 <= column < 5 else [])
