"""Reading the values of an embodiment's section, each refused under its own key."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from mme_vla.errors import UserError, did_you_mean


def section(given: Any, where: str, known: Iterable[str], required: Iterable[str] = ()) -> dict[str, Any]:
    """A mapping with no unknown and no missing key.

    Raises:
        UserError: it is something else; `where` names it.
    """
    if not isinstance(given, Mapping):
        raise UserError(f"{where} must be a section of keys, got {given!r}.")
    for key in given:
        if key not in known:
            raise UserError(f"Unknown key {where}.{key}. {did_you_mean(str(key), list(known))}")
    for key in required:
        if given.get(key) is None:
            raise UserError(f"{where} lacks the key {key!r}; it has {', '.join(map(str, given)) or 'none'}.")
    return {str(key): value for key, value in given.items()}


def columns(given: Any, where: str) -> tuple[str, ...]:
    """One column of a dataset or several to be joined; none where the usual names are meant."""
    listed = [] if given is None else [given] if isinstance(given, str) else given
    if not isinstance(listed, Sequence) or not all(isinstance(name, str) and name for name in listed):
        raise UserError(f"{where} must be a column of the dataset or a list of columns, got {given!r}.")
    return tuple(listed)


def whole(given: Any, where: str) -> int:
    """A positive whole number."""
    if isinstance(given, bool) or not isinstance(given, int) or given < 1:
        raise UserError(f"{where} must be a positive whole number, got {given!r}.")
    return given


def places(given: Any, where: str, width: int) -> tuple[int, ...]:
    """Places of numbers in a vector of `width`, each once, counted from 0."""
    listed = list(given or [])
    if not all(isinstance(i, int) and not isinstance(i, bool) and 0 <= i < width for i in listed):
        raise UserError(f"{where} must list numbers from 0 to {width - 1}, got {listed}.")
    if len(set(listed)) < len(listed):
        raise UserError(f"{where}={listed} names a number twice.")
    return tuple(sorted(listed))


def words(given: Any, where: str, width: int, default: Sequence[str]) -> tuple[str, ...]:
    """One text for each of `width` numbers."""
    listed = list(default) if given is None else given
    if isinstance(listed, str) or not isinstance(listed, Sequence) or len(listed) != width:
        raise UserError(f"{where} must hold {width} texts, one a number, got {given!r}.")
    return tuple(map(str, listed))
