"""`build_policy`: from a variant's name to a policy, through the same YAML files the commands use."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf

from mme_vla.backbone.shapes_only import shapes_only
from mme_vla.config.composition import compose, import_plugins
from mme_vla.config.words import words
from mme_vla.errors import UserError
from mme_vla.policy.base import Policy
from mme_vla.policy.kinds import policy_class
from mme_vla.processing.base import DEFAULT, PolicyProcessor
from mme_vla.processing.prompt import PROMPTS
from mme_vla.registry import PROCESSORS

SECTIONS = (
    "name", "plugins", "embodiment", "backbone", "memory", "integration", "policy", "processor", "subgoal_text",
    "token_budget",
)  # fmt: skip


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
        device: where to build; `meta` builds shapes only, at any size and at once, without processor.
        seed: of the fresh weights.
        config_dir: a folder of your own YAML files, searched beside the library's.
        overrides: a string selects a group's file (`backbone="pi05"`), a mapping sets keys below a section
            (`memory={"budget": 256}`), anything else sets a value; `memory=["framesamp", "ttt"]` joins memories.

    Returns:
        The policy in eval mode.

    Raises:
        UserError: an unknown name or key, or options that do not fit.

    >>> policy = build_policy("framesamp_modul", memory={"budget": 256})  # doctest: +SKIP
    """
    extra = [] if config_dir is None else [Path(config_dir)]
    config = compose("policy", policy_words(name, overrides), extra_dirs=extra)
    return build_from_config(config, device=device, seed=seed)


def policy_words(name: str, overrides: Mapping[str, Any]) -> list[str]:
    """Write what `build_policy` takes as Hydra overrides."""
    return [f"model={name}", *(word for key, value in overrides.items() for word in words(key, value))]


def build_from_config(
    config: DictConfig,
    *,
    device: str | torch.device = "cpu",
    seed: int | None = None,
    fresh_backbone: bool = True,
) -> Policy:
    """Build the policy a composed configuration describes; other sections (data, train, …) are ignored.

    Args:
        fresh_backbone: False where a checkpoint is loaded next: π0.5's own weights are then not drawn.
    """
    import_plugins(config)
    plain = OmegaConf.to_container(config, resolve=True)
    assert isinstance(plain, dict)
    sections = {key: plain[key] for key in SECTIONS if key in plain}
    check_token_budget(sections)
    # Shapes need no words: on meta the full-size tokenizer is not asked for.
    bare = torch.device(device).type == "meta"
    processor = None if bare else build_processor(sections)
    with torch.random.fork_rng(devices=[]), shapes_only() if bare else torch.device(device):
        torch.manual_seed(plain.get("seed", 42) if seed is None else seed)
        policy: Policy = policy_class(sections).from_config(sections, processor, fresh_backbone=fresh_backbone)
    return policy.eval()


def check_token_budget(sections: Mapping[str, Any]) -> None:
    """Make sure that memory and subgoal together stay within `token_budget`, where there is one.

    Raises:
        UserError: they do not, or the subgoal has no limit.
    """
    budget = sections.get("token_budget")
    if budget is None:
        return
    memory = (sections.get("memory") or {}).get("budget", 0)
    reads = PROMPTS[sections["processor"].get("prompt", "plain")].reads_subgoal
    subgoal = sections["processor"].get("subgoal_length") if reads else 0
    if subgoal is None:
        raise UserError(f"token_budget={budget} needs a limit of the subgoal too: set processor.subgoal_length.")
    if memory + subgoal > budget:
        raise UserError(
            f"memory.budget={memory} and processor.subgoal_length={subgoal} make {memory + subgoal} tokens, more than "
            f"token_budget={budget}: lower one of them, or raise token_budget."
        )


def build_processor(sections: Mapping[str, Any]) -> PolicyProcessor:
    """Build the processor of a composed configuration (`processor.name`), at its backbone's sizes.

    Raises:
        UserError: no processor, an unknown one or setting, or a tokenizer that cannot be had.
    """
    if not sections.get("processor"):
        raise UserError(
            f"No processor goes with the backbone {sections['backbone'].get('name')!r}: under `defaults` of its file "
            "write `/processor@_global_.processor: tiny`, or the name of a configs/processor file of your own."
        )
    kind: type[PolicyProcessor] = PROCESSORS[sections["processor"].get("name", DEFAULT)]
    return kind.from_sections(sections)
