"""Starting a run from the weights of another policy."""

from pathlib import Path

from mme_vla.errors import UserError
from mme_vla.policy import MMEPolicy
from mme_vla.pretrained import load_tensors
from mme_vla.processing.processor import Processor
from mme_vla.training.checkpoint import resolve_checkpoint


def start_from(policy: MMEPolicy, folder: str | Path) -> str:
    """Copy every weight that `folder` holds into a freshly built policy; only its memory's own may be new.

    Args:
        folder: a checkpoint or run folder of this library: of another variant, or of the same.

    Returns:
        A sentence that says what was taken, what is new and what was left behind.

    Raises:
        UserError: no checkpoint, another tokenizer, a weight of another shape, or weights missing that are not the
            memory's.
    """
    checkpoint = resolve_checkpoint(Path(folder))
    theirs, ours = load_tensors(checkpoint), policy.state_dict()
    tokenizer = Processor.load(checkpoint).tokenizer
    if tokenizer.fingerprint != policy.require_processor().tokenizer.fingerprint:
        raise UserError(
            f"init_from={checkpoint} was trained with the tokenizer {tokenizer.spec!r}, this run uses another one: its "
            "ids would mean other words. Set processor.tokenizer to that one."
        )
    shared = sorted(ours.keys() & theirs.keys())
    misshapen = [
        f"{name} {tuple(theirs[name].shape)} → {tuple(ours[name].shape)}"
        for name in shared
        if theirs[name].shape != ours[name].shape
    ]
    if misshapen:
        raise UserError(
            f"init_from={checkpoint}: {len(misshapen)} weights have another shape, such as {', '.join(misshapen[:4])}. "
            "Choose the same backbone (and memory sizes)."
        )
    own = (".memory.", ".integration.", *(f".experts.{name}." for name in policy.integration.extra_experts()))
    new = sorted(ours.keys() - theirs.keys())
    lost = [name for name in new if not any(part in f".{name}" for part in own)]
    if lost:
        raise UserError(
            f"init_from={checkpoint} lacks {len(lost)} weights that are not the memory's own, such as "
            f"{', '.join(lost[:4])}: it belongs to another kind of policy."
        )
    policy.load_state_dict({name: theirs[name] for name in shared}, strict=False)
    dropped = len(theirs) - len(shared)
    return (
        f"weights from {checkpoint}: {len(shared)} tensors taken, {len(new)} new ({_groups(new)})"
        + (f", {dropped} left behind ({_groups(sorted(theirs.keys() - ours.keys()))})" if dropped else "")
    )  # fmt: skip


def _groups(names: list[str]) -> str:
    """Tensor names in short: numbers become *, and each remaining stem is named once."""
    stems = {".".join("*" if part.isdigit() else part for part in name.split(".")[:-1]) for name in names}
    return ", ".join(sorted(stems)) or "none"
