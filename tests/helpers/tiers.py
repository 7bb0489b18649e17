"""Which cases of a parametrized test belong to which tier."""

from collections.abc import Callable, Iterable
from typing import Any

import pytest

ONE_OF_A_SUITE = ("PickXtimes", "VideoUnmask", "PickHighlight", "PatternLock")
"""A task of each suite of the benchmark."""


def slow_or_nightly(
    values: Iterable[Any], is_slow: Callable[[Any], bool], ids: Callable[[Any], str] | None = None
) -> list[Any]:
    """Cases of `pytest.mark.parametrize`: some belong to the slow tier, the others to nightly."""
    cases = []
    for value in values:
        mark = pytest.mark.slow if is_slow(value) else pytest.mark.nightly
        arguments = value if isinstance(value, tuple) and ids is None else (value,)
        cases.append(pytest.param(*arguments, marks=mark, id=None if ids is None else ids(value)))
    return cases
