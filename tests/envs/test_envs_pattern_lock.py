"""PatternLock: the sampled path, what counts as visited, and everything that fails."""

import numpy as np
import pytest

pytest.importorskip("mani_skill", reason="the simulation needs the extra 'sim'")

from helpers.env_tasks import Ear, Tip, wait
from mme_vla.envs.robomme.scene.placement import Draws
from mme_vla.envs.robomme.tasks.pattern_lock import DIRECTIONS, PatternLock

WORDS = (
    "forward",
    "backward",
    "left",
    "right",
    "forward-left",
    "forward-right",
    "backward-left",
    "backward-right",
)
LENGTHS = {"easy": {2, 3, 4}, "medium": {3, 4, 5}, "hard": {4, 5, 6, 7, 8}}

SCENE = (PatternLock, 3, "hard")


def watch(env: PatternLock, tip: Tip) -> None:
    """Go through the video and back to its first disc."""
    assert [tip.put(disc) for disc in env.path] == [(False, False)] * len(env.path)
    tip.back_to_start(env.path[0])
    assert env.progress.index == len(env.path) + 2


@pytest.mark.parametrize(("difficulty", "n"), [("easy", 3), ("medium", 4), ("hard", 5)])
def test_paths_go_over_neighbours_and_have_the_lengths_of_the_difficulty(
    env, monkeypatch, difficulty, n
):
    monkeypatch.setattr(env, "difficulty", difficulty)
    paths = [env._draw_path(Draws(seed), n) for seed in range(60)]
    assert {len(path) for path in paths} == LENGTHS[difficulty]
    for path in paths:
        steps = np.abs(np.diff([divmod(node, n) for node in path], axis=0))
        assert len(set(path)) == len(path) and (steps.max(1) == 1).all()


def test_the_same_path_again_is_success(env, tip):
    watch(env, tip)
    results = [tip.put(disc) for disc in env.path]
    assert results == [(False, False)] * (len(env.path) - 1) + [(True, False)]


@pytest.mark.parametrize(
    ("aside", "z", "motion"), [(0.009, 0.099, 1), (0.011, 0.07, 0), (0, 0.101, 0)]
)
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
        assert tip.put(wrong[0], z=0.11) == (
            False,
            False,
        )  # judged anew: passing high above is no visit
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
        assert ear.calls == (
            [(env.discs[5 * row + column],)] if 0 <= row < 5 and 0 <= column < 5 else []
        )
