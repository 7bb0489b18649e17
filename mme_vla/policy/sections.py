"""The sections of a policy's configuration, by name: what `config.json` may hold."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Self


@dataclass(frozen=True)
class PolicySections:
    """A policy's configuration. Each part's own class reads its section.

    name: of the model. plugins: modules that register its parts. policy: the policy's class and
    options. subgoal_text: how subgoals of a dataset become text. token_budget: most tokens of
    memory and subgoal together.
    adapters: LoRA adapters that the weights have. training: the training that the weights are of.
    card: texts for the model card.
    """

    name: str | None = None
    plugins: Any = None
    embodiment: Mapping[str, Any] = field(default_factory=dict)
    backbone: Mapping[str, Any] = field(default_factory=dict)
    memory: Mapping[str, Any] = field(default_factory=dict)
    integration: Mapping[str, Any] = field(default_factory=dict)
    policy: Mapping[str, Any] = field(default_factory=dict)
    processor: Mapping[str, Any] = field(default_factory=dict)
    subgoal_text: Mapping[str, Any] = field(default_factory=dict)
    token_budget: int | None = None
    adapters: Mapping[str, Any] = field(default_factory=dict)
    training: Mapping[str, Any] = field(default_factory=dict)
    card: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def of(cls, config: Mapping[str, Any]) -> Self:
        """Name the sections of a configuration; null means the same as a missing one."""
        values = {name: config[name] for name in KNOWN_SECTIONS if config.get(name) is not None}
        return cls(**values)


KNOWN_SECTIONS = tuple(spec.name for spec in fields(PolicySections))
SECTIONS = KNOWN_SECTIONS[: KNOWN_SECTIONS.index("adapters")]
"""Sections that build a policy. The others describe its weights."""
