"""Training samples: LeRobot says which steps, mme-vla reads them.

LeRobot's samples hold a fixed number of neighbouring frames, and its pipelines drop what marks the
conditioning video. So a step is looked up by its `index` in the dataset as mme-vla opens it:
history from the vision cache, statistics and chunks as in mme-vla's own training.
"""

import gc
import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from torch import Tensor, distributed

from mme_vla import Policy
from mme_vla.data.dataset import TrainingDataset
from mme_vla.data.recording import action_offset_of
from mme_vla.errors import UserError
from mme_vla.training.data import SplitData, prepare_data
from mme_vla.training.settings import DataSettings

if TYPE_CHECKING:
    from lerobot_policy_mme_vla.configuration_mme_vla import MMEVLAConfig


class Samples:
    """The steps of one dataset as batches; it is opened when the first one is asked for, with the
    weights of then.

    Args:
        meta: LeRobot's metadata of the dataset.
    """

    def __init__(self, model: Policy, config: "MMEVLAConfig", meta: Any) -> None:
        self._model, self._config = model, config
        self._val_episodes = _val_episodes(meta)
        self._entry = {
            "root": str(meta.root),
            "name": meta.repo_id.replace("/", "_"),
            "exec_starts": config.exec_starts,
        }
        self._split: SplitData | None = None

    def batch(self, rows: Tensor) -> Any:
        """The batch of these rows [b] of the dataset's tables."""
        split = self._open()
        items = []
        for row in rows.flatten().tolist():
            episode, frame = split.train.sources[0].locate(row)
            # LeRobot's `eval_split` computes the loss of held-out episodes too.
            steps: Any = split.val if episode in self._val_episodes else split.train
            items.append(steps[steps.item_at(0, episode, frame)])
        return split.train.processor.collate(items)

    def _open(self) -> SplitData:
        if self._split is None:
            processor = self._model.require_processor()
            known = processor.stats
            with _one_first(self._config.cache_local):
                self._split = _split(self._model, self._config, self._entry, self._val_episodes)
            if known is not None:
                processor.stats = known  # those that the weights were trained with
        return self._split


def _val_episodes(meta: Any) -> list[int]:
    """The episodes that LeRobot does not train on (`--dataset.episodes`, `--dataset.eval_split`).

    It hands policies the metadata alone, so the dataset that was opened with these is searched for.
    """
    from lerobot.datasets import LeRobotDataset, StreamingLeRobotDataset

    for item in gc.get_objects():
        is_dataset = issubclass(type(item), LeRobotDataset | StreamingLeRobotDataset)
        if is_dataset and item.meta is meta and item.episodes is not None:
            return sorted({*range(meta.total_episodes)} - {*item.episodes})
    return []


@contextmanager
def _one_first(of_machine: bool) -> Iterator[None]:
    """Of processes that train together the first (of each machine) goes ahead, so that caches are
    built once.
    """
    together = (
        distributed.is_available()
        and distributed.is_initialized()
        and distributed.get_world_size() > 1
    )
    rank = (
        int(os.environ.get("LOCAL_RANK", "0"))
        if of_machine or not together
        else distributed.get_rank()
    )
    first = rank == 0
    if together and not first:
        distributed.barrier()
    try:
        yield
    finally:  # also where it failed: the others then fail alike, and do not wait
        if together and first:
            distributed.barrier()


def _split(
    model: Policy, config: "MMEVLAConfig", entry: dict[str, Any], val_episodes: list[int]
) -> SplitData:
    data = {
        "name": entry["name"],
        "sources": [entry],
        "val_fraction": 0.0,
        "val_episodes": val_episodes,
        "action_offset": action_offset_of(model),
        "mask_padding": False,
        "jitter": False,
        "cache": {
            "root": config.cache_root,
            "batch_size": 32,
            "max_build_frames": config.max_build_frames,
        },
    }
    split = prepare_data(model, DataSettings.from_dict(data), config.seed)
    if type(split.train) is not TrainingDataset:
        raise UserError(
            f"{config.model} is trained on groups of steps or on keyframes, which LeRobot's sampler"
            " does not draw: train it with python -m mme_vla.train."
        )
    return split
