"""`Sizes`: what every backbone's own table of sizes is made of."""

from collections.abc import Mapping
from dataclasses import MISSING, fields, is_dataclass
from typing import Any, Self

from mme_vla.errors import UserError, brief, did_you_mean

LARGEST, DEEPEST = 2**24, 2**10
"""Bounds of every size and of layers: far above any network here, and a damaged file's number ends in words."""

_WORDS: Mapping[Any, str] = {int: "a whole number", float: "a number", bool: "true or false"}


class Sizes:
    """A dataclass that builds itself from a plain mapping and refuses keys it does not know."""

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Self:
        """Read a section of a configuration; nested dataclasses read their own.

        Raises:
            UserError: an unknown or missing key, or a value of another kind.
        """
        known = {f.name: f for f in fields(cls)}  # type: ignore[arg-type]
        unknown = [key for key in values if key not in known]
        if unknown:
            raise UserError(f"{cls.__name__} has no key {brief(unknown[0])}. {did_you_mean(brief(unknown[0]), known)}")
        built: dict[str, Any] = {}
        for key, value in values.items():
            kind = known[key].type
            nested = isinstance(kind, type) and is_dataclass(kind)
            accepted = (Mapping, kind) if nested else (int, float) if kind is float else kind
            if isinstance(value, bool) is not (kind is bool) or not isinstance(value, accepted):  # type: ignore[arg-type]
                wanted = "a section" if nested else _WORDS.get(kind, "text")
                raise UserError(f"{cls.__name__}.{key} must be {wanted}, not {brief(value)}.")
            built[key] = kind.from_dict(value) if nested and isinstance(value, Mapping) else value  # type: ignore[union-attr]
        needed = [name for name, f in known.items() if f.default is MISSING and f.default_factory is MISSING]
        for name in needed:
            if name not in built:
                raise UserError(f"{cls.__name__} needs the key {name!r}.")
        return cls(**built)


def check_positive(config: Any, prefix: str) -> None:
    """Make sure that every number of a config is one a network can have.

    Raises:
        UserError: one is below 1 (a fraction: not above 0), or larger than any network's.
    """
    for name, value in vars(config).items():
        if isinstance(value, float) and not 0 < value < 1:
            raise UserError(f"{prefix}{name}={brief(value)} must lie between 0 and 1.")
        if isinstance(value, int) and value < 1:
            raise UserError(f"{prefix}{name}={brief(value)} must be at least 1.")
        if isinstance(value, int) and value > (DEEPEST if name in ("depth", "horizon") else LARGEST):
            raise UserError(f"{prefix}{name}={brief(value)} is larger than any network can be.")
