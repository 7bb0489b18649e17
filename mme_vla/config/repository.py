"""Hydra's repository of YAML files, where those that do not change are read once a process."""

import copy
import pickle
from functools import cache
from pathlib import Path
from typing import Self

from hydra._internal.config_repository import ConfigRepository
from hydra._internal.utils import create_config_search_path
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.object_type import ObjectType
from hydra.plugins.config_source import ConfigResult


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
            found = super().load_config(config_path)
            if found is None:
                return None
            self._read[config_path] = pickle.dumps(found)
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
