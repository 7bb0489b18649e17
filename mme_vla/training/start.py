"""Starting a run from the weights of another policy."""

from pathlib import Path

from mme_vla.errors import UserError
from mme_vla.policy.base import Policy
from mme_vla.policy.run_folders import newest_checkpoint
from mme_vla.weights import transfer

ASK, NONE = "ask", "none"


def weights_to_start_from(init_from: str | None) -> str | None:
    """What `init_from` names; None for random weights.

    Raises:
        UserError: a recipe that is meant for trained weights (`init_from: ask`) was given none.
    """
    if init_from == ASK:
        raise UserError(
            "This recipe starts from trained weights: give init_from=<checkpoint> (docs/weights.md lists the formats). "
            "To train the whole network from random weights, say so: init_from=none."
        )
    return None if init_from in (None, NONE) else init_from


def start_from(policy: Policy, source: str) -> str:
    """Copy every weight that `source` holds into a freshly built policy; only its memory's own may be new.

    Args:
        source: a checkpoint of any format (`mme_vla.weights`), or one of this library's run folders, which stands for
            its newest checkpoint.

    Returns:
        A sentence that says what was taken, what is new and what was left behind.

    Raises:
        UserError: no checkpoint, another tokenizer, a weight of another shape, or weights missing that are not the
            memory's.
    """
    found = newest_checkpoint(Path(source))
    source = source if found == Path(source) else str(found)
    return f"weights from {source}: {transfer(policy, source)}"
