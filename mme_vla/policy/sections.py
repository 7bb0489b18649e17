"""The sections of a policy's configuration, by name: what `config.json` may hold."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Self

from mme_vla.errors import brief, require


@dataclass(frozen=True)
class PolicySections:
    """A policy's configuration. Each part's own class reads its section.

    name: of the model.
    plugins: modules that register its parts.
    policy: the policy's class and options.
    subgoal_text: how subgoals of a dataset become text.
    token_budget: most tokens of memory and subgoal together.
    adapters: LoRA adapters that the weights have.
    training: the training that the weights are of.
    data: how it read recordings: `action_offset`.
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
    data: Mapping[str, Any] = field(default_factory=dict)
    card: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def of(cls, config: Mapping[str, Any], source: str = "") -> Self:
        """Name the sections of a configuration; null, or an empty one, means the same as a
        missing one.

        Args:
            source: where the configuration is from, for messages.

        Raises:
            UserError: a section is no mapping.
        """
        values: dict[str, Any] = {}
        for name in KNOWN_SECTIONS:
            value = config.get(name)
            if name not in _VALUES:
                value = value or None
                where = f"{source}: " if source else ""
                require(
                    value is None or isinstance(value, Mapping),
                    f"{where}{name}={brief(value)} must be a section of keys.",
                )
            if value is not None:
                values[name] = value
        return cls(**values)


_VALUES = ("name", "plugins", "token_budget")
"""Fields that are no sections."""
KNOWN_SECTIONS = tuple(spec.name for spec in fields(PolicySections))
SECTIONS = KNOWN_SECTIONS[: KNOWN_SECTIONS.index("adapters")]
"""Sections that build a policy. The others describe its weights."""
