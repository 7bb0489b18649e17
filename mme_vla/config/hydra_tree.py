"""Hydra's compose API on the library's tree of YAML files and on a user's trees beside it."""

import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from hydra import version
from hydra._internal.hydra import Hydra
from hydra._internal.utils import create_config_search_path
from hydra.core.config_search_path import SearchPathQuery
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.core.plugins import Plugins
from hydra.core.utils import JobRuntime
from hydra.errors import OverrideParseException

from mme_vla.errors import UserError

VERSION_BASE = "1.3"


def _load_installed_plugins() -> None:
    """Load Hydra's plugins, but none of a folder `hydra_plugins` of the current directory."""
    before, here = list(sys.path), Path.cwd().resolve()
    sys.path[:] = [folder for folder in sys.path if Path(folder).resolve() != here]
    try:
        Plugins.instance()
    finally:
        sys.path[:] = before


_load_installed_plugins()


def config_dir() -> Path:
    """Return the folder of the YAML tree: inside the package when a wheel is installed, else the repository's."""
    package = Path(__file__).resolve().parents[1]
    shipped = package / "configs"
    return shipped if shipped.is_dir() else package.parent / "configs"


@contextmanager
def local_hydra(directory: Path, extra_dirs: Sequence[Path]) -> Iterator[Hydra]:
    """Hydra's compose API with further folders, handing back the Hydra that a surrounding command runs under."""
    base = version.VersionBase.instance()
    outer, outer_base = GlobalHydra.instance().hydra, base.version_base
    GlobalHydra.instance().clear()
    search_path = create_config_search_path(str(directory))
    for folder in extra_dirs:
        search_path.prepend("command-line", f"file://{folder.resolve()}", anchor=SearchPathQuery(provider="schema"))
    try:
        version.setbase(VERSION_BASE)
        name = JobRuntime.instance().get("name")  # a sweep's next job is still to be called by it
        yield Hydra.create_main_hydra2(task_name=name, config_search_path=search_path)
    finally:
        GlobalHydra.instance().hydra = outer
        base.version_base = outer_base


def parse(overrides: Sequence[str]) -> list[Override]:
    """Overrides under Hydra's grammar."""
    try:
        parsed = OverridesParser.create().parse_overrides(list(overrides))
        for override in parsed:
            if not override.key_or_group:
                raise OverrideParseException(str(override.input_line), "the key is missing")
    except OverrideParseException as error:
        raise UserError(
            f"Cannot read the override {error.override!r}: {error.message.splitlines()[0]}. "
            "Write key=value, +key=value to add a key, ~key to remove one; quote values with special characters."
        ) from error
    return parsed
