"""Compositions of the library's own files, each made by one process and read by all others of a run of the tests.

A process remembers what it has composed; the test processes, and the commands they fork, would each begin anew.
"""

import functools
import hashlib
import os
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

FOLDER = "MME_VLA_TESTS_COMPOSED"
"""The environment variable that names the folder; `conftest.py` makes one for a run."""


@functools.cache
def share() -> None:
    """Let what this process, and its forks, compose be found by the others."""
    from mme_vla.config import composition, errors, naming

    composition._composed_once = _shared(composition._composed_once.__wrapped__)  # type: ignore[assignment]
    errors._remembered = _shared(errors._remembered.__wrapped__)  # type: ignore[assignment]
    naming._cached_sections = _shared(naming._cached_sections.__wrapped__)  # type: ignore[assignment]


def _shared[T](make: Callable[..., T]) -> Callable[..., T]:
    @functools.cache
    def found(*asked: Any) -> T:
        name = hashlib.sha256(repr((make.__name__, asked)).encode()).hexdigest()
        file = Path(os.environ.get(FOLDER, os.devnull), name)
        try:
            known: T = pickle.loads(file.read_bytes())
            return known
        except OSError:
            made = make(*asked)
        if file.parent.is_dir():
            (draft := file.with_suffix(f".{os.getpid()}")).write_bytes(pickle.dumps(made))
            draft.rename(file)
        return made

    return found
