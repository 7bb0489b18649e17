"""Load any checkpoint into a policy, completely or as a start for another variant."""

import re
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from torch import Tensor

from mme_vla.errors import UserError, brief, counted, require
from mme_vla.policy.base import Policy
from mme_vla.policy.finetune import merge_state
from mme_vla.policy.saving import recompute_buffers
from mme_vla.policy.sections import PolicySections
from mme_vla.policy.tensor_files import (
    assign_tensors,
    cast,
    check_fit,
    check_kinds,
    check_values,
    dtype_of,
)
from mme_vla.processing.base import CONFIG_FILE, STATS_FILE, read_settings
from mme_vla.weights.ports import check_window, port_adapter
from mme_vla.weights.released import partial_adapter, released_adapter
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
    if fmt in _ADAPTERS:
        return _ADAPTERS[fmt](policy)
    adapter: Adapter = method_formats()[fmt].function("adapter")(policy)
    return adapter


_OF_MEMORY = re.compile(r"^(memory|integration)\.|\.experts\.(?!vlm\.|action\.)")
"""Our names of what a memory adds to a policy."""


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
    those in LeRobot's own files are left (see `read_stats`), and of several none is taken, with a
    warning that names them.

    Args:
        source: a folder, a safetensors file, an Orbax run or step, or `owner/name` on the hub.
        dtype: what the weights become, whatever they are stored in.
        revision, token: of a hub repository.
        base: what a run was trained on, where it holds its adapters alone.
    """
    kind = dtype_of(dtype)
    checkpoint = open_source(source, revision, token, base)
    stats = None
    datasets = list(stats_files(checkpoint.folder))
    # Those in LeRobot's own files belong to other actions.
    has_fitting = checkpoint.format != "lerobot" or (checkpoint.folder / STATS_FILE).is_file()
    if policy.processor is not None and has_fitting and len(datasets) < 2:
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
        # Token ids may mean other words.
        if policy.processor is not None and (source.folder / CONFIG_FILE).is_file():
            prompt = policy.processor.prompt_spec
            fingerprint = read_settings(source.folder).get("tokenizer_fingerprint")
            require(
                None in (fingerprint, prompt.fingerprint) or fingerprint == prompt.fingerprint,
                f"{source.folder} was trained with another tokenizer ({brief(fingerprint)}) than"
                f" {prompt.encoder!r} ({prompt.fingerprint}): its ids would mean other words. Set"
                " processor.tokenizer to that one.",
            )
        return merge_state(source.tensors(), PolicySections.of(source.config).adapters)
    if source.format in ("lerobot", "openpi"):
        check_window(policy, source.config, str(source.folder))
    if (of := method_formats().get(source.format)) is not None and of.check is not None:
        of.function("check")(policy, source.config, str(source.folder))
    adapter = adapter_of(source.format, policy)
    state = policy.state_dict()
    tensors = source.tensors(lambda values: adapter.check_fit(values, state, source.label))
    return adapter.translate(tensors, state, source.label)


@dataclass(frozen=True)
class Start:
    """What a policy took from another's checkpoint.

    taken, new: our names; new ones kept the values they had.
    left: the checkpoint's names that have no place here.
    """

    taken: list[str]
    new: list[str]
    left: list[str]

    def __str__(self) -> str:
        text = (
            f"{counted(len(self.taken), 'tensor')} taken, {len(self.new)} new ({_groups(self.new)})"
        )
        if self.left:
            text += f", {len(self.left)} left behind ({_groups(self.left)})"
        return text


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
    if checkpoint.format == "ours":
        matched, left = _match_local(policy, checkpoint, str(source))
    else:
        matched, left = _match_foreign(policy, checkpoint, str(source))
    state = policy.state_dict()
    check_kinds(matched, state, str(source))
    for name, tensor in matched.items():
        if tensor.element_size() > state[name].element_size():  # a number may be too large for it
            matched[name] = cast(tensor, state[name].dtype)
    check_values(matched, str(source))
    policy.load_state_dict(matched, strict=False)
    return Start(sorted(matched), sorted(set(state) - set(matched)), left)


def _match_local(
    policy: Policy, checkpoint: Source, source: str
) -> tuple[dict[str, Tensor], list[str]]:
    """The tensors of a checkpoint of ours that a policy has too, and the names of a memory's that
    it has not.
    """
    tensors = read_as(policy, checkpoint)
    state = policy.state_dict()
    left = []
    components = policy.finetune_spec.components.items()
    for name in sorted(set(tensors) - set(state)):
        # The component that another's parameter would belong to, if any.
        component = next((part for part, pattern in components if re.match(pattern, name)), None)
        if _OF_MEMORY.search(name) or component == "memory":
            left.append(name)
            del tensors[name]
    shapes = {name: tuple(tensor.shape) for name, tensor in state.items()}
    check_fit(tensors, shapes, source, optional=memory_parameters(policy))
    return tensors, left


def _match_foreign(
    policy: Policy, checkpoint: Source, source: str
) -> tuple[dict[str, Tensor], list[str]]:
    """The tensors of another format that a policy has too, by our names, and the foreign names of a
    memory's that it has not.
    """
    state = policy.state_dict()
    if checkpoint.format == "released":
        adapter = partial_adapter(policy)
    else:
        adapter = adapter_of(checkpoint.format, policy)
    local = memory_parameters(policy) | adapter.fresh

    def split(tensors: Mapping[str, Tensor]) -> tuple[Adapter, dict[str, Tensor], list[str]]:
        """The part of the name table that these tensors can fill, those of it, and what is left
        behind. The memory's parameters that the checkpoint does not hold are no part of it.
        """
        table = {}
        for name, pieces in adapter.table.items():
            is_present = all(piece.path in tensors for piece in pieces)
            if is_present or name not in local:
                table[name] = pieces
        reduced = replace(adapter, table=table)
        if adapter.of_memory is None:
            return reduced, dict(tensors), []
        known = {constant.path for constant in adapter.derived} | set(reduced.shapes(state))
        named = {}
        left = []
        for name, tensor in tensors.items():
            if name not in known and re.search(adapter.of_memory, name):
                left.append(name)
            else:
                named[name] = tensor
        return reduced, named, sorted(left)

    def check_names(tensors: Mapping[str, Tensor]) -> None:
        reduced, named, _ = split(tensors)
        reduced.check_fit(named, state, source)

    tensors = checkpoint.tensors(check_names)
    reduced, named, left = split(tensors)
    return reduced.translate(named, state, source), left


def _groups(names: list[str]) -> str:
    """Tensor names in short: numbers become *, and each stem is named once."""
    stems = set()
    for name in names:
        if "." in name:
            stem = re.sub(r"(?<![^.])\d+(?![^.])", "*", name.rpartition(".")[0])
        else:
            stem = name.rpartition("/")[0]
        stems.add(stem)
    return ", ".join(sorted(stems)) or "none"
