"""The published results, unpacked once a process."""

from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import published

_FOLDER = TemporaryDirectory(prefix="mme-vla-published-")


@cache
def published_folder(name: str) -> Path:
    """The files of an archive of `scripts/published.py`."""
    return published.unpack(name, Path(_FOLDER.name))
