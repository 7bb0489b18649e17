"""A digest that is equal for equal scenes, on every machine: of what was sampled, and of where
things stand.
"""

import hashlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from mme_vla.errors import UserError, brief

NO_VALUES = "no values"
"""What records call the scene of an environment that has no values to give."""
NOT_BUILT = "not built"
"""What records call the scene of an episode that ended before there was one."""
_DIGITS = 16


def scene_digest(values: Mapping[str, Any]) -> str:
    """Sixteen hexadecimal digits that are equal for two scenes exactly if their values are, to the
    last bit.

    Args:
        values: nested mappings with texts as keys, lists, arrays, numbers, texts, truth values and
            None. Their order does not count, nor whether a number is written `1` or `1.0`.

    Raises:
        UserError: a value of another kind, of which there is no text that is the same everywhere.
    """
    return hashlib.sha256(_canonical(values).encode()).hexdigest()[:_DIGITS]


def _canonical(value: Any) -> str:
    """One text of a value, the same on every machine: numbers as hexadecimal, to the bit; keys
    sorted.
    """
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if value is None or isinstance(value, bool):
        return str(value)
    if isinstance(value, int | float):
        return float(value).hex()
    if isinstance(value, str):
        return f"{len(value)}:{value}"
    if isinstance(value, list | tuple):
        return "[" + ",".join(_canonical(item) for item in value) + "]"
    if isinstance(value, Mapping) and all(isinstance(key, str) for key in value):
        entries = (f"{_canonical(key)}={_canonical(value[key])}" for key in sorted(value))
        return "{" + ",".join(entries) + "}"
    raise UserError(
        f"A scene's values hold {brief(value)}; expected numbers, texts, truth values, None, lists,"
        " and mappings with texts as keys. Give plain values in scene_values(env)."
    )
