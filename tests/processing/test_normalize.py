"""Normalisation, its inverse and the running statistics agree with the released ones."""

from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from torch import Tensor

from mme_vla.embodiment import ROBOMME_JOINT
from mme_vla.errors import UserError
from mme_vla.processing.base import pad_width
from mme_vla.processing.normalise import (
    NormStats,
    QuantileStats,
    RunningStats,
    normalize,
    unnormalize,
)


def golden_stats(tensors: dict[str, Tensor]) -> NormStats:
    def read(name: str) -> dict[str, list[float]]:
        return {
            key: tensors[f"stats/{name}/{key}"].tolist() for key in ("mean", "std", "q01", "q99")
        }

    return NormStats.from_dict({"norm_stats": {name: read(name) for name in ("state", "actions")}})


def made_up_stats(dims: int = 8) -> QuantileStats:
    rng = np.random.default_rng(3)
    low = rng.normal(size=dims)
    return QuantileStats(
        mean=low + 0.5, std=np.ones(dims), q01=low, q99=low + rng.uniform(0.1, 2, dims)
    )


def test_action_chain_gives_the_golden_values_both_ways(parity: Path) -> None:
    tensors = load_file(parity / "unit_normalisation.safetensors")
    stats = golden_stats(tensors)
    actions, state = tensors["in/actions"], tensors["in/state"]
    deltas = ROBOMME_JOINT.action.to_relative(actions, state)
    assert (deltas - tensors["out/delta_actions"]).abs().max() <= 1e-6
    normalised = normalize(deltas, stats.actions)
    assert (normalised - tensors["out/actions_normalised"]).abs().max() <= 1e-5
    width = tensors["out/actions_padded"].shape[-1]
    padded = pad_width(normalised, width)
    assert (padded - tensors["out/actions_padded"]).abs().max() <= 1e-5
    back = ROBOMME_JOINT.action.to_absolute(
        unnormalize(padded, stats.actions)[..., : len(stats.actions)], state
    )
    assert (back - tensors["out/actions_absolute_first8"]).abs().max() <= 1e-5


def test_state_gives_the_golden_values(parity: Path) -> None:
    tensors = load_file(parity / "unit_normalisation.safetensors")
    normalised = normalize(tensors["in/state"], golden_stats(tensors).state)
    assert (normalised - tensors["out/state_normalised"]).abs().max() <= 1e-5
    padded = pad_width(normalised, tensors["out/state_padded"].shape[-1])
    assert (padded - tensors["out/state_padded"]).abs().max() <= 1e-5


def test_running_statistics_give_the_golden_values(parity: Path) -> None:
    tensors = load_file(parity / "unit_running_stats.safetensors")
    running = RunningStats()
    for batch in tensors["in/batches"].numpy():
        running.update(batch)
    result = running.result()
    for name in ("mean", "std", "q01", "q99"):
        assert np.abs(getattr(result, name) - tensors[f"out/{name}"].numpy()).max() <= 1e-5


def test_running_statistics_approach_the_exact_ones_whatever_the_batches() -> None:
    data = np.random.default_rng(0).normal(size=(20_000, 3)) * [0.1, 1, 10]
    running = RunningStats()
    for start in range(0, len(data), 1_000):
        running.update(data[start : start + 1_000].reshape(10, 100, 3))
    result = running.result()
    assert np.allclose(result.mean, data.mean(0)) and np.allclose(result.std, data.std(0))
    span = np.ptp(data, axis=0)
    assert (np.abs(result.q01 - np.quantile(data, 0.01, axis=0)) < span / 200).all()
    assert (np.abs(result.q99 - np.quantile(data, 0.99, axis=0)) < span / 200).all()


def test_a_dimension_that_never_moves_has_itself_as_quantiles() -> None:
    running = RunningStats()
    running.update(np.array([[1.0, 0.0], [1.0, 2.0]]))
    running.update(np.array([[1.0, -3.0], [1.0, 5.0]]))
    result = running.result()
    assert (
        result.q01[0] == pytest.approx(1)
        and result.q99[0] == pytest.approx(1)
        and result.std[0] == 0
    )


def test_running_statistics_refuse_bad_rows() -> None:
    running = RunningStats()
    with pytest.raises(UserError, match="at least two"):
        running.result()
    with pytest.raises(UserError, match="NaN"):
        running.update(np.array([[np.nan]]))
    running.update(np.zeros((2, 3)))
    with pytest.raises(UserError, match="2 numbers"):
        running.update(np.zeros((2, 2)))


def test_quantiles_map_to_the_ends_and_nothing_is_clipped() -> None:
    stats = made_up_stats()
    ends = torch.tensor(np.stack([stats.q01, stats.q99, 2 * stats.q99 - stats.q01]))
    expected = torch.tensor([-1.0, 1.0, 3.0], dtype=torch.float64)[:, None].expand(3, 8)
    assert torch.allclose(normalize(ends, stats), expected, atol=1e-4)


def test_normalisation_refuses_values_the_statistics_do_not_fit() -> None:
    with pytest.raises(UserError, match="8 dimensions"):
        normalize(torch.zeros(3, 7), made_up_stats())
    with pytest.raises(UserError, match="int64"):
        normalize(torch.zeros(3, 8, dtype=torch.int64), made_up_stats())


def test_statistics_survive_their_file(tmp_path: Path) -> None:
    stats = NormStats(made_up_stats(), made_up_stats())
    stats.save(tmp_path / "norm_stats.json")
    loaded = NormStats.load(tmp_path / "norm_stats.json")
    assert loaded.to_dict() == stats.to_dict()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "not valid JSON"),
        ("[]", "an object"),
        ('{"state": {}}', "must look like"),
        ('{"norm_stats": {"state": {}, "actions": {}}}', "lack 'mean'"),
        (
            (
                '{"norm_stats": {"state": {"mean": [0], "std": [1], "q01": [0, 1], "q99": [1]},'
                ' "actions": {}}}'
            ),
            "lengths",
        ),
        (
            (
                '{"norm_stats": {"state": {"mean": [0], "std": [1], "q01": [2], "q99": [1]},'
                ' "actions": {}}}'
            ),
            "state: q99 lies below q01 for number 1 of 1",
        ),
        (
            (
                '{"norm_stats": {"state": {"mean": ["x"], "std": [1], "q01": [2], "q99": [1]},'
                ' "actions": {}}}'
            ),
            "finite",
        ),
    ],
)
def test_damaged_statistics_are_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "norm_stats.json").write_text(text)
    with pytest.raises(UserError, match=message):
        NormStats.load(tmp_path / "norm_stats.json")


def test_missing_statistics_are_named(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="nowhere"):
        NormStats.load(tmp_path / "nowhere.json")
