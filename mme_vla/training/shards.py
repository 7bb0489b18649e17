"""Checkpoints of sharded runs: every process writes its part, beside training, and any number of
them reads it again.

    checkpoints/step_000500/
        shards/shard-00001-….safetensors   one a process: its part of weights, averages and
                                           Adam's moments
        shards/shard-00001-….sha256        its checksum
        training_state.json, config.json, …, model.safetensors
                                           as in every checkpoint (`training/checkpoint.py`)

`torch.distributed.checkpoint` writes and reads them. They are safetensors too: nothing is pickled.
"""

import warnings
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, distributed, nn
from torch.distributed import checkpoint as dcp
from torch.distributed.checkpoint.api import CheckpointException
from torch.distributed.checkpoint.staging import DefaultStager, StagingOptions
from torch.distributed.tensor import DTensor

from mme_vla.errors import counted, listed, require
from mme_vla.policy.tensor_files import check_header, check_values
from mme_vla.training.parallel import reshard
from mme_vla.utils import Sums, check_sums, decoding, inside, sum_line

SHARDS = "shards"
RAW, AVERAGE, STEPS = "raw", "average", "steps"
MOMENTS = ("exp_avg", "exp_avg_sq")
_REMEDY = "Copy the whole checkpoint again, or take an earlier one."


def shard_files(checkpoint: Path) -> list[Path]:
    """The files that the processes of a sharded run wrote, in their order; none of any
    other run.
    """
    return sorted((checkpoint / SHARDS).glob("*.safetensors"))


def shard_notes(checkpoint: Path) -> list[str]:
    """The names, within a checkpoint, of the checksums beside its `shard_files`."""
    notes = [file.with_suffix(".sha256") for file in shard_files(checkpoint)]
    return [note.relative_to(checkpoint).as_posix() for note in notes]


class ShardWriter:
    """Writes parts in a thread while training continues; one checkpoint at a time. All processes
    call each method.
    """

    def __init__(self) -> None:
        self._group = distributed.new_group(backend="gloo")
        self._thread = ThreadPoolExecutor(1, "checkpoint")
        self._pending: Future[None] | None = None

    def write(self, draft: Path, tensors: Mapping[str, Tensor], finish: Callable[[], None]) -> None:
        """Copy tensors to the CPU, then write them below `draft` in the background.

        Args:
            draft: a folder that is there.
            finish: called by the first process when all have written.
        """
        self.wait()
        distributed.barrier(self._group)  # the folder is made
        writer = dcp.HuggingFaceStorageWriter(str(draft / SHARDS), save_distributed=True)
        pinned = torch.cuda.is_available()
        stager = DefaultStager(StagingOptions(pinned, False, False, pinned))
        with warnings.catch_warnings(action="ignore"):  # on what PyTorch calls experimental
            parts = dcp.async_save(
                dict(tensors), storage_writer=writer, process_group=self._group, async_stager=stager
            )
        self._pending = self._thread.submit(self._complete, parts, draft, finish)

    def _complete(self, parts: Any, draft: Path, finish: Callable[[], None]) -> None:
        parts.result()
        rank = distributed.get_rank(self._group)
        for file in (draft / SHARDS).glob(f"shard-{rank + 1:05d}-*.safetensors"):
            file.with_suffix(".sha256").write_text(sum_line(file, file.name), encoding="utf-8")
        distributed.barrier(self._group)
        if rank == 0:
            finish()

    def wait(self) -> None:
        """Return when nothing is being written any more; what went wrong meanwhile is
        raised here.
        """
        pending, self._pending = self._pending, None
        if pending is not None:
            pending.result()

    def close(self) -> None:
        """Wait for the last checkpoint, on every process, and stop the thread."""
        self.wait()
        distributed.barrier(self._group)
        self._thread.shutdown()


def training_tensors(
    policy: nn.Module,
    averages: Mapping[str, Tensor],
    optimizer: torch.optim.Optimizer,
    trained: Mapping[str, Tensor],
) -> dict[str, Tensor]:
    """What exact resume needs, by name: as processes hold it, in parts or whole.

    Args:
        trained: the parameters that learn. `steps` counts their updates, in that order; −1 where
            there were none.
    """
    tensors = {f"{RAW}/{name}": tensor for name, tensor in policy.state_dict().items()}
    for name, tensor in averages.items():
        tensors[f"{AVERAGE}/{name}"] = tensor
    counts = torch.full((len(trained),), -1.0)
    for i, (name, parameter) in enumerate(trained.items()):
        state = optimizer.state.get(parameter, {})
        for key in MOMENTS:
            moment = state.get(key, torch.zeros_like(parameter))
            tensors[f"{key}/{name}"] = moment.detach()
        if "step" in state:
            counts[i] = float(state["step"])
    tensors[STEPS] = counts
    return tensors


def read_shards(
    checkpoint: Path,
    policy: nn.Module,
    averages: Mapping[str, Tensor],
    optimizer: torch.optim.Optimizer,
    trained: Mapping[str, Tensor],
) -> dict[str, Tensor]:
    """Give weights and averages back their values, in place, whatever number of processes wrote
    them.

    Returns:
        Adam's moments and counts as `<name>/<key>`, of those parameters that had any.
    """
    tensors = training_tensors(policy, averages, optimizer, trained)
    is_sharded = any(isinstance(tensor, DTensor) for tensor in tensors.values())
    _load(checkpoint, tensors, alone=not is_sharded)
    reshard(policy)
    moments: dict[str, Tensor] = {}
    for name, count in zip(trained, tensors[STEPS], strict=True):
        if count < 0:
            continue
        for key in MOMENTS:
            moments[f"{name}/{key}"] = tensors[f"{key}/{name}"]
        moments[f"{name}/step"] = count
    return moments


def read_weights(checkpoint: Path, policy: nn.Module) -> dict[str, Tensor]:
    """The trained weights themselves of a whole policy (built on meta or not), by
    name, on the CPU.
    """
    tensors = {
        f"{RAW}/{name}": torch.empty_like(tensor, device="cpu")
        for name, tensor in policy.state_dict().items()
    }
    _load(checkpoint, tensors, alone=True, others=True)
    return {name.removeprefix(f"{RAW}/"): tensor for name, tensor in tensors.items()}


def _load(checkpoint: Path, tensors: dict[str, Tensor], alone: bool, others: bool = False) -> None:
    """Read tensors in place.

    Args:
        alone: this process reads all of them by itself.
        others: the checkpoint may hold more.
    """
    folder = checkpoint / SHARDS
    files = shard_files(checkpoint)
    # Sharded checkpoints of earlier versions list no shards.
    if any(name.startswith(f"{SHARDS}/") for name in Sums(checkpoint).table):
        check_sums(checkpoint, shard_notes(checkpoint))
    sums: dict[Path, Sums] = {}
    for file in files:
        note = file.with_suffix(".sha256")
        for path in (file, note):
            inside(checkpoint, path.relative_to(checkpoint).as_posix())
        sums[file] = Sums(file.parent, note.name)
        require(
            file.name in sums[file].table,
            f"{note} with the checksum of {file.name} is missing. {_REMEDY}",
        )
        check_header(file)
    # All processes together compare each file once.
    share = files if alone else files[distributed.get_rank() :: distributed.get_world_size()]
    for file in share:
        sums[file].check(file.name)
    reader = dcp.HuggingFaceStorageReader(str(folder))
    with decoding(folder, "shards of a checkpoint", _REMEDY):
        metadata = reader.read_metadata().state_dict_metadata
        stored = {name: about.size for name, about in metadata.items()}  # type: ignore[union-attr]
    wrong = []
    for name, tensor in tensors.items():
        if stored.get(name) != tensor.shape:
            wrong.append(name)
    if not others:
        wrong += stored.keys() - tensors.keys()
    require(
        not wrong,
        f"{folder} does not fit this policy: other values in {counted(len(wrong), 'tensor')}, such"
        f" as {listed(sorted(wrong), 4)}. It belongs to another model or other settings, or a file"
        " of it is missing.",
    )
    try:
        # Without warnings on what is experimental, or assumed of a process that is alone.
        with warnings.catch_warnings(action="ignore"):
            dcp.load(tensors, storage_reader=reader, no_dist=alone)
    except CheckpointException as error:  # what the processes met with, by their numbers
        with decoding(folder, "shards of a checkpoint", _REMEDY):
            raise next(iter(error.failures.values()))[0] from error
    local = {}
    for name, tensor in tensors.items():
        local[name] = tensor.to_local() if isinstance(tensor, DTensor) else tensor
    check_values(local, str(folder))
