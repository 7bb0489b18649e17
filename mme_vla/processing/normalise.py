"""Normalisation of states and actions by quantiles or by extremes, and the running statistics it
needs.
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Self

import numpy as np
from torch import Tensor

from mme_vla.errors import UserError, brief, listed, require
from mme_vla.processing.prompt import warn_once
from mme_vla.utils import read_json

EPSILON = 1e-6  # keeps a dimension that never moves finite
BINS = 5000


@dataclass(frozen=True)
class QuantileStats:
    """Mean, standard deviation, 1 % and 99 % quantile of each dimension; arrays [d] of float64.

    min, max: the extremes, where they were kept; only normalisation by them needs them.
    """

    mean: np.ndarray
    std: np.ndarray
    q01: np.ndarray
    q99: np.ndarray
    min: np.ndarray | None = None
    max: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.q01)

    def bounds(self, kind: str) -> tuple[np.ndarray, np.ndarray]:
        """What becomes −1 and 1: `quantiles` or `extremes`."""
        if kind == "quantiles":
            return self.q01, self.q99
        if self.min is None or self.max is None:
            raise UserError(
                "This policy normalises by the smallest and largest values, and these statistics"
                " hold none (min, max): compute them from its data, or give the stats.json of its"
                " own training."
            )
        return self.min, self.max

    def to_dict(self) -> dict[str, list[float]]:
        """Return plain lists, as `norm_stats.json` holds them."""
        lists = {}
        for field in fields(self):
            value = getattr(self, field.name)
            if value is not None:
                lists[field.name] = value.tolist()
        return lists

    @classmethod
    def from_dict(cls, data: dict[str, Any], name: str = "statistics") -> Self:
        """Read what `to_dict` writes."""
        arrays = {}
        for field in fields(cls):
            if data.get(field.name) is None:
                if field.name in ("min", "max"):
                    continue
                keys = listed(sorted(data))
                raise UserError(
                    f"Normalisation statistics for {name!r} lack {field.name!r}; they hold {keys}."
                )
            try:
                array = np.asarray(data[field.name], dtype=np.float64)
            except (TypeError, ValueError, OverflowError):
                array = np.full(1, np.nan)
            with np.errstate(over="ignore"):
                is_finite = np.isfinite(array.astype(np.float32)).all()  # as policies compute
            if array.ndim != 1 or not is_finite:
                raise UserError(
                    f"{name}.{field.name} must be a list of finite numbers within float32, got"
                    f" {brief(data[field.name])}."
                )
            arrays[field.name] = array
        lengths = {key: len(array) for key, array in arrays.items()}
        if len(set(lengths.values())) > 1:
            raise UserError(f"{name}: the lists have different lengths {lengths}.")
        for low, high in (("q01", "q99"), ("min", "max")):
            if high in arrays and low in arrays and (arrays[low] > arrays[high]).any():
                raise UserError(
                    f"{name}: {high} lies below {low} for number"
                    f" {listed(np.flatnonzero(arrays[low] > arrays[high]) + 1)} of"
                    f" {len(arrays[low])}; the statistics are damaged."
                )
        return cls(**arrays)


_LAYOUT = (
    'Normalisation statistics must look like {"norm_stats": {"state": {…}, "actions": {…}}}; got'
    " the keys"
)


@dataclass(frozen=True)
class NormStats:
    """Statistics of the raw states, and of the action chunks after the delta transform."""

    state: QuantileStats
    actions: QuantileStats

    @classmethod
    def unit(
        cls,
        state_width: int,
        action_width: int,
        ranges: Mapping[int, tuple[float, float]] | None = None,
    ) -> Self:
        """Statistics that leave numbers about as they are: −1 and 1 stay.

        Args:
            ranges: number of an action → the lowest and the highest value, which become −1 and 1.
        """

        def between(low: np.ndarray, high: np.ndarray) -> QuantileStats:
            return QuantileStats(
                mean=(low + high) / 2, std=(high - low) / 2, q01=low, q99=high, min=low, max=high
            )

        state = between(-np.ones(state_width), np.ones(state_width))
        low = -np.ones(action_width)
        high = np.ones(action_width)
        for number, (lowest, highest) in (ranges or {}).items():
            low[number] = lowest
            high[number] = highest
        return cls(state, between(low, high))

    def to_dict(self) -> dict[str, Any]:
        """Return the layout of openpi's `norm_stats.json`."""
        return {"norm_stats": {"state": self.state.to_dict(), "actions": self.actions.to_dict()}}

    @classmethod
    def from_dict(cls, data: dict[str, Any]) -> Self:
        """Read the layout of openpi's `norm_stats.json`."""
        inner = data.get("norm_stats")
        if not isinstance(inner, dict):
            raise UserError(f"{_LAYOUT} {listed(sorted(data))}.")
        state, actions = inner.get("state"), inner.get("actions")
        if not isinstance(state, dict) or not isinstance(actions, dict):
            raise UserError(f"{_LAYOUT} {listed(sorted(inner))}.")
        return cls(
            QuantileStats.from_dict(state, "state"), QuantileStats.from_dict(actions, "actions")
        )

    def save(self, path: Path | str) -> None:
        Path(path).write_text(json.dumps(self.to_dict(), indent=2) + "\n", encoding="utf-8")

    @classmethod
    def load(cls, path: Path | str) -> Self:
        path = Path(path)
        require(path.is_file(), f"No normalisation statistics at {path}.")
        data = read_json(path, "normalisation statistics", limit=2**24)
        try:
            return cls.from_dict(data)
        except UserError as error:
            raise UserError(f"{path}: {error}") from None


def normalize(x: Tensor, stats: QuantileStats, by: str = "quantiles") -> Tensor:
    """Map [q01, q99] to [-1, 1] in the first `len(stats)` dimensions of x [..., d]; the others
    pass.

    Nothing is clipped. With `by="extremes"` it is [min, max] that is mapped.
    """
    low, span = _range(x, stats, by)
    n = len(stats)
    out = x.clone()
    out[..., :n] = (x[..., :n] - low) / span * 2 - 1
    return out


def unnormalize(x: Tensor, stats: QuantileStats, by: str = "quantiles") -> Tensor:
    low, span = _range(x, stats, by)
    n = len(stats)
    out = x.clone()
    out[..., :n] = (x[..., :n] + 1) / 2 * span + low
    return out


def _range(x: Tensor, stats: QuantileStats, by: str) -> tuple[Tensor, Tensor]:
    if not x.is_floating_point():
        raise UserError(f"Only floating-point values can be normalised, got {x.dtype}.")
    if x.shape[-1] < len(stats):
        raise UserError(
            f"Statistics of {len(stats)} dimensions do not fit values of shape {list(x.shape)}."
        )
    low, high = stats.bounds(by)
    return x.new_tensor(low), x.new_tensor(high - low + EPSILON)


class ExactStats:
    """Statistics of all rows at once, which it keeps: quantiles with linear interpolation, as
    numpy's.
    """

    def __init__(self) -> None:
        self._rows: list[np.ndarray] = []

    def update(self, x: np.ndarray) -> None:
        """Take rows [..., d]."""
        self._rows.append(np.asarray(x, np.float64).reshape(-1, x.shape[-1]))

    def result(self, extremes: bool = False) -> QuantileStats:
        """Return the statistics of everything so far, with `extremes` also the smallest and the
        largest value.
        """
        count = sum(map(len, self._rows))
        require(count >= 2, f"Statistics need at least two rows, got {count}.")
        rows = np.concatenate(self._rows)
        q01, q99 = np.quantile(rows, [0.01, 0.99], axis=0)
        stats = QuantileStats(rows.mean(0), rows.std(0), q01, q99)
        if extremes:
            return replace(stats, min=rows.min(0), max=rows.max(0))
        return stats


FEWEST_BINS = 50
"""Of a running histogram between the two quantiles; with fewer a quantile is off by more than 2 %
of the range.
"""


class _Magnitudes:
    """A histogram of one number whose bins grow with the distance from a centre: one part in 512 of
    each power of two.

    Its bins are the same whatever comes later, so one value far away costs the others nothing. They
    are found by taking numbers apart, not by a logarithm, so they are the same on every machine.
    """

    PARTS, LEAST, MOST = 256, -60, 132  # bins of a power of two, and the powers: 1e-18 to 5e39

    def __init__(self, centre: float) -> None:
        """Begin around a value near which most others are expected."""
        self._centre = float(centre)
        self._above = np.zeros((self.MOST - self.LEAST) * self.PARTS, np.int64)
        self._below = np.zeros_like(self._above)
        self._at_centre = self._count = 0

    def update(self, values: np.ndarray) -> None:
        """Count values [n]."""
        distances = values - self._centre
        mantissas, powers = np.frexp(np.abs(distances))
        parts = np.maximum(((2 * mantissas - 1) * self.PARTS).astype(np.int64), 0)
        bins = (np.clip(powers, self.LEAST, self.MOST - 1) - self.LEAST) * self.PARTS + parts
        np.add.at(self._above, bins[distances > 0], 1)
        np.add.at(self._below, bins[distances < 0], 1)
        self._at_centre += int((distances == 0).sum())
        self._count += len(values)

    def quantile(self, q: float) -> float:
        """The quantile as numpy's, between the two values nearest to it, each the middle of its
        bin.
        """
        below = np.concatenate([self._below[::-1], [self._at_centre], self._above]).cumsum()
        rank = q * (self._count - 1)
        low = self._value(below, int(np.floor(rank)))
        high = self._value(below, int(np.ceil(rank)))
        return low + (high - low) * (rank - np.floor(rank))

    def _value(self, below: np.ndarray, rank: int) -> float:
        """About the value of a rank from 0; below: counts of values up to each bin, from the lowest
        on.
        """
        place = int(np.searchsorted(below, rank, side="right")) - len(self._below)
        if place == 0:
            return self._centre
        power, part = divmod(abs(place) - 1, self.PARTS)
        distance = np.ldexp(0.5 + (part + 0.5) / (2 * self.PARTS), power + self.LEAST)
        return float(self._centre + np.sign(place) * distance)


class RunningStats:
    """Mean, deviation and quantiles of a stream too long to keep, in one pass.

    Quantiles come from one histogram per dimension, laid over the range seen so far. When the range
    grows, every old bin's count moves to the new bin that holds its left edge. A quantile q is the
    left edge of the first bin at which the cumulative count reaches q·n. All as released, so that
    the same data give the same `norm_stats.json`: also that a first bin whose edge lies a hair
    outside the new range loses its count, so quantiles are approximate.

    One value far away makes all bins wide, and the others fall into one. Where fewer than
    `FEWEST_BINS` lie between the quantiles, they are taken from a second histogram (`_Magnitudes`),
    whose bins nothing widens.
    """

    def __init__(self) -> None:
        self._count = 0
        empty: np.ndarray = np.zeros(0)
        self._mean = self._square = self._low = self._high = empty  # [d]
        self._edges = self._counts = empty  # [d, BINS + 1] and [d, BINS]
        self._magnitudes: list[_Magnitudes] = []  # [d]

    def update(self, batch: np.ndarray) -> None:
        """Add rows [..., d]."""
        rows = np.asarray(batch, dtype=np.float64)
        rows = rows.reshape(-1, rows.shape[-1])
        if not len(rows):
            return
        require(
            np.isfinite(rows).all(),
            "Statistics need finite values, but the data contain NaN or infinity.",
        )
        low, high = rows.min(0), rows.max(0)
        if self._count == 0:
            self._mean, self._square = np.zeros((2, rows.shape[1]))
            self._low, self._high = low, high
            # A hair of room, so that a dimension that never moves still has bins.
            self._edges = np.linspace(low - 1e-10, high + 1e-10, BINS + 1, axis=1)
            self._counts = np.zeros((rows.shape[1], BINS))
            self._magnitudes = [_Magnitudes(centre) for centre in np.median(rows, axis=0)]
        elif rows.shape[1] != len(self._mean):
            raise UserError(
                f"Rows of {rows.shape[1]} numbers cannot join statistics of {len(self._mean)}."
            )
        elif (low < self._low).any() or (high > self._high).any():
            self._low = np.minimum(low, self._low)
            self._high = np.maximum(high, self._high)
            edges = np.linspace(self._low, self._high, BINS + 1, axis=1)
            for i, (old, new) in enumerate(zip(self._edges, edges, strict=True)):
                self._counts[i] = np.histogram(old[:-1], new, weights=self._counts[i])[0]
            self._edges = edges
        self._count += len(rows)
        weight = len(rows) / self._count
        self._mean = self._mean + (rows.mean(0) - self._mean) * weight
        self._square = self._square + ((rows**2).mean(0) - self._square) * weight
        for edges, counts, column in zip(self._edges, self._counts, rows.T, strict=True):
            counts += np.histogram(column, edges)[0]
        for magnitudes, column in zip(self._magnitudes, rows.T, strict=True):
            magnitudes.update(column)

    def result(self, extremes: bool = False) -> QuantileStats:
        """Return the statistics of everything so far, with `extremes` also the smallest and the
        largest value.
        """
        require(self._count >= 2, f"Statistics need at least two rows, got {self._count}.")
        std = np.sqrt(np.maximum(self._square - self._mean**2, 0))
        low, high = self._quantile(0.01), self._quantile(0.99)
        widths = (self._high - self._low) / BINS
        for d, magnitudes in enumerate(self._magnitudes):
            fine_low, fine_high = magnitudes.quantile(0.01), magnitudes.quantile(0.99)
            if 0 < fine_high - fine_low < FEWEST_BINS * widths[d]:
                low[d], high[d] = fine_low, fine_high
        stats = QuantileStats(self._mean.copy(), std, low, high)
        if extremes:
            return replace(stats, min=self._low.copy(), max=self._high.copy())
        return stats

    def _quantile(self, q: float) -> np.ndarray:
        below = self._counts.cumsum(1) < q * self._count
        return self._edges[np.arange(len(below)), below.sum(1)]


# multiples of the widest range; a broken driver says 1e30, a robot never leaves its joints' limits
# by that
REACH = 100
# multiples of the largest value in training; degrees in place of radians are 57 times as large
OTHER_UNIT = 10


def finite_array(values: object, what: str) -> np.ndarray:
    """`values` as float32."""
    try:
        array = np.asarray(values, np.float32)
    except (TypeError, ValueError, OverflowError):
        raise UserError(f"{what} must be numbers, got {brief(values)}.") from None
    if not np.isfinite(array).all():
        raise UserError(
            f"{what} must be finite numbers, got {brief(array[~np.isfinite(array)][:4].tolist())}."
        )
    return array


def check_reach(values: np.ndarray, stats: QuantileStats | None, what: str) -> None:
    """Refuse values [..., d] that lie further from the middle than `REACH` times the widest range
    q01…q99, and warn of those in other units than in training.

    The widest range of all dimensions counts, so that one which hardly moved in training (a
    gripper) may move.
    """
    if stats is None or values.shape[-1] != len(stats):
        return
    reach = REACH * max(float((stats.q99 - stats.q01).max()), 1e-3)
    beyond = np.abs(values.astype(np.float64) - (stats.q01 + stats.q99) / 2) > reach
    if beyond.any():
        place = tuple(int(i) for i in np.argwhere(beyond)[0])
        d = place[-1]
        raise UserError(
            f"{what} has {values[place]:.4g} for number {d + 1} of {values.shape[-1]}; in the"
            f" training data it lies within {stats.q01[d]:.4g} and {stats.q99[d]:.4g}. Check the"
            " driver and the units."
        )
    # Other units make most numbers larger that are not near zero; some are at any time.
    trained = np.maximum(np.abs(stats.q01), np.abs(stats.q99))
    largest = np.abs(values).reshape(-1, len(stats)).max(axis=0, initial=0)
    times = largest / np.maximum(trained, 1e-3)
    if (times > OTHER_UNIT).mean() > 0.25:
        warn_once(
            f"{what} has {(times > OTHER_UNIT).sum()} of {len(stats)} numbers more than"
            f" {OTHER_UNIT} times as large as any in the training data (up to {times.max():.0f}"
            " times). Check the units: degrees and radians differ by 57.",
            key=(OTHER_UNIT, trained.tobytes()),
        )
