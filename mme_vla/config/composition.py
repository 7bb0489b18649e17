"""Composition of the YAML tree: every command and `build_policy` read the same Hydra tree.

Mistakes in overrides are found here, before any work starts, and raise one `UserError` with the near names.
"""

from collections.abc import Sequence
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from mme_vla.config import plugins
from mme_vla.config.hydra_tree import config_dir as config_dir
from mme_vla.config.hydra_tree import local_hydra, parse
from mme_vla.config.naming import join_memories, several_memories, true_name
from mme_vla.config.override_errors import COMPOSITION_ERRORS, ConfigTree
from mme_vla.errors import UserError


def compose(
    config_name: str,
    overrides: Sequence[str] = (),
    *,
    directory: Path | None = None,
    extra_dirs: Sequence[Path] = (),
) -> DictConfig:
    """Compose `config_name` under Hydra's override grammar; also from inside a running Hydra command.

    Args:
        config_name: a YAML of the tree's top level, without its suffix.
        overrides: as on the command line: `["model=framesamp_modul", "train.lr=1e-4"]`.
        directory: the tree; the library's own by default.
        extra_dirs: further trees searched after it, as `--config-dir` adds them.
    """
    trees = ((directory or config_dir()).resolve(), *extra_dirs)
    for folder in trees:
        if not folder.is_dir():
            raise UserError(f"The config folder {str(folder)!r} does not exist.")
    words = several_memories(overrides)
    with local_hydra(trees[0], trees[1:]) as engine:
        tree = ConfigTree(engine.config_loader, config_name, parse(words))
        try:
            cfg = join_memories(hydra.compose(config_name, words))
        except COMPOSITION_ERRORS as error:
            raise UserError(tree.explain(error)) from None
        tree.check_kinds()
    if {"name", "memory"} <= set(cfg):  # a tree without models has no such name
        cfg.name = true_name(cfg, config_name, tuple(folder.resolve() for folder in trees))
    return cfg


def name_under_hydra(*, _root_: DictConfig) -> str:
    """`${model_name:}` in a file of the tree: the composition's name, also while Hydra decides on the run's folder."""
    if not HydraConfig.initialized():
        return str(_root_.name)  # `compose` and the command have set it
    trees = command_trees()
    return true_name(_root_, str(HydraConfig.get().job.config_name), trees) if trees else str(_root_.name)


def command_trees() -> tuple[Path, ...]:
    """Folders of YAML files that the running command reads: its own, then those of `--config-dir`."""
    sources = [source for source in HydraConfig.get().runtime.config_sources if source.schema == "file"]
    # The command's own comes first, whatever the order in which Hydra searches.
    sources.sort(key=lambda source: source.provider != "main")
    return tuple(dict.fromkeys(Path(source.path).resolve() for source in sources))


OmegaConf.register_new_resolver("model_name", name_under_hydra, replace=True)


def import_plugins(cfg: DictConfig) -> None:
    """Import the modules that the user's configuration names under `plugins`; see `mme_vla.config.plugins`."""
    plugins.import_plugins(plugins.plugins_of(cfg, "the configuration"))
