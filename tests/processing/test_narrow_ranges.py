"""Statistics against the extremes of what they normalise, and quantiles that one value far away
does not move.
"""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf

from helpers import REPOSITORY
from helpers.lerobot_tables import custom_robot, write_dataset
from mme_vla.data.episodes import EpisodeSource
from mme_vla.data.lerobot_files import SAMPLE
from mme_vla.data.statistics import check_ranges, compute_norm_stats
from mme_vla.errors import UserError
from mme_vla.policy.training_identity import identify
from mme_vla.processing.normalise import (
    ExactStats,
    NormStats,
    QuantileStats,
    RunningStats,
    normalize,
)
from mme_vla.training.settings import DataSettings

FRAMES = 600


def source_of(root: Path, numbers: np.ndarray, states: np.ndarray | None = None) -> EpisodeSource:
    """A dataset whose second action number is `numbers` [600]."""
    time = np.arange(FRAMES) / 10
    actions = np.stack([np.sin(time), numbers, np.cos(time)], axis=1)
    states = actions if states is None else states
    write_dataset(
        root,
        (FRAMES,),
        ("move",),
        states=states,
        actions=actions,
        video=True,
        names=["x", "grip", "z"],
    )
    return EpisodeSource(root, robot=custom_robot())


def seldom(at: int, value: float = 0.0) -> np.ndarray:
    numbers = np.ones(FRAMES)
    numbers[at] = value
    return numbers


@pytest.mark.parametrize("exact", [False, True])
@pytest.mark.parametrize(
    "at", [300, FRAMES - 1]
)  # also where the shuffled batches may leave it out
def test_a_number_that_seldom_moves_is_named_refused_or_widened(
    tmp_path: Path, exact: bool, at: int, caplog
) -> None:
    source = source_of(tmp_path, seldom(at), states=np.zeros((FRAMES, 3)))
    options: dict[str, Any] = {"horizon": 1, "robot": custom_robot(), "exact": exact}
    with pytest.raises(
        UserError, match=r"grip of the action has q01 .* and q99 .*, but values from 0 to 1.*widen"
    ):
        compute_norm_stats([source], narrow="refuse", **options)
    widened = compute_norm_stats([source], narrow="widen", **options).actions
    assert widened.q01[1] == 0 and widened.q99[1] == pytest.approx(1, abs=1e-3)
    target = normalize(torch.tensor([[0.0, 0.0, 0.0]]), widened)[0, 1]
    assert target == pytest.approx(-1, abs=1e-3)
    unscaled = compute_norm_stats([source], **options).actions
    assert "grip of the action has q01" in caplog.text
    assert np.array_equal(unscaled.q01[[0, 2]], widened.q01[[0, 2]])  # the others stay as they are


@pytest.mark.parametrize(
    "numbers",
    [
        np.ones(FRAMES),  # never moves
        np.zeros(FRAMES),
        1 + 1e-6 * np.random.default_rng(0).normal(size=FRAMES),  # noise of a resting motor
        np.random.default_rng(0).normal(size=FRAMES),
        np.where(np.arange(FRAMES) % 20 == 0, 0.0, 1.0),  # moves in one frame of twenty
        np.random.default_rng(0).standard_t(3, size=FRAMES),  # heavy tails
    ],
)
def test_ordinary_numbers_are_accepted(tmp_path: Path, numbers: np.ndarray, caplog) -> None:
    compute_norm_stats(
        [source_of(tmp_path, numbers)], horizon=4, robot=custom_robot(), narrow="refuse"
    )
    assert not caplog.text


def test_a_state_is_compared_as_well(tmp_path: Path) -> None:
    states = np.random.default_rng(0).normal(size=(FRAMES, 3))
    states[40, 2] = 1e5
    source = source_of(tmp_path, np.sin(np.arange(FRAMES)), states)
    with pytest.raises(UserError, match=r"z of the state has q01 .*1?e?\+05|100000"):
        compute_norm_stats([source], horizon=1, robot=custom_robot(), exact=True, narrow="refuse")


def test_statistics_of_other_data_are_compared_with_these(tmp_path: Path) -> None:
    """A hundred times too small: radians where the data are in degrees, or millimetres
    for metres.
    """
    source = source_of(tmp_path, 300 * np.sin(np.arange(FRAMES)), states=np.zeros((FRAMES, 3)))
    side = QuantileStats(*(np.full(3, value) for value in (0.0, 1.0, -1.0, 1.0)))
    stats = NormStats(side, side)
    with pytest.raises(
        UserError, match=r"grip of the action has q01 -1 and q99 1, but values from -29\d\.\d+ to"
    ):
        check_ranges(stats, [source], horizon=1, robot=custom_robot())
    widened = check_ranges(stats, [source], horizon=1, robot=custom_robot(), narrow="widen")
    assert widened.actions.q01[1] < -299 and widened.actions.q01[0] == -1


def test_a_misspelt_choice_is_refused_before_the_data_are_read() -> None:
    with pytest.raises(UserError, match=r"narrow.*widen"):
        compute_norm_stats([], narrow="widne")


def training_data(root: Path, **changes: Any) -> DataSettings:
    data = OmegaConf.to_container(OmegaConf.load(REPOSITORY / "configs" / "data" / "sample.yaml"))
    assert isinstance(data, dict)
    return DataSettings.from_dict(data | {"sources": [str(root)], "val_episodes": []} | changes)


def test_training_refuses_unless_told_to_widen(tmp_path: Path) -> None:
    import pyarrow as pa

    from helpers.lerobot_tables import ROWS, change
    from mme_vla.testing.small import small_policy
    from mme_vla.training.data import prepare_data

    root = tmp_path / "copy"
    shutil.copytree(SAMPLE, root)
    rows = np.concatenate([EpisodeSource("sample").actions(e) for e in range(4)])
    rows[:, 7] = 1
    rows[120, 7] = -1  # the gripper opens in one frame
    change(root, ROWS, "actions", pa.array(rows.tolist(), pa.list_(pa.float32(), 8)))
    policy = small_policy("pi05")
    with pytest.raises(UserError, match=r"data.narrow_ranges=widen"):
        prepare_data(policy, training_data(root), seed=1)
    prepare_data(policy, training_data(root, narrow_ranges="widen"), seed=1)
    stats = policy.require_processor().stats
    assert stats is not None and stats.actions.q01[7] == -1
    with pytest.raises(UserError, match=r"data.narrow_ranges='wide'"):
        prepare_data(policy, training_data(root, narrow_ranges="wide"), seed=1)


def test_statistics_that_a_run_stored_stay_when_it_is_resumed(tmp_path: Path) -> None:
    from mme_vla.processing.base import STATS_FILE
    from mme_vla.testing.small import small_policy
    from mme_vla.training.data import prepare_data

    policy, root = small_policy("pi05"), EpisodeSource("sample").root
    processor = policy.require_processor()
    prepare_data(policy, training_data(root), seed=1)
    stats = processor.stats
    assert stats is not None
    stats.actions.q99[0] += 0.5
    stats.save(tmp_path / STATS_FILE)
    for narrow in (None, "widen", "warn"):
        prepare_data(policy, training_data(root, narrow_ranges=narrow), seed=1, stats_from=tmp_path)
        assert processor.stats is not None and processor.stats.to_dict() == stats.to_dict()


def test_the_recipe_of_a_training_names_widening_and_stays_what_it_was_without() -> None:
    before, default, widened = ({"seed": 1, "data": data} for data in ({}, {"narrow_ranges": None},
                                {"narrow_ranges": "widen"}))  # fmt: skip
    assert identify(before, []) == identify(default, [])
    assert identify(before, [])["recipe"] != identify(widened, [])["recipe"]


@pytest.mark.parametrize("outlier", [1e3, 1e4, 1e5, 1e6, -1e6, 1e30])
@pytest.mark.parametrize("at", [7, 395])  # in the first batch, and in the last
@pytest.mark.parametrize("middle", [0.0, 1000.0])
def test_one_value_far_away_does_not_move_the_running_quantiles(
    outlier: float, at: int, middle: float
) -> None:
    rows = np.random.default_rng(0).normal(size=(400, 2)) + middle
    rows[at, 0] = outlier
    running, exact = RunningStats(), ExactStats()
    for begin in range(0, 400, 100):
        running.update(rows[begin : begin + 100])
        exact.update(rows[begin : begin + 100])
    measured, expected = running.result(), exact.result()
    assert (
        np.abs(measured.q01 - expected.q01).max() < 0.12
        and np.abs(measured.q99 - expected.q99).max() < 0.12
    )


def test_quantiles_of_ordinary_values_are_the_released_ones() -> None:
    """To the bit: edges of the bins of one histogram over the range."""
    rows = np.random.default_rng(3).standard_t(4, size=(2000, 3))
    stats = RunningStats()
    stats.update(rows)
    edges = np.linspace(rows.min(0) - 1e-10, rows.max(0) + 1e-10, 5001, axis=1)
    for d in range(3):
        counts = np.histogram(rows[:, d], edges[d])[0].cumsum()
        assert stats.result().q01[d] == edges[d][(counts < 20).sum()]
        assert stats.result().q99[d] == edges[d][(counts < 0.99 * 2000).sum()]
