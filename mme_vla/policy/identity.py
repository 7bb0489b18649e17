"""What records, checkpoints and servers call a policy."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from mme_vla.config.naming import DEFAULT_BUDGET
from mme_vla.policy.saving import composition_digest
from mme_vla.policy.sections import PolicySections
from mme_vla.policy.training_identity import TrainingIdentity, identity_of

if TYPE_CHECKING:
    from mme_vla.policy.base import Policy


@dataclass(frozen=True)
class PolicyIdentity:
    """What tells a policy from others in records.

    model: its name.
    checkpoint: its step, or a name.
    memory_budget: memory tokens; None where they are `DEFAULT_BUDGET`.
    composition: `composition_digest` of its configuration.
    training: the training that its weights are of. Both are None where they are not known.
    """

    model: str
    checkpoint: int | str
    memory_budget: int | None = None
    composition: str | None = None
    training: TrainingIdentity | None = None


def identify_policy(policy: "Policy", name: str | None, source: str | None) -> PolicyIdentity:
    """The identity of a policy that this process has loaded.

    Args:
        name: of the model; None for the policy's own.
        source: where the weights are from; None for fresh ones.
    """
    budget = None
    if policy.memory is not None and policy.memory.budget != DEFAULT_BUDGET:
        budget = policy.memory.budget
    return PolicyIdentity(
        model=name or str(PolicySections.of(policy.config).name or "policy"),
        checkpoint=checkpoint_label(source),
        memory_budget=budget,
        composition=composition_digest(policy.config),
        training=identity_of(policy.config),
    )


def checkpoint_label(source: str | None) -> int | str:
    """What records call a checkpoint: its step where its name ends in one, else its name."""
    if source is None:
        return "untrained"
    name = Path(source).name
    step = re.search(r"(?:^|[_-])(\d+)$", name)
    return int(step[1]) if step else name
