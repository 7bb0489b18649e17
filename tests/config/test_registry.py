"""Tables of parts: names that ship with the library are not taken by others."""

import subprocess
import sys

import pytest

from mme_vla import UserError, register


def test_a_name_that_ships_is_not_taken_before_it_is_used() -> None:
    """In a fresh process, in which nothing has been imported yet."""
    script = "import mme_vla\nmme_vla.register('memory', 'framesamp')(type('Mine', (), {}))"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=120)
    assert "UserError: memory 'framesamp' ships with the library (mme_vla.memory.framesamp)" in done.stderr


def test_a_name_is_taken_once() -> None:
    with pytest.raises(UserError, match=r"ships with the library|already registered"):
        register("memory", "tokendrop")(type("Mine", (), {}))
