"""Which parameters learn when: first both looks and the encoder's adapters, then the memory on top of them."""

import re

from torch import nn

from mme_vla.errors import UserError, brief, did_you_mean

STAGES = {
    "first": r"coarse\.|fine\.|encoder\.vision\..*\.linear_[ab]_[qv]\.",
    "memory": r"memory\.|encoder\.fine\.|encoder\.middle\.|coarse\.decoder\.",
}
"""Stage → pattern of the parameters that learn in it, as the authors froze the others."""


def check_stage(stage: str) -> str:
    """Return the stage's name.

    Raises:
        UserError: there is no such stage.
    """
    if stage not in STAGES:
        raise UserError(f"Unknown training stage {brief(stage)} of SAM2Act+. {did_you_mean(str(stage), STAGES)}")
    return stage


def select_trained(network: nn.Module, stage: str) -> list[nn.Parameter]:
    """Freeze what a stage does not train, and return what it does.

    Raises:
        UserError: there is no such stage.
    """
    check_stage(stage)
    trained = []
    for name, parameter in network.named_parameters():
        parameter.requires_grad_(re.match(STAGES[stage], name) is not None)
        if parameter.requires_grad:
            trained.append(parameter)
    return trained
