"""The packages under plugins/, as if they were installed: each test that wants one puts it on the
path for itself.
"""

import importlib
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType

from helpers import REPOSITORY

PLUGINS = REPOSITORY / "plugins"


@contextmanager
def plugin(folder: str, name: str, keep: bool = False) -> Iterator[ModuleType]:
    """The package `name` of plugins/`folder`; afterwards there is none again, as other tests
    expect.

    With `keep` what was imported stays so: a package that has registered itself elsewhere cannot do
    so twice.
    """
    source = str(PLUGINS / folder / "src")
    sys.path.insert(0, source)
    importlib.invalidate_caches()
    try:
        yield importlib.import_module(name)
    finally:
        sys.path.remove(source)
        for module in (
            [] if keep else [module for module in sys.modules if module.split(".")[0] == name]
        ):
            del sys.modules[module]
