"""What every backbone's own table of sizes checks alike."""

from typing import Any

from mme_vla.errors import UserError, brief

LARGEST, DEEPEST = 2**24, 2**10
"""Bounds of every size and of layers: far above any network here, and a damaged file's number ends in words."""


def check_positive(config: Any, prefix: str) -> None:
    """Make sure that every number of a dataclass is one a network can have.

    Raises:
        UserError: a whole one below 1 or larger than any network's, or a fraction that is not between 0 and 1.
    """
    for name, value in vars(config).items():
        if isinstance(value, float) and not 0 < value < 1:
            raise UserError(f"{prefix}{name}={brief(value)} must lie between 0 and 1.")
        if isinstance(value, int) and not isinstance(value, bool) and value < 1:
            raise UserError(f"{prefix}{name}={brief(value)} must be at least 1.")
        if isinstance(value, int) and value > (DEEPEST if name in ("depth", "horizon") else LARGEST):
            raise UserError(f"{prefix}{name}={brief(value)} is larger than any network can be.")
