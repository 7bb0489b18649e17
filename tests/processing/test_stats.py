"""Normalisation statistics of execution samples."""

import numpy as np
import pytest

from helpers.h5_files import Recorded, write_file
from mme_vla.data.convert import ConvertOptions, convert
from mme_vla.data.episodes import EpisodeSource
from mme_vla.data.hdf5 import find_files, list_episodes
from mme_vla.data.statistics import compute_norm_stats
from mme_vla.errors import UserError


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> tuple[EpisodeSource, list[Recorded]]:
    folder = tmp_path_factory.mktemp("stats")
    recorded = write_file(folder / "record_dataset_Alpha.h5", [40, 30], videos=[12, 0])
    convert(list_episodes(find_files([folder])), folder / "out", ConvertOptions(images="png"))
    return EpisodeSource(folder / "out"), recorded


def expected(
    recorded: list[Recorded], starts: list[int], offset: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    states, deltas = [], []
    for episode, start in zip(recorded, starts, strict=True):
        for t in range(start, len(episode.state)):
            chunk = episode.actions[
                np.minimum(np.arange(t + offset, t + offset + 20), len(episode.state) - 1)
            ].copy()
            chunk[:, :7] -= episode.state[t, :7]
            states.append(episode.state[t])
            deltas.append(chunk)
    return np.array(states), np.concatenate(deltas)


@pytest.mark.parametrize("offset", [0, 1])
def test_statistics_are_those_of_execution_states_and_delta_chunks(data, offset: int) -> None:
    source, recorded = data
    stats = compute_norm_stats([source], action_offset=offset)
    for actual, rows in zip(
        (stats.state, stats.actions), expected(recorded, [12, 0], offset), strict=True
    ):
        assert np.allclose(actual.mean, rows.mean(0), atol=1e-5) and np.allclose(
            actual.std, rows.std(0), atol=1e-5
        )
        bin_width = np.ptp(rows, axis=0) / 5000
        quantiles = np.quantile(rows, [0.01, 0.99], axis=0, method="inverted_cdf")
        assert (
            np.abs(np.stack([actual.q01, actual.q99]) - quantiles) <= 2 * bin_width + 1e-6
        ).all()


def test_only_the_selected_episodes_count(data) -> None:
    source, recorded = data
    stats = compute_norm_stats([source], [np.array([1])])
    assert np.allclose(stats.state.mean, recorded[1].state.mean(0), atol=1e-5)


def test_an_incomplete_last_batch_is_left_out_as_released(data, monkeypatch) -> None:
    source, _ = data
    counts = []
    from mme_vla.data import statistics as module

    update = module.RunningStats.update
    monkeypatch.setattr(
        module.RunningStats, "update", lambda self, x: (counts.append(len(x)), update(self, x))
    )
    monkeypatch.setattr(module, "BATCH", 16)
    compute_norm_stats([source])
    assert counts == [16] * 6  # 58 steps: three batches of states and of chunks


def test_no_data_is_an_error(data) -> None:
    with pytest.raises(UserError, match="at least two execution steps"):
        compute_norm_stats([data[0]], [np.zeros(0, np.int64)])
