"""The values of a scene: noted while it is sampled from a seed, or read from a row.

A row's `spec` has up to four parts: `layout` (places), `objects` (counts, colours, choices),
`actions` (what happens) and `initializations` (what is sampled when an episode begins, of which the
last entry counts). A value's name is its path, such as `layout.button_xy`; a number in it is an
index. Building from a row uses no random number.

Units: `[x, y]` is a centre in metres. `[x, y, yaw]` of a cube has radians, of a container degrees.
"""

import copy
import itertools
import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from mme_vla.envs.robomme.scene.placement import Box2D
from mme_vla.errors import UserError, brief

BOUND = 2.0
"""Largest coordinate of a place in a row, metres: the table ends before it."""
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

    def __call__[T](self, name: str, sample: Callable[[], T], default: T | None = None) -> T:
        """One value: read from the row, or sampled and noted.

        Args:
            name: path of the value.
            sample: makes it from random numbers; must give plain numbers, texts, lists or arrays.
            default: where the row lacks the value; None requires it.

        Raises:
            UserError: the row lacks the value, or it is not of the kind that sampling gives.
        """
        if not self.specified:
            value = sample()
            self.note(name, value)
            return value
        value = self.find(name)
        if value is None:
            if default is None:
                raise self.error(name, "is missing")
            return default
        return value

    def place(self, name: str, sample: Callable[[], Any], size: int = 2) -> list[float]:
        """`size` numbers, the first two of which are a place on the table."""
        value = self(name, lambda: [float(v) for v in sample()])
        if self.specified:
            return self.check_place(name, value, size)
        return value

    def check_place(self, name: str, value: Any, size: int) -> list[float]:
        """A place that a row gives, if it is one."""
        is_list = isinstance(value, list) and len(value) == size
        if (
            not is_list
            or not all(_is_number(v) for v in value)
            or max(abs(value[0]), abs(value[1])) > BOUND
        ):
            raise self.error(
                name, f"is {brief(value)}; expected {size} numbers, x and y within {BOUND} m"
            )
        return [float(v) for v in value]

    def integer(self, name: str, sample: Callable[[], int], least: int = 0, most: int | None = None,
                default: int | None = None) -> int:  # fmt: skip
        """A whole number from `least` to `most`, both included."""
        value = self(name, sample, default)
        if self.specified:
            limit = f"at least {least}" if most is None else f"{least} to {most}"
            too_large = type(value) is int and most is not None and value > most
            if type(value) is not int or value < least or too_large:
                raise self.error(name, f"is {brief(value)}; expected a whole number, {limit}")
        return value

    def number(self, name: str, sample: Callable[[], float]) -> float:
        """A finite number."""
        value = self(name, sample)
        if not _is_number(value):
            raise self.error(name, f"is {brief(value)}; expected a number")
        return float(value)

    def flag(self, name: str, sample: Callable[[], bool], default: bool | None = None) -> bool:
        """True or false."""
        value = self(name, sample, default)
        if type(value) is not bool:
            raise self.error(name, f"is {brief(value)}; expected true or false")
        return value

    def indices(
        self, name: str, sample: Callable[[], list[int]], count: int, distinct: bool = True
    ) -> list[int]:
        """Indices into a list of `count` entries."""
        value = self(name, sample)
        if self.specified:
            valid = isinstance(value, list) and all(
                type(v) is int and 0 <= v < count for v in value
            )
            if not valid or (distinct and len(set(value)) < len(value)):
                once = ", each once" if distinct else ""
                raise self.error(
                    name, f"is {brief(value)}; expected numbers from 0 to {count - 1}{once}"
                )
        return value

    def pairs(self, name: str, count: int) -> list[list[int]] | None:
        """Pairs of different indices below `count`; None where the row has none."""
        value = self.find(name)
        if value is None:
            return None
        pairs = value if isinstance(value, list) else [value]
        for pair in pairs:
            are_two = isinstance(pair, list) and len(pair) == 2
            if (
                not are_two
                or any(type(i) is not int or not 0 <= i < count for i in pair)
                or pair[0] == pair[1]
            ):
                raise self.error(
                    name, f"has {brief(pair)}; expected two different numbers from 0 to {count - 1}"
                )
        return pairs

    def words(
        self, name: str, sample: Callable[[], list[str]], known: Mapping[str, Any]
    ) -> list[str]:
        """Names, each of those `known`, such as colours."""
        value = self(name, sample)
        words = value if isinstance(value, list) else [value]
        for word in words:
            self._check_word(name, word, known)
        return words

    def word(self, name: str, sample: Callable[[], str], known: Mapping[str, Any]) -> str:
        """One of the names `known`."""
        value = self(name, sample)
        self._check_word(name, value, known)
        return value

    def _check_word(self, name: str, word: Any, known: Mapping[str, Any]) -> None:
        if not isinstance(word, str) or word not in known:
            raise self.error(name, f"has {brief(word)}; expected one of {', '.join(known)}")

    def colour(self, name: str, sample: Callable[[], Any]) -> tuple[float, float, float]:
        """Red, green and blue in 0 … 1; a fourth number is left out."""
        value = self(name, sample)
        rgb = value[:3] if isinstance(value, list) else []
        if len(rgb) != 3 or not all(_is_number(v) and 0 <= v <= 1 for v in rgb):
            raise self.error(name, f"is {brief(value)}; expected red, green and blue from 0 to 1")
        return float(rgb[0]), float(rgb[1]), float(rgb[2])

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
        if value is not None and not isinstance(value, Mapping):
            raise self.error(name, f"is {brief(value)}; expected places by name")
        return list(value or {})

    def count(self, name: str) -> int:
        """Entries of a list of the row; 0 where it has none."""
        value = self.find(name)
        if value is not None and not isinstance(value, list):
            raise self.error(name, f"is {brief(value)}; expected a list")
        return len(value or [])

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

    def error(self, name: str, problem: str) -> UserError:
        """What is wrong with a value of the row."""
        return UserError(f"{self._where}: spec.{name} {problem}.")

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
            if box.intersects(occupied):
                raise self.error(name, f"overlaps spec.{other}")
        self._occupied.append((name, box))


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _to_json(value: Any) -> Any:
    """Numbers, texts, lists and dictionaries, as JSON keeps them to the last bit."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, list | tuple):
        return [_to_json(v) for v in value]
    return value
