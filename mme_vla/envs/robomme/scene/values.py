"""The values of a scene: noted while it is sampled from a seed, or read from a row.

A row's `spec` has up to four parts: `layout` (places), `objects` (counts, colours, choices),
`actions` (what happens) and `initializations` (what is sampled when an episode begins, of which the
last entry counts). A value's name is its path, such as `layout.button_xy`; a number in it is an
index. Building from a row uses no random number.

Units: `[x, y]` is a centre in metres. `[x, y, yaw]` of a cube has radians, of a container degrees.
"""

import copy
import itertools
from collections.abc import Callable, Iterable, Mapping
from typing import Annotated, Any, Literal

import numpy as np
from annotated_types import Interval, Len
from pydantic import FiniteFloat

from mme_vla.envs.robomme.scene.placement import Box2D
from mme_vla.errors import brief, require
from mme_vla.utils.validation import validated

BOUND = 2.0
"""Largest coordinate of a place in a row, metres: the table ends before it."""
Coordinate = Annotated[float, Interval(ge=-BOUND, le=BOUND)]
_Share = Annotated[float, Interval(ge=0, le=1)]
_PLACES: dict[int, Any] = {
    2: tuple[Coordinate, Coordinate],
    3: tuple[Coordinate, Coordinate, FiniteFloat],
}
OVERLAP = 0.005
"""How far two objects of a row may reach into each other, metres: turned cubes of the benchmark may
touch.
"""


class Values:
    """Reads or notes the values of one scene.

    Args:
        spec: the values of a row; without it values are sampled and noted.
        where: what an error calls the row.
    """

    def __init__(self, spec: Mapping[str, Any] | None = None, where: str = "The scene") -> None:
        self.specified = spec is not None
        """Values are read, and nothing is sampled."""
        self.spec: dict[str, Any] = copy.deepcopy(dict(spec or {}))
        self._where = where
        self._occupied: list[tuple[str, Box2D]] = []

    def __call__(
        self, name: str, sample: Callable[[], Any], kind: Any = Any, default: Any = None
    ) -> Any:
        """One value: read from the row, or sampled and noted.

        Args:
            name: path of the value.
            sample: makes it from random numbers; must give plain numbers, texts, lists or arrays.
            kind: the type that it is checked against.
            default: where the row lacks the value; None requires it.

        Raises:
            UserError: the row lacks the value, or it is not of this kind.
        """
        if not self.specified:
            self.note(name, sample())
        value = self.read(name, kind)
        if value is None:
            value = default
        self.require(value is not None, name, "is missing")
        return value

    def read(self, name: str, kind: Any) -> Any:
        """A value of the row, checked against a type; None where the row has none."""
        value = self.find(name)
        if value is None:
            return None
        where = f"{self._where}: spec.{name}"
        return validated(kind, value, where, where, strict=True)

    def place(
        self, name: str, sample: Callable[[], Any], size: Literal[2, 3] = 2
    ) -> tuple[float, ...]:
        """`size` numbers, the first two of which are a place on the table."""
        return self(name, sample, _PLACES[size])

    def integer(self, name: str, sample: Callable[[], int], least: int = 0, most: int | None = None,
                default: int | None = None) -> int:  # fmt: skip
        """A whole number from `least` to `most`, both included."""
        return self(name, sample, Annotated[int, Interval(ge=least, le=most)], default)

    def number(self, name: str, sample: Callable[[], float]) -> float:
        """A finite number."""
        return self(name, sample, FiniteFloat)

    def flag(self, name: str, sample: Callable[[], bool], default: bool | None = None) -> bool:
        """True or false."""
        return self(name, sample, bool, default)

    def indices(
        self, name: str, sample: Callable[[], list[int]], count: int, distinct: bool = True
    ) -> list[int]:
        """Indices into a list of `count` entries."""
        kind = list[Annotated[int, Interval(ge=0, le=count - 1)]]
        indices: list[int] = self(name, sample, kind)
        differ = len(set(indices)) == len(indices)
        self.require(
            differ or not distinct, name, f"is {brief(indices)}; expected each number once"
        )
        return indices

    def pairs(self, name: str, count: int) -> list[tuple[int, int]] | None:
        """Pairs of different indices below `count`; None where the row has none."""
        index: Any = Annotated[int, Interval(ge=0, le=count - 1)]
        pairs = self.read(name, list[tuple[index, index]])
        for i, (first, second) in enumerate(pairs or []):
            self.require(
                first != second, f"{name}[{i}]", f"is {first} twice; expected different numbers"
            )
        return pairs

    def words(self, name: str, sample: Callable[[], list[str]], known: Iterable[str]) -> list[str]:
        """Names, each of those `known`, such as colours."""
        return self(name, sample, list[Literal[*known]])  # type: ignore[valid-type]

    def word(self, name: str, sample: Callable[[], str], known: Iterable[str]) -> str:
        """One of the names `known`."""
        return self(name, sample, Literal[*known])

    def colour(self, name: str, sample: Callable[[], Any]) -> tuple[float, float, float]:
        """Red, green and blue in 0 … 1; a fourth number is left out."""
        red, green, blue, *_ = self(name, sample, Annotated[list[_Share], Len(3, 4)])
        return red, green, blue

    def find(self, name: str) -> Any:
        """A value of the row, or None; `initializations` means its last entry."""
        value: Any = self.spec
        for part in name.split("."):
            if isinstance(value, list) and part.isdigit():
                index = int(part)
                value = value[index] if index < len(value) else None
                continue
            if isinstance(value, list):  # initializations
                value = value[-1] if value else None
            value = value.get(part) if isinstance(value, Mapping) else None
        return value

    def names(self, name: str) -> list[str]:
        """Names of the entries of a part of the row, in order."""
        value = self.find(name)
        if value is None:
            return []
        self.require(
            isinstance(value, Mapping), name, f"is {brief(value)}; expected places by name"
        )
        return list(value)

    def count(self, name: str, sampled: int = 0) -> int:
        """Entries of a list of the row, 0 where it has none; `sampled` where there is no row."""
        if not self.specified:
            return sampled
        return len(self.read(name, list) or [])

    def note(self, name: str, value: Any) -> None:
        """Keep a sampled value; an index continues a list."""
        parts = name.split(".")
        if parts[0] == "initializations":
            entries = self.spec.setdefault("initializations", [{}])
            entries[-1][parts[1]] = _to_json(value)
            return
        holder: Any = self.spec
        for part, following in itertools.pairwise(parts):
            holder = holder.setdefault(part, [] if following.isdigit() else {})
        if isinstance(holder, list):
            del holder[int(parts[-1]) :]
            holder.append(_to_json(value))
        else:
            holder[parts[-1]] = _to_json(value)

    def changed(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """A copy of all values in which these are others, by their names."""
        copied = Values(self.spec)
        for name, value in values.items():
            copied.note(name, value)
        return copied.spec

    def require(self, holds: object, name: str, problem: str) -> None:
        """Refuse the row, naming one of its values and what is wrong with it, unless something
        holds.
        """
        require(holds, f"{self._where}: spec.{name} {problem}.")

    def occupy(self, name: str, xy: Any, half: float, yaw: float = 0.0) -> None:
        """Note that an object of a row stands there, a square; refuse one that stands in another.

        Args:
            name: path of its place.
            xy: centre [2].
            half: half its side.
            yaw: radians.
        """
        if not self.specified:
            return
        box = Box2D.square(np.asarray(xy, float)[:2], half - OVERLAP, yaw)
        for other, occupied in self._occupied:
            self.require(not box.intersects(occupied), name, f"overlaps spec.{other}")
        self._occupied.append((name, box))


def _to_json(value: Any) -> Any:
    """Numbers, texts, lists and dictionaries, as JSON keeps them to the last bit."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, list | tuple):
        return [_to_json(v) for v in value]
    return value
