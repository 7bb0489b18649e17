"""Folders of safetensors: large ones are sharded, and reading is strict."""

import shutil
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path

import torch
from torch import Tensor, nn

from mme_vla.errors import UserError, check_choice, counted, listed, require
from mme_vla.utils import check_sums, checked_file, decoding, inside, read_json, require_file

WEIGHTS = "model.safetensors"
INDEX = "model.safetensors.index.json"
DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16}
_HEADER_LIMIT = 16 * 2**20  # bytes; the header of the largest policy here, 1,000 names, has 0.1 MiB


def save_tensors(
    tensors: Mapping[str, Tensor],
    folder: Path,
    max_shard_size: str = "5GB",
    dtype: torch.dtype | None = None,
) -> None:
    """Write tensors to `folder` as safetensors, in shards with an index where they exceed
    `max_shard_size`.

    `dtype` is what floating-point tensors are stored in; by default each keeps its own.
    """
    from huggingface_hub import save_torch_state_dict

    folder.mkdir(parents=True, exist_ok=True)
    on_cpu = {
        name: cast(tensor.detach(), dtype).cpu().contiguous() for name, tensor in tensors.items()
    }
    save_torch_state_dict(on_cpu, folder, max_shard_size=max_shard_size)


def load_tensors(folder: Path) -> dict[str, Tensor]:
    """Read a folder's `model.safetensors`, or the shards its index names (memory-mapped until
    used).
    """
    return read_files(folder, weight_files(folder))


def read_files(folder: Path, files: Iterable[Path]) -> dict[str, Tensor]:
    """Read safetensors files of a folder as one table. Where it has checksums, they must list and
    fit each file.
    """
    files = list(files)
    check_sums(folder, [file.relative_to(folder).as_posix() for file in files])
    tensors: dict[str, Tensor] = {}
    for file in files:
        loaded = read_safetensors(file)
        twice = sorted(set(loaded) & set(tensors))
        require(
            not twice,
            f"{file} holds tensors that another file of {folder} holds too: {listed(twice)}.",
        )
        tensors |= loaded
    return tensors


def weight_files(folder: Path) -> list[Path]:
    """The safetensors files that hold a folder's weights.

    Raises:
        UserError: there are none, there are two sets of them, or the index is none or not what was
            written.
    """
    if (folder / INDEX).is_file():
        return [inside(folder, name, "weights") for name in require_one_set(folder)]
    if (folder / WEIGHTS).is_file():
        return [inside(folder, WEIGHTS, "weights")]
    raise UserError(
        f"No weights in {folder}: expected {WEIGHTS} or {INDEX}. Is this a checkpoint folder?"
    )


def require_one_set(folder: Path) -> list[str]:
    """The files that a folder's index names, once nothing else in it could be meant as its weights.

    Raises:
        UserError: the index is none, or there is a single file of weights beside it that it does
            not name.
    """
    index = read_json(checked_file(folder, INDEX), "an index of safetensors files")
    table = index.get("weight_map")
    if (
        not isinstance(table, dict)
        or not table
        or not all(isinstance(name, str) for name in table.values())
    ):
        raise UserError(
            f"{folder / INDEX} is not an index of safetensors files: it lacks a `weight_map`."
        )
    names = set(table.values())
    require(
        WEIGHTS in names or not (folder / WEIGHTS).is_file(),
        f"{folder} holds both {WEIGHTS} and {INDEX}, which names other files: it is not clear which"
        " are its weights. Remove the one that does not belong to it, such as the rest of an"
        " earlier download.",
    )
    return sorted(names)


def list_weight_files(folder: Path) -> list[str]:
    """The names, relative to a folder, of the files that are read as its weights: an index, if
    there is one, first.
    """
    files = [file.relative_to(folder).as_posix() for file in weight_files(folder)]
    if (folder / INDEX).is_file():
        files.insert(0, INDEX)
    return files


_TRANSFORMERS = (
    "*.json",
    "*.jinja",
    "*.model",
    "merges.txt",
    "vocab.txt",
    "*.safetensors",
    "pytorch_model*.bin",
    "adapter_model.bin",
)


def check_transformers_folder(source: str | Path) -> None:
    """Check a folder before transformers or PEFT read it; a name on the hub is none.

    Which of its files they read is theirs to decide: where there is a `SHA256SUMS`, it must list
    all that they may.

    Raises:
        UserError: a file is damaged, missing or not listed, or the folder holds two sets of
            weights.
    """
    folder = Path(source)
    if not folder.is_dir():
        return
    if (folder / INDEX).is_file():
        require_one_set(folder)
    names = set()
    for pattern in _TRANSFORMERS:
        names |= {file.name for file in folder.glob(pattern)}
    check_sums(folder, sorted(names))


def read_safetensors(file: Path) -> dict[str, Tensor]:
    from safetensors.torch import load_file

    check_header(file)
    with decoding(file, "a safetensors file", "Download or copy it again."):
        return load_file(file)


def check_header(file: Path) -> None:
    """Make sure that a safetensors file is one, and that its header is of a size worth parsing."""
    size = require_file(file, "a safetensors file").stat().st_size
    with (
        decoding(file, "a safetensors file", "Download or copy it again."),
        file.open("rb") as opened,
    ):
        header = int.from_bytes(opened.read(8), "little")
    require(
        header <= min(_HEADER_LIMIT, size - 8),
        f"{file} is damaged or not a safetensors file: its header would have {header:,} bytes, the"
        f" file has {size:,}, and headers have at most {_HEADER_LIMIT:,}.",
    )


def cast(tensor: Tensor, dtype: torch.dtype | None) -> Tensor:
    """Bring a floating-point tensor to `dtype` (None: leave it); whole numbers and complex ones
    stay as they are.
    """
    if dtype is None or not tensor.is_floating_point():
        return tensor
    return tensor.to(dtype)


def dtype_of(name: str, what: str = "dtype") -> torch.dtype:
    """Look up `float32` or `bfloat16`."""
    check_choice(what, name, DTYPES)
    return DTYPES[name]


def check_fit(
    tensors: Mapping[str, Tensor],
    expected: Mapping[str, tuple[int, ...]],
    source: str,
    optional: Collection[str] = (),
) -> None:
    missing = sorted(set(expected) - set(tensors) - set(optional))
    unexpected = sorted(set(tensors) - set(expected))
    misshapen = []
    for name in sorted(set(expected) & set(tensors)):
        shape = tuple(tensors[name].shape)
        if shape != tuple(expected[name]):
            misshapen.append(f"{name}: {shape} instead of {tuple(expected[name])}")
    groups = {"missing": missing, "unexpected": unexpected, "misshapen": misshapen}
    problems = []
    for what, names in groups.items():
        if names:
            problems.append(f"{len(names):,} {what}:\n  {listed(names, 5)}")
    if problems:
        raise UserError("\n".join([f"The weights in {source} do not fit this policy.", *problems]))


def check_values(tensors: Mapping[str, Tensor], source: str) -> None:
    """Make sure that tensors hold numbers a network can compute with."""
    broken = [name for name, tensor in tensors.items() if not _finite(tensor)]
    if broken:
        raise UserError(
            f"{source} holds NaN or infinities in {counted(len(broken), 'tensor')}:"
            f" {listed(sorted(broken), 5)}. Its actions would mean nothing: the training diverged"
            " or the file is damaged; take an earlier checkpoint."
        )


def assign_tensors(
    module: nn.Module, tensors: Mapping[str, Tensor], source: str, dtype: torch.dtype | None = None
) -> None:
    """Give a module (on meta or not) these tensors as its parameters; nothing may be missing, left
    over or misshapen.

    `dtype` is what floating-point tensors are brought to; by default each keeps its own.
    """
    state = module.state_dict()
    check_fit(tensors, {name: tuple(tensor.shape) for name, tensor in state.items()}, source)
    check_kinds(tensors, state, source)
    trainable = {name: p.requires_grad for name, p in module.named_parameters()}
    in_dtype = {name: cast(tensor, dtype) for name, tensor in tensors.items()}
    check_values(in_dtype, source)  # a number may be too large for the new kind
    module.load_state_dict(in_dtype, strict=True, assign=True)
    for name, parameter in module.named_parameters():
        parameter.requires_grad_(trainable[name])


def take_memory(module: nn.Module) -> None:
    """Move those of a module's tensors that lie in a memory-mapped file into memory that torch
    allots.

    Files place tensors at any multiple of a few bytes, and matrix products round differently from
    there: what continues from a file would differ in the last bits from what never stopped.
    """
    for tensor in (*module.parameters(), *module.buffers()):
        if tensor.device.type == "cpu":
            tensor.data = tensor.data.clone()


def check_kinds(tensors: Mapping[str, Tensor], expected: Mapping[str, Tensor], source: str) -> None:
    """Make sure that tensors are of the kind of number (real, whole, complex) that those of the
    same name are.
    """
    wrong = []
    for name, tensor in sorted(tensors.items()):
        if name in expected and _kind(tensor) != _kind(expected[name]):
            stored = str(tensor.dtype).removeprefix("torch.")
            needed = str(expected[name].dtype).removeprefix("torch.")
            wrong.append(f"{name}: {stored} instead of {needed}")
    if wrong:
        raise UserError(
            f"The weights in {source} are of another kind of number: {listed(wrong, 5)}."
        )


def replace_folder(built: Path, target: Path) -> None:
    """Put a finished folder in place of `target` in one rename, so that no reader sees
    half of it.
    """
    old = target.with_name(f".{target.name}.old")  # `<name>.old` may be a copy of the user's
    shutil.rmtree(old, ignore_errors=True)
    if target.exists():
        target.rename(old)
    built.rename(target)
    shutil.rmtree(old, ignore_errors=True)


def _kind(tensor: Tensor) -> str:
    if tensor.is_complex():
        return "complex"
    return "real" if tensor.is_floating_point() else str(tensor.dtype)


def _finite(tensor: Tensor) -> bool:
    """Whether every number is finite, without a second tensor of that size."""
    if tensor.is_complex():
        tensor = torch.view_as_real(tensor.resolve_conj())
    if not tensor.is_floating_point() or tensor.is_meta or not tensor.numel():
        return True
    if tensor.element_size() == 1:  # eight-bit numbers know no order
        tensor = tensor.float()
    return all(bool(extreme.isfinite()) for extreme in tensor.detach().aminmax())
