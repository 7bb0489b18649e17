"""From the section `data` to the two sides of the split, with statistics and vision caches in
place.
"""

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

import numpy as np

from mme_vla.config.naming import digest
from mme_vla.data.cache import COMMAND
from mme_vla.data.cache_building import ensure_cache
from mme_vla.data.columns import FACT, FACT_VISIBLE
from mme_vla.data.dataset import ColumnNames, TrainingDataset
from mme_vla.data.episodes import EpisodeSource
from mme_vla.data.lerobot_files import FACTS, SIDE_FILE, content_fingerprint
from mme_vla.data.sources import (
    Split,
    default_val_episodes,
    listed_sources,
    open_sources,
    split_episodes,
)
from mme_vla.data.statistics import compute_norm_stats
from mme_vla.errors import counted, require
from mme_vla.memory.perturbation import build_transforms
from mme_vla.policy.base import Policy
from mme_vla.policy.sections import PolicySections
from mme_vla.processing.base import STATS_FILE
from mme_vla.processing.normalise import NormStats
from mme_vla.processing.prompt import SubgoalText
from mme_vla.registry import SIDE_FILES, TRAINING_SETS
from mme_vla.training.settings import DataSettings
from mme_vla.types import labels_read
from mme_vla.utils import checked_file


@dataclass(frozen=True)
class SplitData:
    """The two sides of the split.

    train, val: datasets of training samples and of held-out ones: `TrainingDataset`, or what
        `TRAINING_SETS` builds for this kind of samples. val is None where nothing is held out.
    """

    train: Any
    val: Any | None
    content: list[str]
    """A fingerprint of each dataset's content."""
    side_files: list[dict[str, str]]
    """Of each dataset: digests of the files beside its content that the samples follow from."""


def prepare_data(
    policy: Policy,
    data: DataSettings,
    seed: int,
    stats_from: Path | None = None,
    cache_command: str = COMMAND,
    say: Callable[[str], None] = print,
    encoder: str | None = None,
) -> SplitData:
    """Open and check the datasets, give the policy's processor its statistics, and build or open
    the vision caches.

    Args:
        policy: with the vision weights it will train with.
        data: the section `data` of a configuration.
        seed: of statistics that are estimated from a part, and of what training draws.
        cache_command: what to tell the user to run where a cache is missing.
        stats_from: a checkpoint folder whose statistics to use; otherwise they are computed over
            the training split.
        say: takes a line for the user.
        encoder: the policy's `vision_fingerprint`, where this process does not hold the weights; by
            default asked here.
    """
    require(
        data.weights is None or policy.loss_weights is not None,
        f"data.weights={data.weights}: {type(policy).__name__} does not weigh samples. Set"
        " data.weights=null.",
    )
    sources = open_sources(data.sources, policy.embodiment)
    val_episodes: Sequence[int | str] | None = data.val_episodes
    if val_episodes is None:
        val_episodes = default_val_episodes(sources)
    split = split_episodes(sources, data.val_fraction, val_episodes)

    processor = policy.require_processor()
    if stats_from is None:
        processor.stats = compute_statistics(policy, data, sources, split, seed)
    else:
        processor.stats = NormStats.load(checked_file(stats_from, STATS_FILE))
    caches = None
    if policy.memory is not None:
        # Each dataset's is built first where it is missing and small enough.
        caches = []
        for source in sources:
            cache = ensure_cache(
                source,
                policy.memory,
                policy.encode_frames,
                encoder or policy.vision_fingerprint(),
                root=data.cache.root,
                dtype=str(policy.info.history_dtype).removeprefix("torch."),
                max_build_frames=data.cache.max_build_frames,
                batch_size=data.cache.batch_size,
                command=cache_command,
            )
            caches.append(cache)
    train = _samples(policy, data, sources, caches, split.train, seed)
    held_out = sum(map(len, split.val))
    val = None
    if held_out:
        val = _samples(policy, data, sources, caches, split.val, seed, held_out=True)
    listed_names = ", ".join(source.name for source in sources)
    say(
        f"data {listed_names}: {counted(len(train), 'training step')} in"
        f" {counted(sum(map(len, split.train)), 'episode')},"
        f" {counted(0 if val is None else len(val), 'held-out step')} in {held_out}"
    )
    names = {*labels_read(*policy.modules()), data.weights}
    side_files = []
    for entry, source in zip(listed_sources(data.sources), sources, strict=True):
        in_tables = entry.exec_starts is None
        side_files.append(_side_files(source, in_tables, names, processor.samples.kind))
    return SplitData(train, val, [source.fingerprint for source in sources], side_files)


def _side_files(
    source: EpisodeSource, in_tables: bool, names: Collection[str | None], kind: str
) -> dict[str, str]:
    """Digests of the files beside a dataset's content that training samples follow from.

    in_tables: the tables say where execution begins.
    names: labels and weights that are read.
    kind: of the samples.
    """
    digests = {}
    if not in_tables:
        digests["exec_starts"] = sha256(source.exec_starts.tobytes()).hexdigest()[:16]
    if FACT in names or FACT_VISIBLE in names:
        digests[FACTS] = sha256((source.root / FACTS).read_bytes()).hexdigest()[:16]
    if source.robot.action.choice or kind in SIDE_FILES:
        digests[SIDE_FILE] = digest({"episodes": source.records}, 16)
    if kind in SIDE_FILES:
        files = [SIDE_FILES[kind].file_of(source.root, episode) for episode in range(len(source))]
        parts = [file.relative_to(source.root).as_posix() for file in files]
        digests[kind] = content_fingerprint(source.root, parts)
    return digests


def compute_statistics(
    policy: Policy, data: DataSettings, sources: list[EpisodeSource], split: Split, seed: int
) -> NormStats:
    """The statistics of the training split that the policy's processor normalises with."""
    processor = policy.require_processor()
    spec = processor.stats_spec
    narrow: str = data.narrow_ranges or "refuse"
    if spec.bounds == "extremes":
        narrow = "ignore"  # nothing lies beyond them
    return compute_norm_stats(
        sources,
        split.train,
        spec.horizon or processor.embodiment.action.horizon,
        data.action_offset,
        seed,
        policy.embodiment,
        every=spec.every,
        extremes=spec.extremes,
        exact=spec.exact,
        video=spec.video,
        narrow=narrow,
    )


def _samples(
    policy: Policy,
    data: DataSettings,
    sources: list[EpisodeSource],
    caches: list[Any] | None,
    episodes: list[np.ndarray],
    seed: int,
    held_out: bool = False,
) -> Any:
    """The samples of one side. Held-out ones are never changed at random."""
    processor = policy.require_processor()
    # A memory has labels of its own: they are not the network's.
    memory_parts: set[Any] = set()
    if policy.memory is not None:
        memory_parts = set(policy.memory.modules())
    labels = labels_read(*(part for part in policy.modules() if part not in memory_parts))
    options: dict[str, Any] = {
        "episodes": episodes,
        "action_offset": data.action_offset,
        "mask_padding": data.mask_padding,
        "jitter": data.jitter and not held_out,
        "subgoal": SubgoalText.from_config(PolicySections.of(policy.config).subgoal_text),
        "columns": ColumnNames(labels, data.weights),
        "seed": seed,
        "transforms": () if held_out else build_transforms(data.history_transforms),
    }
    kind = processor.samples.kind
    if kind != "steps":
        build = TRAINING_SETS[kind]
        return build(sources, processor, policy, caches, sampled=not held_out, **options)
    return TrainingDataset(sources, processor, policy.memory, caches, **options)


def check_frozen(policy: Policy, freeze_vision: bool) -> None:
    """Refuse to train the vision tower under a memory, whose cached tokens would not follow it."""
    require(
        policy.memory is None or freeze_vision,
        "finetune.freeze_vision=false changes the vision tower while the memory reads tokens that"
        " were cached before: at test time it would see other tokens than in training. Keep it"
        " frozen (finetune.freeze_vision=true), or train without a memory.",
    )
