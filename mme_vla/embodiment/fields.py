"""Reading the values of an embodiment's section, each refused under its own key."""

import math
from collections.abc import Sequence
from typing import Any

from mme_vla.errors import UserError, brief

LARGEST = 2**16  # of any size here: what is larger is a damaged file, and would take memory


def columns(given: Any, where: str) -> tuple[str, ...]:
    """One column of a dataset or several to be joined; none where the usual names are meant."""
    names = [] if given is None else [given] if isinstance(given, str) else given
    if not isinstance(names, Sequence) or not all(isinstance(name, str) and name for name in names):
        raise UserError(f"{where} must be a column of the dataset or a list of columns, got {brief(given)}.")
    return tuple(names)


def whole(given: Any, where: str) -> int:
    """A positive whole number, no larger than `LARGEST`."""
    if isinstance(given, bool) or not isinstance(given, int) or not 1 <= given <= LARGEST:
        raise UserError(f"{where} must be a positive whole number to {LARGEST}, got {brief(given)}.")
    return given


def places(given: Any, where: str, width: int) -> tuple[int, ...]:
    """Places of numbers in a vector of `width`, each once, counted from 0."""
    numbers = [] if given is None else list(given) if isinstance(given, Sequence) else [given]
    if not all(isinstance(i, int) and not isinstance(i, bool) and 0 <= i < width for i in numbers):
        raise UserError(f"{where} must list numbers from 0 to {width - 1}, got {brief(given)}.")
    if len(set(numbers)) < len(numbers):
        raise UserError(f"{where}={brief(given)} names a number twice.")
    return tuple(sorted(numbers))


def centres(given: Any, where: str, width: int) -> dict[int, float]:
    """A centre in radians for some numbers of a vector; keys may be texts, as JSON writes them."""
    found = {} if given is None else given
    try:
        read = {int(place): float(centre) for place, centre in found.items()}
        if not all(map(math.isfinite, read.values())):
            raise ValueError
    except (AttributeError, TypeError, ValueError, OverflowError):
        raise UserError(f"{where} must be a map such as {{3: 3.14}}, number to centre, got {brief(given)}.") from None
    places(list(read), where, width)
    return read


def words(given: Any, where: str, width: int, default: Sequence[str]) -> tuple[str, ...]:
    """One text for each of `width` numbers."""
    texts = list(default) if given is None else given
    if isinstance(texts, str) or not isinstance(texts, Sequence) or len(texts) != width:
        raise UserError(f"{where} must hold {width} texts, one a number, got {brief(given)}.")
    return tuple(map(str, texts))
