"""From the section `data` to the two sides of the split, with statistics and vision caches in
place.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mme_vla.data.cache import COMMAND
from mme_vla.data.cache_building import ensure_cache
from mme_vla.data.dataset import GroupDataset, TrainingDataset
from mme_vla.data.sources import default_val_episodes, open_sources, split_episodes
from mme_vla.data.statistics import NARROW, check_ranges, compute_norm_stats
from mme_vla.errors import UserError, check_choice, require
from mme_vla.memory.perturbation import build_transforms
from mme_vla.policy.base import Policy
from mme_vla.processing.base import STATS_FILE
from mme_vla.processing.normalise import NormStats
from mme_vla.processing.prompt import SubgoalText
from mme_vla.registry import TRAINING_SETS
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


def prepare_data(
    policy: Policy,
    data: Mapping[str, Any],
    seed: int,
    stats_from: Path | None = None,
    cache_command: str = COMMAND,
    say: Callable[[str], None] = print,
    encoder: str | None = None,
) -> SplitData:
    """Open and check the datasets, give the policy's processor its statistics, and build or open
    the vision caches.

    Args:
        policy: with the vision weights it will train with. data: the section `data` of a
            configuration.
        cache_command: what to tell the user to run where a cache is missing.
        stats_from: a checkpoint folder whose statistics to use; otherwise they are computed over
            the training split.
        say: takes a line for the user.
        encoder: the policy's `vision_fingerprint`, where this process does not hold the weights; by
            default asked here.
    """
    sources = open_sources(data["sources"], policy.embodiment)
    val_episodes = (
        default_val_episodes(sources) if data["val_episodes"] is None else data["val_episodes"]
    )
    split = split_episodes(sources, data["val_fraction"], val_episodes)
    processor, offset = policy.require_processor(), data["action_offset"]
    counted = processor.stats_spec
    horizon = counted.horizon or processor.embodiment.action.horizon
    narrow = data.get("narrow_ranges") or "refuse"
    check_choice("data.narrow_ranges", narrow, NARROW)
    if counted.bounds == "extremes":
        narrow = "ignore"  # nothing lies beyond them
    if stats_from is not None:
        processor.stats = NormStats.load(checked_file(stats_from, STATS_FILE))
        try:
            check_ranges(
                processor.stats,
                sources,
                split.train,
                horizon,
                offset,
                policy.embodiment,
                counted.video,
                "refuse"
                if narrow == "widen"
                else narrow,  # a run's statistics stay what they are to its end
            )
        except UserError as error:
            raise UserError(
                f"{stats_from / STATS_FILE}, the statistics that this run began with: {error} In a"
                " run that is resumed they stay as they are: begin a new one with that and"
                f" init_from={stats_from}, or continue with data.narrow_ranges=warn."
            ) from None
    else:
        processor.stats = compute_norm_stats(
            sources, split.train, horizon, offset, seed, policy.embodiment,
            every=counted.every, extremes=counted.extremes, exact=counted.exact,
            video=counted.video, narrow=narrow,
        )  # fmt: skip
    memory_parts = set() if policy.memory is None else set(policy.memory.modules())
    labels = labels_read(*(part for part in policy.modules() if part not in memory_parts))
    require(
        data.get("weights") is None
        or (policy.loss_weights is not None and processor.samples.kind == "steps"),
        f"data.weights={data.get('weights')}: {type(policy).__name__} does not weigh samples. Set"
        " data.weights=null.",
    )
    subgoal = SubgoalText.from_config(policy.config.get("subgoal_text"))
    caches = None
    if policy.memory is not None:
        cache = data["cache"]
        encoder = encoder or policy.vision_fingerprint()
        caches = [
            ensure_cache(
                source,
                policy.memory,
                policy.encode_frames,
                encoder,
                root=cache["root"],
                dtype=str(policy.info.history_dtype).removeprefix("torch."),
                max_build_frames=cache["max_build_frames"],
                batch_size=cache["batch_size"],
                command=cache_command,
            )
            for source in sources
        ]

    transforms = build_transforms(data.get("history_transforms"))
    require(
        not transforms or processor.samples.kind == "steps",
        "data.history_transforms changes frames, and this policy learns from"
        f" {processor.samples.kind}: leave it empty.",
    )

    def side(episodes: list[Any], held_out: bool = False) -> Any:
        if processor.samples.kind != "steps":
            build = TRAINING_SETS[processor.samples.kind]
            return build(sources, processor, policy, episodes, seed=seed, sampled=not held_out)
        kind = GroupDataset if processor.samples.group_size > 1 else TrainingDataset
        return kind(
            sources,
            processor,
            policy.memory,
            caches,
            episodes=episodes,
            action_offset=offset,
            mask_padding=data["mask_padding"],
            jitter=data["jitter"] and not held_out,
            subgoal=subgoal,
            labels=labels,
            weights=data.get("weights"),
            seed=seed,
            transforms=() if held_out else transforms,
        )

    held_out = sum(map(len, split.val))
    prepared = SplitData(side(split.train), side(split.val, held_out=True) if held_out else None,
                         [source.fingerprint for source in sources])  # fmt: skip
    say(
        f"data {data['name']}: {len(prepared.train)} training steps in {sum(map(len, split.train))}"
        f" episodes, {0 if prepared.val is None else len(prepared.val)} held-out steps in"
        f" {held_out}"
    )
    return prepared


def check_frozen(policy: Policy, freeze_vision: bool) -> None:
    """Refuse to train the vision tower under a memory, whose cached tokens would not follow it."""
    require(
        policy.memory is None or freeze_vision,
        "finetune.freeze_vision=false changes the vision tower while the memory reads tokens that"
        " were cached before: at test time it would see other tokens than in training. Keep it"
        " frozen (finetune.freeze_vision=true), or train without a memory.",
    )
