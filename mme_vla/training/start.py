"""Starting a run from the weights of another policy."""

from pathlib import Path

from mme_vla.policy.mme import MMEPolicy
from mme_vla.training.checkpoint import checkpoints_in, resolve_checkpoint
from mme_vla.weights import transfer


def start_from(policy: MMEPolicy, source: str) -> str:
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
    folder = Path(source)
    if checkpoints_in(folder) or checkpoints_in(folder / "checkpoints"):
        source = str(resolve_checkpoint(folder))
    return f"weights from {source}: {transfer(policy, source)}"
