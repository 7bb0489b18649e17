"""Hydra as the library runs it: its own tree, a user's trees beside it, and no plugin that is not installed."""

import copy
import importlib
import pickle
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from importlib.machinery import ModuleSpec
from pathlib import Path
from types import ModuleType
from typing import Self

from hydra import version
from hydra._internal import config_loader_impl
from hydra._internal.config_repository import ConfigRepository
from hydra._internal.hydra import Hydra
from hydra._internal.utils import create_config_search_path
from hydra.core.config_search_path import ConfigSearchPath, SearchPathQuery
from hydra.core.global_hydra import GlobalHydra
from hydra.core.object_type import ObjectType
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.core.utils import JobRuntime
from hydra.errors import OverrideParseException
from hydra.plugins.config_source import ConfigResult

from mme_vla.errors import UserError


class RememberedFiles(ConfigRepository):
    """Reading takes a third of the 70 ms of a composition.

    What is remembered are bytes, as Hydra changes what it is given; a file that is not there is looked for again.
    """

    def __deepcopy__(self, memo: dict[int, object]) -> Self:
        """Hydra takes a copy to give it other sources; it need not copy every schema there is."""
        return copy.copy(self)

    def initialize_sources(self, config_search_path: ConfigSearchPath) -> None:
        super().initialize_sources(config_search_path)
        self._read: dict[str, bytes] = {}
        self._listed: dict[tuple[str, ObjectType | None], list[str]] = {}

    def load_config(self, config_path: str) -> ConfigResult | None:
        if config_path not in self._read:
            result = super().load_config(config_path)
            if result is None:
                return None
            self._read[config_path] = pickle.dumps(result)
        read: ConfigResult = pickle.loads(self._read[config_path])
        return read

    def get_group_options(self, group_name: str, results_filter: ObjectType | None = ObjectType.CONFIG) -> list[str]:
        key = group_name, results_filter
        if key not in self._listed:
            self._listed[key] = super().get_group_options(group_name, results_filter)
        return list(self._listed[key])


@cache
def remembered_files(directory: Path) -> RememberedFiles:
    """Of a tree that is searched alone, with Hydra's own."""
    return RememberedFiles(create_config_search_path(str(directory)))


VERSION_BASE = "1.3"


def _keep_hydra_to_installed_plugins() -> None:
    """Hide a folder `hydra_plugins` of the current directory, which Hydra would import, from Hydra's search.

    `python -m` puts the current directory on the path, and somebody else's folder is a place one may stand in.
    """
    here = Path.cwd().resolve()
    before = list(sys.path)
    sys.path[:] = [place for place in sys.path if Path(place).resolve() != here]
    try:
        package = importlib.import_module("hydra_plugins")
        # A plain list: a namespace's own path would follow sys.path again.
        package.__path__ = [place for place in package.__path__ if Path(place).resolve().parent != here]
    except ModuleNotFoundError:
        package = ModuleType("hydra_plugins")
        package.__spec__ = ModuleSpec("hydra_plugins", None, is_package=True)
        package.__path__ = []
        sys.modules["hydra_plugins"] = package
    finally:
        sys.path[:] = before


_keep_hydra_to_installed_plugins()


def config_dir() -> Path:
    """Return the folder of the YAML tree: inside the package when a wheel is installed, else the repository's."""
    package = Path(__file__).resolve().parents[1]
    shipped = package / "configs"
    return shipped if shipped.is_dir() else package.parent / "configs"


def is_fixed(trees: Sequence[Path], words: Sequence[str]) -> bool:
    """Whether only the library's own files are read; these words may name further trees.

    They do not change while a process runs; a user's may, between two cells of a notebook.
    """
    return tuple(trees) == (config_dir().resolve(),) and not any("searchpath" in word for word in words)


def _repository(config_search_path: ConfigSearchPath) -> ConfigRepository:
    """What Hydra reads through: of the library's own tree alone, what this process has read before.

    A command composes twice, once to check its words and once as Hydra runs it, and so does each job of a sweep.
    """
    directory = config_dir().resolve()
    if _places(config_search_path) == _places(create_config_search_path(str(directory))):
        return remembered_files(directory)
    return ConfigRepository(config_search_path=config_search_path)


def _places(config_search_path: ConfigSearchPath) -> list[tuple[str | None, str | None]]:
    return [(element.provider, element.path) for element in config_search_path.get_path()]


config_loader_impl.ConfigRepository = _repository  # type: ignore[misc, assignment]


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


_parser = cache(OverridesParser.create)


def parse(overrides: Sequence[str]) -> list[Override]:
    """Overrides under Hydra's grammar."""
    try:
        parsed = _parser().parse_overrides(list(overrides))
        for override in parsed:
            if not override.key_or_group:
                raise OverrideParseException(str(override.input_line), "the key is missing")
    except OverrideParseException as error:
        raise UserError(
            f"Cannot read the override {error.override!r}: {error.message.splitlines()[0]}. "
            "Write key=value, +key=value to add a key, ~key to remove one; quote values with special characters."
        ) from error
    return parsed
