"""`build_policy`: from a variant's name to a policy, through the same YAML files the
commands use.
"""

import copy
from collections.abc import Mapping, Set
from pathlib import Path
from typing import Any, cast

import torch
from omegaconf import DictConfig, OmegaConf

from mme_vla.backbone.building import shapes_only
from mme_vla.config.devices import find_device
from mme_vla.config.naming import words
from mme_vla.config.plugins import import_plugins, plugins_of
from mme_vla.embodiment import ROBOMME_JOINT, Embodiment
from mme_vla.errors import UserError, require
from mme_vla.integration.base import Integration, extension_points
from mme_vla.memory.base import MemoryModule, check_scorer
from mme_vla.policy.base import Policy
from mme_vla.policy.saving import policy_class
from mme_vla.policy.sections import SECTIONS, PolicySections
from mme_vla.processing.base import DEFAULT as DEFAULT_PROCESSOR
from mme_vla.processing.base import PolicyProcessor
from mme_vla.processing.prompt import PROMPTS
from mme_vla.registry import ENVS, MEMORIES, PROCESSORS


def build_memory(section: Mapping[str, Any], d_vision: int, grid: int, width: int) -> MemoryModule:
    """The memory of a configuration.

    Args:
        d_vision: width of a vision token.
        grid: side of a view's token grid.
        width: of the memory's own tokens.
    """
    memory: MemoryModule = MEMORIES.build(section, d_vision=d_vision, width=width)
    # A view's tokens must pool to the grid that the memory stores.
    sides = [side for side in range(1, grid + 1) if grid % side == 0]
    require(
        memory.storage.grid in sides,
        f"memory.grid={memory.storage.grid}: the backbone's {grid}×{grid} tokens a view pool to"
        f" {', '.join(map(str, sides))} a side.",
    )
    check_scorer(memory)
    return memory


def check_integrated(
    sections: PolicySections,
    integration: Integration,
    memory: MemoryModule | None,
    supports: Set[str],
) -> None:
    """Make sure that memory, integration and backbone fit together."""
    takes_tokens = integration.memory_width > 0
    if memory is None:
        if takes_tokens:
            raise UserError(
                "This configuration names an integration without a memory; name both, or neither"
                " for the memoryless policy."
            )
        return
    if takes_tokens and memory.budget == 0:
        raise UserError(
            f"The memory {sections.memory.get('name')!r} produces no tokens with"
            " these settings. Set integration=none or memory.states=true."
        )
    if not takes_tokens and memory.budget > 0:
        raise UserError(
            "This configuration names a memory without an integration; name both, or neither for"
            " the memoryless policy."
        )
    check_past(sections, memory, supports)
    if integration.memory_position != "time":
        return
    # The tokens have a time, and the backbone takes positions.
    if not memory.timed:
        raise UserError(
            "integration.memory_position=time: the tokens of the memory"
            f" {sections.memory['name']!r} have no time each. Take memory_position=slot, or a"
            " memory that is `timed`."
        )
    if "blocks" in extension_points(type(integration)) and "positions" not in supports:
        raise UserError(
            f"integration.memory_position=time: the backbone {sections.backbone['name']!r} has no"
            " place for blocks at positions of their own. Take memory_position=slot, or"
            " integration=modulator where it hosts that."
        )


def check_past(sections: PolicySections, memory: MemoryModule, supports: Set[str]) -> None:
    """Make sure that the backbone reads past views if the memory gives them."""
    if memory.past_view_spec is not None and "past" not in supports:
        raise UserError(
            f"The memory {sections.memory['name']!r} gives the vision tower past views along with"
            f" the current ones, and the tower of the backbone {sections.backbone['name']!r} sees"
            " one image at a time. Take another memory, a backbone that hosts `past` (pi05), or"
            " past states alone (memory.views=false)."
        )


def build_policy(
    name: str,
    *,
    device: str | torch.device = "cpu",
    seed: int = 42,
    config_dir: str | Path | None = None,
    **overrides: Any,
) -> Policy:
    """Build one of the variants with fresh weights.

    Args:
        name: a file of `configs/model`, such as `tokendrop_expert`.
        device: where to build; `meta` builds shapes only, at any size and at once, without
            processor.
        seed: of the fresh weights.
        config_dir: a folder of your own YAML files, searched beside the library's.
        overrides: a string selects a group's file (`backbone="pi05"`), a mapping sets keys below a
            section (`memory={"budget": 256}`), anything else sets a value;
            `memory=["framesamp", "ttt"]` joins memories.

    Returns:
        The policy in eval mode.

    Raises:
        UserError: an unknown name or key, or options that do not fit.

    >>> policy = build_policy("framesamp_modul", memory={"budget": 256})  # doctest: +SKIP
    """
    from mme_vla.config.composition import compose  # Hydra; a policy built in Python does without

    extra = [] if config_dir is None else [Path(config_dir)]
    config = compose("policy", policy_words(name, overrides), extra_dirs=extra)
    return build_from_config(config, device=device, seed=seed)


def policy_words(name: str, overrides: Mapping[str, Any]) -> list[str]:
    """Write what `build_policy` takes as Hydra overrides."""
    overridden = [f"model={name}"]
    for key, value in overrides.items():
        overridden += words(key, value)
    return overridden


def build_from_config(
    config: DictConfig,
    *,
    device: str | torch.device = "cpu",
    seed: int | None = None,
    fresh_backbone: bool = True,
) -> Policy:
    """Build the policy a composed configuration describes; other sections (data, train, …) are
    ignored.

    Args:
        fresh_backbone: False if a checkpoint is loaded next: the backbone's weights are not
            initialised.
    """
    values = policy_config(config)
    sections = {key: values[key] for key in SECTIONS if key in values}
    named = PolicySections.of(sections)
    limit = named.token_budget
    if limit is not None:
        # Memory and subgoal together stay within it.
        memory = named.memory.get("budget", 0)
        subgoal = named.processor.get("subgoal_length")
        if not PROMPTS[named.processor.get("prompt", "plain")].reads_subgoal:
            subgoal = 0
        if subgoal is None:
            raise UserError(
                f"token_budget={limit} needs a limit of the subgoal too: set"
                " processor.subgoal_length."
            )
        require(
            memory + subgoal <= limit,
            f"memory.budget={memory} and processor.subgoal_length={subgoal} make {memory + subgoal}"
            f" tokens, more than token_budget={limit}: lower one of them, or raise token_budget.",
        )
    if seed is None:
        seed = values.get("seed", 42)
    target = find_device(device)
    is_on_meta = target.type == "meta"
    # On meta the tokenizer is not needed.
    processor = None if is_on_meta else build_processor(sections)
    place = shapes_only() if is_on_meta else target
    with torch.random.fork_rng(devices=[]), place:
        torch.manual_seed(seed)
        policy: Policy = policy_class(sections).from_config(
            sections, processor, fresh_backbone=fresh_backbone
        )
    return policy.eval()


def policy_config(cfg: DictConfig) -> dict[str, Any]:
    """A command's configuration as plain values, with the embodiment of its `env` in place of
    RoboMME's in joint angles, which is the default and what models of prior methods select.

    Plugins are imported first: one of them may register the environment.
    """
    import_plugins(plugins_of(cfg, "the configuration"))
    env = cfg.get("env")
    robot = cfg.get("embodiment")
    if (
        env is not None
        and robot is not None
        and robot.name in (ROBOMME_JOINT.name, "robomme_joint_absolute")
    ):
        section = ENVS[env].embodiment
        if section is not None:
            cfg = copy.deepcopy(cfg)
            OmegaConf.set_struct(cfg, False)
            cfg.embodiment = Embodiment.from_dict(section).to_dict()
    values = OmegaConf.to_container(cfg, resolve=True)
    return cast("dict[str, Any]", values)


def build_processor(config: Mapping[str, Any]) -> PolicyProcessor:
    """The processor of a policy's configuration.

    Raises:
        UserError: it has none.
    """
    sections = PolicySections.of(config)
    if not sections.processor:
        raise UserError(
            f"No processor goes with the backbone {sections.backbone.get('name')!r}: under"
            " `defaults` of its file write `/processor@_global_.processor: tiny`, or the name of a"
            " configs/processor file of your own."
        )
    kind: type[PolicyProcessor] = PROCESSORS[sections.processor.get("name", DEFAULT_PROCESSOR)]
    return kind.from_sections(config)
