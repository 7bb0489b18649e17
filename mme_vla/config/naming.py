"""The name of a composition, found among the models of the tree it is composed from."""

import functools
import json
from pathlib import Path

from omegaconf import DictConfig, ListConfig, OmegaConf

from mme_vla.config.hydra_engine import is_fixed, own_hydra, parse
from mme_vla.config.mistakes import COMPOSITION_ERRORS, ConfigTree
from mme_vla.config.variant import DECISIVE, POLICY, Sections, decisive, may_be_of, variant_name
from mme_vla.config.words import join_memories, literal
from mme_vla.errors import UserError

_names: dict[str, str] = {}
"""Names of compositions of the library's own tree by what decides on them; finding one takes 60 ms a model."""


def _what_names(cfg: DictConfig) -> str:
    return json.dumps([str(cfg.name), decisive(cfg)], sort_keys=True, default=str)


def remember_name(cfg: DictConfig, tree: ConfigTree) -> None:
    """Spare `true_name` the search where a composition is a model as its file says, whatever it is trained with."""
    model = [str(choice.input_line) for choice in tree.choices] == [f"model={cfg.name}"]
    values = {str(value.key_or_group).partition(".")[0] for value in tree.values}
    if tree.fixed and model and not values & {*DECISIVE, "policy", "name"}:
        _names[_what_names(cfg)] = str(cfg.name)


def true_name(cfg: DictConfig, config_name: str, trees: tuple[Path, ...]) -> str:
    """What a composition is called (`mme_vla.config.variant`).

    Args:
        config_name: what was composed. trees: folders of YAML files, the library's first.
    """
    if isinstance(cfg.get("memory"), ListConfig):
        cfg = join_memories(cfg.copy())
    if not is_fixed(trees, ()):
        return found_name(cfg, config_name, trees)
    key = _what_names(cfg)
    if key not in _names:
        _names[key] = found_name(cfg, config_name, trees)
    return _names[key]


def found_name(cfg: DictConfig, config_name: str, trees: tuple[Path, ...]) -> str:
    """`true_name`, found by comparing the models of these trees."""
    given = str(cfg.name)
    config_name = "policy" if (trees[0] / "policy.yaml").is_file() else config_name  # the least that holds a model
    mine = {file.stem for tree in trees[1:] for file in (tree / "model").glob("*.yaml")}
    theirs = {file.stem for file in (trees[0] / "model").glob("*.yaml")} - mine

    def composed(words: tuple[str, ...], searched: tuple[Path, ...]) -> tuple[str, Sections] | None:
        return (_cached_sections if is_fixed(searched, words) else _composed_sections)(config_name, words, searched)

    def parts() -> Sections | None:
        chosen = {group: cfg[group] for group in ("memory", "integration") if group in cfg}
        for group, section in chosen.items():
            if section and not section.get("name"):
                raise UserError(
                    f"The section `{group}` has no name, only {', '.join(section)}. Choose one: {group}=<name>; its "
                    f"keys are set beside it, {group}.<key>=<value>."
                )
        words = [f"{group}={section.name if section else 'none'}" for group, section in chosen.items()]
        if POLICY in decisive(cfg):  # another kind of policy has its own processor beside its parts
            words.insert(0, f"model={given}")
        if "members" in (chosen.get("memory") or {}):
            words.append(f"memory.members={literal(OmegaConf.to_container(chosen['memory'].members, resolve=True))}")
        found = composed(tuple(words), trees)
        return None if found is None else found[1]

    sections = decisive(cfg)

    def reference(model: str) -> tuple[str, Sections] | None:
        if model in theirs and not may_be_of(trees[0] / "model" / f"{model}.yaml", sections):
            return None
        return composed((f"model={model}",), trees[:1] if model in theirs else trees)

    return variant_name(str(cfg.name), sections, mine | theirs, reference, parts)


def _composed_sections(
    config_name: str, overrides: tuple[str, ...], trees: tuple[Path, ...]
) -> tuple[str, Sections] | None:
    """Name and decisive keys of a composition; None where these words do not compose."""
    with own_hydra(trees[0], trees[1:]) as engine:
        try:
            tree = ConfigTree(engine.config_loader, config_name, parse(overrides), is_fixed(trees, overrides))
            cfg = join_memories(tree.composed(overrides))
            return str(cfg.name), decisive(cfg)
        except (*COMPOSITION_ERRORS, UserError):
            return None


_cached_sections = functools.cache(_composed_sections)
