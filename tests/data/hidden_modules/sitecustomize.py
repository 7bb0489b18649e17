"""Makes modules invisible to a Python that starts with this folder in PYTHONPATH, and to the ones
that it starts.

The names stand in the environment variable `HIDDEN_MODULES`, parted by spaces. To importers and to
`find_spec` a hidden module does not exist.
"""

import os
import sys
from importlib.machinery import PathFinder
from typing import Any


class Selective(PathFinder):
    """Finds modules as usual, but for the hidden ones."""

    hidden = frozenset(os.environ.get("HIDDEN_MODULES", "").split())

    @classmethod
    def find_spec(cls, fullname: str, path: Any = None, target: Any = None) -> Any:
        """Answer as the usual finder does where nothing of that name is installed."""
        return None if fullname in cls.hidden else super().find_spec(fullname, path, target)


sys.meta_path[sys.meta_path.index(PathFinder)] = Selective
