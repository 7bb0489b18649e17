"""What tells one training from another: its seed, and digests of its recipe, its data and its
weights.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated, Any

from mme_vla.config.naming import digest, flat
from mme_vla.config.sections import Range, read_section
from mme_vla.policy.run_folders import newest_checkpoint
from mme_vla.utils import Sums

KEY = "training"
"""The section of a checkpoint's configuration that holds the identity of its training."""
NONE = "none"
"""What `init_from` says for random weights."""
# What changes an update, by the section that holds it.
_POLICY = ("augment", "compute_dtype", "stage", "subtask_weight")
_DATA = (
    "action_offset",
    "mask_padding",
    "jitter",
    "history_transforms",
    "weights",
    "narrow_ranges",
)
_TRAIN_WITHOUT_EFFECT = (
    "log_every",
    "val_every",
    "val_samples",
    "save_every",
    "keep",
    "parallel",
    "prefetch_gb",
    "workers",
    "open_loop_chunks",
    "self_check",
    "device",
    "seed",
)


@dataclass(frozen=True)
class TrainingIdentity:
    """The training that a checkpoint is of.

    seed: of fresh weights, data order and noise.
    recipe: digest of the settings that change an update.
    data: digest of the contents of the datasets and of their split.
    weights: digest of a checkpoint's weights.
    """

    seed: Annotated[int, Range(-(2**63), 2**63)] | None = None
    recipe: str | None = None
    data: str | None = None
    weights: str | None = None


def identify(
    config: Mapping[str, Any],
    content: Sequence[str],
) -> dict[str, Any]:
    """The identity of a training before it has weights, as plain values for the policy's
    configuration.

    Args:
        config: the plain configuration of a training.
        content: fingerprints of its datasets.
    """
    train = config.get("train") or {}
    policy = config.get("policy") or {}
    data = config.get("data") or {}
    settings = {
        "train": {key: train[key] for key in train if key not in _TRAIN_WITHOUT_EFFECT},
        "finetune": config.get("finetune"),
        "learning": config.get("learning"),
        "policy": {key: policy.get(key) for key in _POLICY},
        "data": {key: data.get(key) for key in _DATA},
    }
    recipe: dict[str, Any] = {}
    for key, value in flat(settings).items():
        if value not in (None, [], {}):
            recipe[key] = value
    source = config.get("init_from")
    if source is not None and source != NONE:
        # The weights to start from: their digest, or the end of their path or hub name.
        folder = newest_checkpoint(Path(source).expanduser())
        recipe["init_from"] = weights_digest(folder) or Path(source).name
    split = {
        "content": list(content),
        "val_fraction": data.get("val_fraction"),
        "val_episodes": data.get("val_episodes"),
    }
    identity = TrainingIdentity(int(config["seed"]), digest(recipe, 12), digest(split, 12))
    return {key: value for key, value in asdict(identity).items() if value is not None}


def identity_of(config: Mapping[str, Any]) -> TrainingIdentity | None:
    """The training that a policy's configuration names; None where it was not trained, or by an
    earlier version.
    """
    section = config.get(KEY)
    if section is None:
        return None
    return read_section(TrainingIdentity, section, KEY)


def without_seed(training: TrainingIdentity | None) -> TrainingIdentity | None:
    """What the trainings of one recipe share, whatever their seeds."""
    return None if training is None else replace(training, seed=None, weights=None)


def weights_digest(folder: Path) -> str | None:
    """Twelve letters of the checksums of a checkpoint's weights; None where it has no checksums."""
    from mme_vla.policy.tensor_files import list_weight_files  # PyTorch, which results do without

    table = Sums(folder).table
    if not table:
        return None
    sums = [table[name] for name in sorted(list_weight_files(folder)) if name in table]
    if not sums:
        return None
    return digest({"weights": sums}, 12)
