"""Load any checkpoint into a policy, completely or as a start for another variant."""

import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from torch import Tensor

from mme_vla.errors import UserError, brief, require
from mme_vla.policy.base import Policy
from mme_vla.policy.finetune import merge_state
from mme_vla.policy.saving import recompute_buffers
from mme_vla.policy.tensor_files import (
    assign_tensors,
    check_fit,
    check_kinds,
    check_values,
    dtype_of,
)
from mme_vla.processing.base import CONFIG_FILE, read_settings
from mme_vla.weights.ports import HISTORY, check_window, port_adapter
from mme_vla.weights.released import members_of, partial_adapter, released_adapter
from mme_vla.weights.source import Source, method_formats, open_source
from mme_vla.weights.statistics import read_stats, stats_files
from mme_vla.weights.tables import Adapter, memory_parameters

_ADAPTERS: dict[str, Callable[[Any], Adapter]] = {
    "lerobot": port_adapter,
    "openpi": port_adapter,
    "released": released_adapter,
}


def adapter_of(fmt: str, policy: Policy) -> Adapter:
    """The name table of a format for a policy; raises an error where the format does not hold such
    a policy.
    """
    make = _ADAPTERS[fmt] if fmt in _ADAPTERS else method_formats()[fmt].function("adapter")
    adapter: Adapter = make(policy)
    return adapter


# What a memory adds to a policy, as our names, the released leaves, LeRobot's own memory and
# MemoryVLA's banks tell.
_OF_MEMORY = re.compile(r"^(memory|integration)\.|\.experts\.(?!vlm\.|action\.)")
_MEMORY_LEAF = re.compile(rf"(^|/)mem_|_mem(/|$)|_mem_bank\.|^{HISTORY}\.")


def load_weights(
    policy: Policy,
    source: str | Path,
    *,
    dtype: str = "float32",
    revision: str | None = None,
    token: str | None = None,
    base: str | Path | None = None,
) -> Policy:
    """Fill a policy with a checkpoint of the same variant, in any format this library knows.

    The policy may lie on the meta device, so that no weight is initialised only to be replaced. A
    checkpoint that carries the statistics of one dataset hands them to the policy's processor;
    LeRobot's are left (see `read_stats`), and of several none is taken, with a warning that names
    them.

    Args:
        source: a folder, a safetensors file, an Orbax run or step, or `owner/name` on the hub.
        dtype: what the weights become, whatever they are stored in. revision, token: of a hub
            repository.
        base: what a run of OpenVLA-OFT was trained on, where it holds its adapters alone.
    """
    kind = dtype_of(dtype)
    checkpoint = open_source(source, revision, token, base)
    require(
        checkpoint.format != "openpi" or policy.memory is None,
        f"{source} is memoryless π0.5 and this policy has a memory, whose weights would stay unset."
        " To begin training from it use start_from() (on the command line: init_from=…).",
    )
    stats, datasets = None, list(stats_files(checkpoint.folder))
    if policy.processor is not None and checkpoint.format != "lerobot" and len(datasets) < 2:
        stats = read_stats(checkpoint.folder)
    assign_tensors(policy, read_as(policy, checkpoint), str(source), kind)
    recompute_buffers(policy)
    if stats is not None and policy.processor is not None:
        policy.processor.stats = stats
    elif len(datasets) > 1:
        warnings.warn(
            f"{source} holds normalisation statistics of {', '.join(datasets)}; none were taken."
            f" Choose one: policy.processor.stats = read_stats({str(checkpoint.folder)!r},"
            f" {datasets[0]!r})",
            stacklevel=2,
        )
    return policy


def read_as(policy: Policy, source: Source) -> dict[str, Tensor]:
    """Read a checkpoint in the names of a policy of its own variant."""
    if source.format == "ours":
        return merge_state(source.tensors(), source.config.get("adapters"))
    if source.format == "lerobot":
        check_window(policy, source.config, str(source.folder))
    if (of := method_formats().get(source.format)) is not None and of.check is not None:
        of.function("check")(policy, source.config, str(source.folder))
    adapter, state = adapter_of(source.format, policy), policy.state_dict()
    tensors = source.tensors(lambda values: adapter.check_fit(values, state, source.label))
    return adapter.translate(tensors, state, source.label)


@dataclass(frozen=True)
class Start:
    """What a policy took from another's checkpoint.

    taken, new: our names; new ones kept the values they had. left: the checkpoint's names that have
    no place here.
    """

    taken: list[str]
    new: list[str]
    left: list[str]

    def __str__(self) -> str:
        sentence = f"{len(self.taken)} tensors taken, {len(self.new)} new ({_groups(self.new)})"
        return sentence + (
            f", {len(self.left)} left behind ({_groups(self.left)})" if self.left else ""
        )


def start_from(policy: Policy, source: str | Path, *, revision: str | None = None) -> list[str]:
    """Copy into a built policy all that a checkpoint holds of it, and return the names of what
    stays new.

    The source may be memoryless π0.5 in any format, or another variant. Only parameters of the
    memory (its integration and its own expert included) may stay new; they keep the values they
    have. Statistics are not taken.
    """
    return transfer(policy, source, revision=revision).new


def transfer(policy: Policy, source: str | Path, *, revision: str | None = None) -> Start:
    """Do what `start_from` says, and tell in full what was taken, what is new and what was left
    behind.
    """
    if policy.device.type == "meta":
        raise UserError(
            "Build the policy on a real device to start from a checkpoint: its memory needs fresh"
            " values."
        )
    checkpoint = open_source(source, revision)
    memory_names, state = memory_parameters(policy), policy.state_dict()
    if checkpoint.format == "ours":
        source_tensors = merge_state(checkpoint.tensors(), checkpoint.config.get("adapters"))
        _check_tokenizer(policy, checkpoint.folder)
        strange = set(source_tensors) - set(state)
        left = sorted(
            name for name in strange if _OF_MEMORY.search(name) or _part(policy, name) == "memory"
        )
        matched = {name: tensor for name, tensor in source_tensors.items() if name not in left}
        check_fit(
            matched,
            {name: tuple(tensor.shape) for name, tensor in state.items()},
            str(source),
            optional=memory_names,
        )
    else:
        of_format = (
            partial_adapter(policy)
            if checkpoint.format == "released"
            else adapter_of(checkpoint.format, policy)
        )
        memory_names |= of_format.fresh
        members = [place for place, _ in members_of(policy.memory)]

        def behind(tensors: Mapping[str, Tensor]) -> list[str]:
            known = {constant.path for constant in of_format.derived}
            known |= set(_reduced(of_format, memory_names, members, tensors).shapes(state))
            return sorted(name for name in set(tensors) - known if _MEMORY_LEAF.search(name))

        def fits(tensors: Mapping[str, Tensor]) -> None:
            left = set(behind(tensors))
            here = {name: tensor for name, tensor in tensors.items() if name not in left}
            _reduced(of_format, memory_names, members, tensors).check_fit(here, state, str(source))

        source_tensors = checkpoint.tensors(fits)
        left = behind(source_tensors)
        adapter = _reduced(of_format, memory_names, members, source_tensors)
        source_tensors = {
            name: tensor for name, tensor in source_tensors.items() if name not in left
        }
        matched = adapter.translate(source_tensors, state, str(source))
    check_kinds(matched, state, str(source))
    check_values(matched, str(source))
    policy.load_state_dict(matched, strict=False)
    return Start(sorted(matched), sorted(set(state) - set(matched)), left)


def _part(policy: Policy, name: str) -> str | None:
    """The part of a policy that another's parameter would belong to; None where it has
    none such.
    """
    return next(
        (
            part
            for part, pattern in policy.finetune_spec.components.items()
            if re.match(pattern, name)
        ),
        None,
    )


def _check_tokenizer(policy: Policy, folder: Path) -> None:
    """Refuse a start from weights whose token ids mean other words."""
    file = folder / CONFIG_FILE
    if policy.processor is None or not file.is_file():
        return
    source_fingerprint = read_settings(folder).get("tokenizer_fingerprint")
    processor, target_fingerprint = policy.processor, policy.processor.prompt_spec.fingerprint
    require(
        source_fingerprint is None
        or target_fingerprint is None
        or source_fingerprint == target_fingerprint,
        f"{folder} was trained with another tokenizer ({brief(source_fingerprint)}) than"
        f" {processor.prompt_spec.encoder!r} ({target_fingerprint}): its ids would mean other"
        " words. Set processor.tokenizer to that one.",
    )


def _reduced(
    adapter: Adapter, local: set[str], members: Sequence[str], source_tensors: Mapping[str, Tensor]
) -> Adapter:
    """Leave out the memory's parameters that the checkpoint does not hold, and members that it does
    not hold whole.
    """
    absent = {
        name
        for name, pieces in adapter.table.items()
        if not all(piece.path in source_tensors for piece in pieces)
    }
    torn = tuple(
        f"{place}." for place in members if any(name.startswith(f"{place}.") for name in absent)
    )
    table = {
        name: pieces
        for name, pieces in adapter.table.items()
        if name not in local or (name not in absent and not name.startswith(torn))
    }
    return replace(adapter, table=table)


def _groups(names: list[str]) -> str:
    """Tensor names in short: numbers become *, and each stem is named once."""
    stems = {
        ".".join("*" if part.isdigit() else part for part in name.split(".")[:-1])
        or name.rpartition("/")[0]
        for name in names
    }
    return ", ".join(sorted(stems)) or "none"
