"""Composition of the YAML tree: every command and `build_policy` read the same Hydra tree.

Mistakes in overrides are found here, before any work starts, and raise one `UserError` with the
near names.
"""

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import hydra
from hydra import version
from hydra._internal.hydra import Hydra
from hydra._internal.utils import create_config_search_path
from hydra.core.config_search_path import ConfigSearchPath, SearchPathQuery
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.core.plugins import Plugins
from hydra.core.utils import JobRuntime
from hydra.errors import OverrideParseException
from hydra.plugins.search_path_plugin import SearchPathPlugin
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf, open_dict
from omegaconf.errors import InterpolationKeyError, InterpolationResolutionError

from mme_vla.config import plugins
from mme_vla.config.naming import expand_overrides, name_composition
from mme_vla.config.override_errors import (
    COMPOSITION_ERRORS,
    FORMS,
    ConfigTree,
    badly_spaced,
)
from mme_vla.config.trees import config_dir, library_trees
from mme_vla.errors import UserError, require

VERSION_BASE = "1.3"


def _load_installed_plugins() -> None:
    """Load Hydra's plugins, but none of a folder `hydra_plugins` of the current directory."""
    before = list(sys.path)
    here = Path.cwd().resolve()
    sys.path[:] = [folder for folder in sys.path if Path(folder).resolve() != here]
    try:
        Plugins.instance()
    finally:
        sys.path[:] = before


_load_installed_plugins()


class ExtensionTrees(SearchPathPlugin):
    """Hydra searches the folders of extensions after the library's own."""

    PROVIDER = "mme_vla.extensions"

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        """Append the folders, where the library's own tree is what is composed."""
        core = str(config_dir().resolve())
        paths = [path.path for path in search_path.get_path() if path.provider == "main"]
        if any(str(path).removeprefix("file://") == core for path in paths):
            for folder in library_trees()[1:]:
                search_path.append(self.PROVIDER, f"file://{folder.resolve()}")


Plugins.instance().register(ExtensionTrees)


@contextmanager
def local_hydra(directory: Path, extra_dirs: Sequence[Path]) -> Iterator[Hydra]:
    """Hydra's compose API with further folders, handing back the Hydra that a surrounding command
    runs under.
    """
    base = version.VersionBase.instance()
    outer, outer_base = GlobalHydra.instance().hydra, base.version_base
    GlobalHydra.instance().clear()
    search_path = create_config_search_path(str(directory))
    for folder in extra_dirs:
        search_path.prepend(
            "command-line", f"file://{folder.resolve()}", anchor=SearchPathQuery(provider="schema")
        )
    try:
        version.setbase(VERSION_BASE)
        name = JobRuntime.instance().get("name")  # a sweep's next job is still to be called by it
        yield Hydra.create_main_hydra2(task_name=name, config_search_path=search_path)
    finally:
        GlobalHydra.instance().hydra = outer
        base.version_base = outer_base


def parse(
    overrides: Sequence[str], explain_bare: Callable[[Sequence[str], int], str] | None = None
) -> list[Override]:
    """Overrides under Hydra's grammar.

    explain_bare: what to say of a word without `=`, called with all words and its number.
    """
    words = list(overrides)
    try:
        parsed = OverridesParser.create().parse_overrides(words)
        for override in parsed:
            if not override.key_or_group:
                raise OverrideParseException(str(override.input_line), "the key is missing")
    except OverrideParseException as error:
        reason = None
        if error.override in words:
            number = words.index(error.override)
            reason = badly_spaced(words, number)
            is_bare = "=" not in error.override and not error.override.startswith("~")
            if reason is None and is_bare and explain_bare is not None:
                reason = explain_bare(words, number)
        if reason is None:
            detail = error.message.splitlines()[0]
            if detail.startswith("Error parsing"):  # says no more than the word itself
                detail = "it is no setting"
            reason = f"Cannot read the override {error.override!r}: {detail}. {FORMS}"
        raise UserError(reason) from error
    return parsed


def compose(
    config_name: str,
    overrides: Sequence[str] = (),
    *,
    directory: Path | None = None,
    extra_dirs: Sequence[Path] = (),
) -> DictConfig:
    """Compose `config_name` under Hydra's override grammar; also from inside a running Hydra
    command.

    Args:
        config_name: a YAML of the tree's top level, without its suffix.
        overrides: as on the command line: `["model=framesamp_modul", "train.lr=1e-4"]`.
        directory: the tree; the library's own by default.
        extra_dirs: further trees searched after it, as `--config-dir` adds them.
    """
    trees = ((directory or config_dir()).resolve(), *extra_dirs)
    for folder in trees:
        require(folder.is_dir(), f"The config folder {str(folder)!r} does not exist.")
    words = expand_overrides(overrides)
    with local_hydra(trees[0], trees[1:]) as engine:
        tree = ConfigTree(engine.config_loader, config_name, parse(words))
        try:
            cfg = hydra.compose(config_name, words)
            name_composition(cfg, words)
        except COMPOSITION_ERRORS as error:
            raise UserError(tree.explain(error)) from None
        tree.check_kinds()
    for group in ("memory", "integration"):
        section = cfg.get(group)
        require(
            not section or section.get("name"),
            f"The section `{group}` has no name, only {', '.join(map(str, section or ()))}. Choose"
            f" one: {group}=<name>; its keys are set beside it, {group}.<key>=<value>.",
        )
    join_plugins(cfg, config_name, trees, words)
    return cfg


def command_trees() -> tuple[Path, ...]:
    """Folders of YAML files that the running command reads: its own, then those of
    `--config-dir`.
    """
    paths = {source.provider: source.path for source in HydraConfig.get().runtime.config_sources}
    trees = [Path(paths[name]).resolve() for name in ("main", "command-line") if name in paths]
    return tuple(dict.fromkeys(trees))


def join_plugins(
    cfg: DictConfig, config_name: str, trees: Sequence[Path], overrides: Sequence[str]
) -> None:
    """Have `plugins` name the modules of every file that takes part; Hydra itself keeps the last
    file's list.

    A list on the command line counts alone. The library's own files name no plugins.

    trees: folders of YAML files, the library's first.
    overrides: those of the composition.
    """
    if not trees[1:] or any(word.lstrip("+").startswith("plugins=") for word in overrides):
        return
    with local_hydra(trees[0], trees[1:]) as engine:
        loader = engine.config_loader
        parts = loader.compute_defaults_list(config_name, list(overrides), RunMode.RUN).defaults
        names: dict[str, None] = {}  # in order, each once
        for part in parts:
            if part.package:
                continue
            loaded = loader.repository.load_config(part.config_path)  # type: ignore[attr-defined]
            if loaded is not None:
                names |= dict.fromkeys(plugins.plugins_of(loaded.config, loaded.path))
    if names:
        with open_dict(cfg):
            cfg.plugins = list(names)


def resolved(cfg: DictConfig) -> dict[str, Any]:
    """A configuration as resolved plain values.

    Raises:
        UserError: a value refers to a key that is not there, or not set.
    """
    try:
        values = OmegaConf.to_container(cfg, resolve=True)
    except InterpolationResolutionError as error:
        detail = str(error).splitlines()[0]
        text = f"The value of {error.full_key} refers to another one: {detail.rstrip('.')}."
        if isinstance(error, InterpolationKeyError):
            text += " Add that key to your YAML file; a model's file says `name: <its name>`."
        raise UserError(text) from None
    return {str(key): value for key, value in values.items()}  # type: ignore[union-attr]
