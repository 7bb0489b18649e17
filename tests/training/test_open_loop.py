"""Predicted against recorded actions: what the policy sees, the baselines, and the verdict."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from helpers.lerobot_tables import write_dataset
from helpers.rollout_fakes import quick_policy
from mme_vla import MMEPolicy, UserError, build_policy
from mme_vla.data.episodes import EpisodeSource
from mme_vla.data.recording import Recording
from mme_vla.embodiment import Embodiment
from mme_vla.testing.small import SMALL_VISION, small_policy, unit_stats
from mme_vla.training.open_loop import (
    LAST,
    MEAN,
    STILL,
    OpenLoop,
    error_lines,
    open_loop,
    plot_open_loop,
)
from mme_vla.training.order import seed_of

ABSOLUTE = """
name: absolute
cameras: {top: {}}
state: {width: 3}
action: {width: 3, horizon: 2, execute: 2}
"""


@pytest.fixture(scope="module")
def sample() -> EpisodeSource:
    return EpisodeSource("sample")


@pytest.fixture(scope="module")
def policy() -> MMEPolicy:
    policy = quick_policy("framesamp_modul", memory={"budget": 16}).eval()
    policy.require_processor().stats = unit_stats(policy.embodiment)
    return policy


def result_of(error: Any, still: float = 0.5, last: float = 0.2) -> OpenLoop:
    """Two chunks of three actions whose recorded numbers are 0, of a robot of two numbers."""
    recorded = np.zeros((2, 3, 2))
    return OpenLoop(
        title="episode 0",
        steps=np.array([0, 2]),
        predicted=recorded + np.array(error),
        recorded=recorded,
        valid=np.array([[True] * 3, [True, False, False]]),
        scale=np.array([1.0, 2.0]),
        baselines={STILL: np.full((2, 2), still), LAST: np.full((2, 2), last)},
        names=("arm", "gripper"),
        units=("rad", ""),
        execute=2,
    )


def test_policy_sees_the_episode_as_a_running_one(policy: MMEPolicy, sample: EpisodeSource) -> None:
    recording = Recording(sample, 0)
    result = open_loop(policy, recording, "episode 0", most=3, seed=5)
    episode = policy.start_episode(sample.goal(0), seed_of(5, "open loop"))
    chunks = []
    observed = 0
    start = int(sample.exec_starts[0])
    for step in result.steps.tolist():
        frames = np.arange(observed, step + 1)
        views = {name: sample.frames(0, frames, name) for name in ("front", "wrist")}
        episode.observe(views, sample.states(0, observed, step + 1), frames < start)
        observed = step + 1
        chunks.append(policy.act(episode))
    assert result.steps[0] == start and len(chunks) == 3
    np.testing.assert_array_equal(result.predicted, chunks)


def test_recorded_chunks_begin_where_the_policy_decides(
    policy: MMEPolicy, sample: EpisodeSource
) -> None:
    result = open_loop(policy, Recording(sample, 1, action_offset=1), "episode 1", most=2)
    for i, step in enumerate(result.steps.tolist()):
        chunk, known = sample.action_chunk(1, step, 20, 1)
        np.testing.assert_array_equal(result.recorded[i], chunk)
        np.testing.assert_array_equal(result.valid[i], known)


def test_without_a_limit_a_chunk_follows_each_executed_part(sample: EpisodeSource) -> None:
    steps = Recording(sample, 0).decisions(16, None)
    assert set(np.diff(steps)) == {16} and steps[-1] + 16 >= int(sample.lengths[0])


def test_baselines_repeat_the_state_the_last_action_and_the_mean(
    policy: MMEPolicy, sample: EpisodeSource
) -> None:
    result = open_loop(policy, Recording(sample, 0), "episode 0", most=4)
    later = int(result.steps[2])
    state, before = sample.states(0, later)[0], sample.actions(0, later - 1)[0]
    np.testing.assert_allclose(result.baselines[STILL][2][:7], state[:7])
    assert result.baselines[STILL][2][7] == before[7], "the gripper is not relative to the state"
    np.testing.assert_array_equal(result.baselines[LAST][2], before)
    # Of these statistics the mean difference to the state is 0.
    np.testing.assert_allclose(result.baselines[MEAN][2][:7], state[:7])


def test_robot_with_absolute_actions_has_baselines_and_a_verdict(tmp_path: Path) -> None:
    (tmp_path / "embodiment").mkdir()
    (tmp_path / "embodiment" / "absolute.yaml").write_text(ABSOLUTE)
    policy = build_policy(
        "pi05", config_dir=tmp_path, embodiment="absolute", backbone={"vision": SMALL_VISION}
    ).eval()
    robot = policy.embodiment
    policy.require_processor().stats = unit_stats(robot)
    source = EpisodeSource(write_dataset(tmp_path / "data"), robot=robot)
    result = open_loop(policy, Recording(source, 0), "episode 0")
    summary = result.summary()
    assert set(summary["baselines_normalised"]) == {LAST, MEAN}
    assert "mean_abs_error_holding_still" not in summary
    assert "baseline" in summary["verdict"]
    first = result.baselines
    np.testing.assert_array_equal(first[LAST][0], first[MEAN][0])


def test_errors_count_neither_padding_nor_what_is_not_executed() -> None:
    result = result_of([[1.0, 2.0], [1.0, 2.0], [5.0, 6.0]])
    np.testing.assert_allclose(result.error(result.predicted), [2.0, 3.0])
    np.testing.assert_allclose(result.error(result.predicted, 2), [1.0, 2.0])
    assert result.summary()["executed_error_normalised"] == [1.0, 1.0]


@pytest.mark.parametrize(
    ("error", "sentence"),
    [
        (
            [0.1, 0.1],
            "Better than every baseline in all 2 numbers: mean normalised error 0.075, against"
            " 0.150 of the last action.",
        ),
        (
            [0.0, 0.3],
            "Better than every baseline on average: mean normalised error 0.075, against 0.150 of"
            " the last action. 1 of 2 numbers are predicted worse: gripper.",
        ),
        (
            [0.5, 0.1],
            "No better than the best baseline: mean normalised error 0.275, against 0.150 of the"
            " last action. 1 of 2 numbers are predicted worse.",
        ),
    ],
)
def test_verdict_compares_with_the_best_baseline(error: list[float], sentence: str) -> None:
    assert result_of(error).verdict() == sentence
    still = replace(result_of(error, still=0.01), title="other")
    assert "holding still" in still.verdict()


def test_table_fits_a_terminal() -> None:
    result = replace(result_of([0.1, 12345.678]), names=("a name longer than the column", "b"))
    lines = error_lines(result.summary())
    assert len(lines) == 4 and max(map(len, lines)) <= 80
    assert lines[0].split() == ["error", "normalised", "executed", "still", "last"]
    assert lines[-1].split()[0] == "all"


def test_image_is_drawn_for_an_odd_number_of_panels(tmp_path: Path) -> None:
    result = result_of([0.1, 0.2])
    plot_open_loop(result, tmp_path / "two.png", "policy")
    with Image.open(tmp_path / "two.png") as image:
        assert image.width > 1000


def test_missing_subgoals_are_named(sample: EpisodeSource, tmp_path: Path) -> None:
    policy = quick_policy("simplesg").eval()
    source = EpisodeSource(
        write_dataset(tmp_path / "data"),
        robot=Embodiment.from_dict(
            {
                "name": "absolute",
                "cameras": {"top": None},
                "state": {"width": 3},
                "action": {"width": 3},
            }
        ),
    )
    with pytest.raises(UserError, match="reads simple_subgoal, and data has no such column"):
        open_loop(policy, Recording(source, 0), "episode 0")


def test_a_last_frame_that_no_action_follows_is_not_compared(policy: MMEPolicy) -> None:
    """With data.action_offset=1 its chunk has no recorded action, and the errors would be NaN."""
    source = EpisodeSource("sample")
    last = int(source.lengths[0]) - 1
    first = last - policy.embodiment.action.execute
    source.exec_starts[0] = first
    result = open_loop(policy, Recording(source, 0, 1), "two decisions")
    assert result.steps.tolist() == [first] and result.valid.any(1).all()
    source.exec_starts[0] = last
    with pytest.raises(UserError, match="no step at which this robot decides and an action"):
        open_loop(policy, Recording(source, 0, 1), "one frame")


def test_a_policy_with_past_views_sees_those_of_every_camera(sample: EpisodeSource) -> None:
    policy = small_policy("spacetime_modul", memory={"frames": 3, "stride": 5})
    policy.require_processor().stats = unit_stats(policy.embodiment)
    recording = Recording(sample, 3)
    steps = open_loop(policy, recording, "", 2).steps
    last = int(steps[-1])
    every_frame, required_alone = policy.start_episode(""), policy.start_episode("")
    recording.show(every_frame, 0, last + 1)
    required = policy.frames_read(steps, recording.exec_start)
    recording.show(required_alone, 0, last + 1, required)
    expected, past = every_frame.past, required_alone.past
    assert expected is not None and past is not None and past.mask.all()
    assert torch.equal(past.images, expected.images)
