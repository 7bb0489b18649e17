"""Training checkpoints: `save_pretrained`'s folder with the EMA weights, and beside them what exact
resume needs.

    checkpoints/step_000500/
        model.safetensors, config.json, processor.json, norm_stats.json, …   the policy, EMA weights
        self_check.safetensors   a synthetic history and the chunk that these weights predict
        raw.safetensors          the trained weights themselves; frozen ones are in
                                 model.safetensors
        optimizer.safetensors    Adam's moments and step counts
        training_state.json      step, configuration, versions
        SHA256SUMS               of each of these files (the last pass of writing reads them once
                                 more)

All randomness is a function of (seed, step), so there is no generator state and no data position to
keep. Nothing is pickled: a checkpoint from an untrusted source cannot run code.
"""

import importlib.metadata
import json
import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, distributed, nn

from mme_vla.config.sections import section_keys
from mme_vla.errors import UserError, counted, listed, require
from mme_vla.policy.base import Policy
from mme_vla.policy.run_folders import STATE, checkpoint_name, checkpoints_in, step_of
from mme_vla.policy.saving import save_policy, save_settings
from mme_vla.policy.self_check import SelfCheck
from mme_vla.policy.tensor_files import (
    assign_tensors,
    cast,
    check_values,
    list_weight_files,
    load_tensors,
    read_files,
    replace_folder,
    save_tensors,
)
from mme_vla.training.optim import EMA
from mme_vla.training.parallel import full_state, like
from mme_vla.training.settings import KeepRule
from mme_vla.training.shards import (
    MOMENTS,
    SHARDS,
    ShardWriter,
    read_shards,
    read_weights,
    shard_files,
    shard_notes,
    training_tensors,
)
from mme_vla.utils import checked_file, inside, read_json, write_sums

FORMAT = "mme_vla training checkpoint 1"
RAW, OPTIMIZER = "raw.safetensors", "optimizer.safetensors"
_STATE_KEYS = ("format", "step", "config", "versions", "shards")


def trainable(module: nn.Module) -> dict[str, nn.Parameter]:
    """The parameters that receive gradients, by name, in the module's order."""
    return {name: p for name, p in module.named_parameters() if p.requires_grad}


def save_checkpoint(
    folder: Path,
    step: int,
    policy: Policy,
    ema: EMA,
    optimizer: torch.optim.Optimizer,
    config: Mapping[str, Any],
    keep: KeepRule,
    facts: Mapping[str, Any] | None = None,
    self_check: SelfCheck | None = None,
) -> Path:
    """Write `folder`/step_…; it appears whole or not at all. Then remove what `keep` does not hold
    on to.

    Args:
        config: of the training, for `training_state.json`.
        facts: sections that join the policy's own configuration.
        self_check: of the averaged weights.
    """
    from safetensors.torch import save_file

    target = folder / checkpoint_name(step)
    draft = folder / f".{target.name}.partial"
    shutil.rmtree(draft, ignore_errors=True)
    with ema.applied():
        save_policy(policy, draft, facts=facts, self_check=self_check)
    parameters = trainable(policy)
    raw = {name: p.detach().cpu().contiguous() for name, p in parameters.items()}
    save_file(raw, draft / RAW)
    moments = {}
    for name, p in parameters.items():
        if p in optimizer.state:
            for key in (*MOMENTS, "step"):
                moment = optimizer.state[p][key]
                moments[f"{name}/{key}"] = moment.detach().cpu().contiguous()
    save_file(moments, draft / OPTIMIZER)
    _write_state(draft, step, config)
    write_sums(draft, (RAW, OPTIMIZER, STATE), keep=True)
    _publish(draft, target)
    tidy(folder, keep)
    return target


def save_shards(
    writer: ShardWriter,
    folder: Path,
    step: int,
    policy: Policy,
    ema: EMA,
    optimizer: torch.optim.Optimizer,
    config: Mapping[str, Any],
    keep: KeepRule,
    facts: Mapping[str, Any] | None = None,
    hurry: bool = False,
    self_check: SelfCheck | None = None,
) -> None:
    """Begin to write `folder`/step_… of a sharded run; all processes call it and wait for the
    copies alone.

    Args:
        self_check: as for `save_checkpoint`; the first process writes it.
        hurry: let the checkpoint appear as soon as it can be resumed from, and write the policy's
            weights into it after; otherwise it appears whole or not at all.
    """
    target = folder / checkpoint_name(step)
    draft = folder / f".{target.name}.partial"
    first = distributed.get_rank() == 0
    writer.wait()  # the checkpoint before
    with ema.applied():
        averaged = full_state(policy)
    about: list[str] = []
    if first:
        shutil.rmtree(draft, ignore_errors=True)
        (draft / SHARDS).mkdir(parents=True)
        about = [*save_settings(policy, draft, facts, self_check), STATE]

    def finish() -> None:
        place, notes = draft, shard_notes(draft)
        _write_state(draft, step, config, shards=len(shard_files(draft)))
        if hurry:
            write_sums(draft, [*about, *notes])
            place = _publish(draft, target)
        save_tensors(averaged, place, dtype=torch.float32)
        write_sums(place, [*about, *notes, *list_weight_files(place)])
        if not hurry:
            _publish(draft, target)
        tidy(folder, keep)

    writer.write(
        draft, training_tensors(policy, ema.tensors(), optimizer, trainable(policy)), finish
    )


def restore_weights(checkpoint: Path, policy: Policy) -> None:
    """Give a policy, on meta or not, the weights that a run continues from; `restore` brings all
    else.
    """
    if shard_files(checkpoint):
        tensors = read_weights(checkpoint, policy)
    else:
        tensors = load_tensors(checkpoint)
    assign_tensors(policy, tensors, str(checkpoint))


def restore(folder: Path, policy: Policy, ema: EMA, optimizer: torch.optim.Optimizer) -> None:
    """Put everything back as it was when `folder` was written."""
    parameters = trainable(policy)
    if shard_files(folder):
        moments = read_shards(folder, policy, ema.tensors(), optimizer, parameters)
    else:
        moments = _read_full(folder, policy, ema)
    # The optimizer counts its parameters through all groups.
    numbers: dict[int, int] = {}
    for group in optimizer.param_groups:
        for p in group["params"]:
            numbers[id(p)] = len(numbers)
    state = optimizer.state_dict()
    state["state"] = {}
    for name, p in parameters.items():
        if f"{name}/step" in moments:
            # Copies, since what was read may lie in a mapped file.
            saved = {key: like(p, moments[f"{name}/{key}"]).clone() for key in MOMENTS}
            saved["step"] = moments[f"{name}/step"].clone()
            state["state"][numbers[id(p)]] = saved
    optimizer.load_state_dict(state)


def _read_full(folder: Path, policy: Policy, ema: EMA) -> dict[str, Tensor]:
    """Give weights and averages back their values, and return Adam's moments and counts as
    `<name>/<key>`.
    """
    parameters = trainable(policy)
    averaged = load_tensors(folder)
    raw = _read(folder / RAW)
    moments = _read(folder / OPTIMIZER)
    state = policy.state_dict()
    for name, tensor in state.items():
        if tensor.dtype == torch.bfloat16 and name in averaged:  # frozen, and stored in float32
            averaged[name] = cast(averaged[name], torch.bfloat16)
    _check_fit(folder / "model.safetensors", averaged, state)
    _check_fit(folder / RAW, raw, parameters)
    # A parameter that never had a gradient has none of them.
    optimized = {name.rpartition("/")[0] for name in moments}
    required: dict[str, Tensor] = {}
    for name, p in parameters.items():
        if name in optimized:
            required |= {f"{name}/{key}": p for key in MOMENTS}
            required[f"{name}/step"] = torch.zeros(())
    _check_fit(folder / OPTIMIZER, moments, required)
    for path, tensors in ((folder, averaged), (folder / RAW, raw), (folder / OPTIMIZER, moments)):
        check_values(tensors, str(path))
    ema.load(averaged)
    tensors = {**averaged, **raw}
    policy.load_state_dict({name: like(state[name], tensors[name]) for name in tensors})
    return moments


def read_state(checkpoint: Path) -> dict[str, Any]:
    """What `training_state.json` says."""
    path = checkpoint / STATE
    require(
        path.is_file(),
        f"{checkpoint} holds weights but no training state, so there is nothing to resume. "
        f"To start a new run from its weights use init_from={checkpoint}.",
    )
    state: dict[str, Any] = read_json(
        checked_file(checkpoint, STATE), "a training state", limit=2**24
    )
    require(
        state.get("format") == FORMAT,
        f"{path} was not written by this library's training (format {FORMAT!r} expected).",
    )
    section_keys(state, str(path), _STATE_KEYS)
    step = state.get("step")
    is_step = type(step) is int and 0 <= step < 2**53
    has_sections = isinstance(state.get("config"), dict) and isinstance(state.get("versions"), dict)
    require(
        is_step and has_sections,
        f"{path} is damaged: it lacks a step, a configuration or versions. Resume from an older"
        " one.",
    )
    require(
        step_of(checkpoint) in (step, -1),
        f"{path} has step {step}, but its folder is called {checkpoint.name}. Give the folder the"
        " name it had, or resume from another one.",
    )
    shards = state.get("shards", 0)
    require(
        len(shard_files(checkpoint)) == shards,
        f"{checkpoint} holds {len(shard_files(checkpoint))} of the {shards} files that its"
        " processes wrote: it is incomplete. Copy the whole folder again, or resume from an older"
        " checkpoint.",
    )
    for name in (RAW, OPTIMIZER):
        require(
            shards or (checkpoint / name).is_file(),
            f"{checkpoint} lacks {name}: it is incomplete. Resume from an older checkpoint.",
        )
    return state


def check_disk(folder: Path, policy: Policy, keep: KeepRule, sharded: bool = False) -> None:
    """Refuse to begin a run whose first checkpoints would not fit on the disk.

    They are stored in float32. A sharded run's hold the weights twice: the trained ones in parts,
    the averages whole.
    """
    weights = sum(4 * p.numel() for p in policy.parameters())
    trained = sum(4 * p.numel() for p in trainable(policy).values())
    # a new one is written before an old one goes
    needed = (weights * (1 + sharded) + 3 * trained) * (keep.last + 1)
    existing = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    free = shutil.disk_usage(existing).free
    require(
        needed <= free,
        f"Checkpoints would take {needed / 1e9:.1f} GB in {folder} (train.keep.last={keep.last} and"
        f" the one being written), but {free / 1e9:.1f} GB are free: make room, keep fewer, or"
        " choose another output.",
    )


def tidy(folder: Path, keep: KeepRule) -> None:
    """Remove the checkpoints that `keep` does not hold on to, and what a killed run left
    half-written or -removed.
    """
    for path in checkpoints_in(folder)[: -keep.last]:
        if not keep.every or step_of(path) % keep.every:
            # a reader finds a full checkpoint or none
            path.rename(folder / f".{path.name}.partial")
    for path in folder.glob(".step_*.partial"):
        shutil.rmtree(path)


def _write_state(draft: Path, step: int, config: Mapping[str, Any], **more: Any) -> None:
    versions = {name: importlib.metadata.version(name) for name in ("mme-vla", "torch", "numpy")}
    about = {"format": FORMAT, "step": step, "config": dict(config), "versions": versions, **more}
    (draft / STATE).write_text(
        json.dumps(about, indent=2, ensure_ascii=False) + "\n", encoding="utf-8"
    )


def _publish(draft: Path, target: Path) -> Path:
    # The disk holds all of it before the folder gets its final name.
    for path in (*draft.rglob("*"), draft):
        handle = os.open(path, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
    replace_folder(draft, target)
    return target


def _read(path: Path) -> dict[str, Tensor]:
    try:
        return read_files(path.parent, [inside(path.parent, path.name)])
    except UserError as error:
        raise UserError(f"{error} Resume from an older checkpoint.") from None


def _check_fit(path: Path, tensors: Mapping[str, Tensor], expected: Mapping[str, Tensor]) -> None:
    wrong = sorted(tensors.keys() ^ expected.keys())
    for name in sorted(tensors.keys() & expected.keys()):
        tensor, target = tensors[name], expected[name]
        if tensor.shape != target.shape or tensor.dtype != target.dtype:
            wrong.append(f"{name}: {tuple(tensor.shape)} {tensor.dtype}")
    require(
        not wrong,
        f"{path} does not fit this policy: other values in {counted(len(wrong), 'tensor')}, such as"
        f" {listed(wrong, 4)}. It belongs to another model or other settings.",
    )
