"""Tests of extras belong to the slow tier: a reader of the paper does not need what they test."""

from pathlib import Path

import pytest

HERE = Path(__file__).parent


@pytest.hookimpl(tryfirst=True)  # before pytest deselects by marks
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark each test of this folder `slow`, unless it is `nightly`."""
    for item in items:
        if HERE in item.path.parents and item.get_closest_marker("nightly") is None:
            item.add_marker(pytest.mark.slow)
