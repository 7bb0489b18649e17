"""What a user points at: which format it is in, and its tensors under that format's names."""

import tempfile
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from mme_vla.errors import UserError, brief, did_you_mean, listed
from mme_vla.methods.diffusion_policy.weights import is_diffusion_policy, unwrap_names
from mme_vla.methods.memoryvla.weights import is_memoryvla, read_names
from mme_vla.methods.openvla_oft.weights import FOLDER, has_adapters, is_openvla, merged, named_base, with_heads
from mme_vla.methods.sam2act.weights import is_sam2act, unwrap_sam2act_names
from mme_vla.policy.saving import CONFIG, local_folder, read_config
from mme_vla.policy.tensor_files import INDEX, WEIGHTS, check_header, read_files, weight_files
from mme_vla.utils import decoding, safe_name
from mme_vla.weights.orbax import ARRAY_FILES, MANIFEST, VARIANT_FILE, Zipped, find_params, read_orbax, variant_of
from mme_vla.weights.ports import LEROBOT_PREFIX, from_port, is_port
from mme_vla.weights.torch_files import SUFFIXES, find_torch_files, read_torch_file

SUFFIX = ".zip"
_MOST_ENTRIES, _MOST_BYTES, _MOST_RATIO = 200_000, 2**38, 200
"""Of an archive, of all it unpacks to, and of one file or all against the packed size: beyond, it is no checkpoint."""
_SMALL = 4 * 2**20  # bytes of a file that is unpacked
_HEADER = 30  # least bytes before the content of a file
_REMEDY = "Download or copy it again."
_facts: dict[tuple[Path, int], tempfile.TemporaryDirectory[str]] = {}


@dataclass(frozen=True)
class Archive:
    """An archive that holds a checkpoint.

    params: where its arrays are. folder: what says its variant, and its statistics, unpacked until the program ends.
    """

    params: Zipped
    folder: Path


def find_archive(folder: Path) -> Path | None:
    """The archive of the newest step in a folder, such as `79999.zip`; None without any."""
    steps = [file for file in folder.glob(f"*{SUFFIX}") if file.stem.isdigit()]
    return max(steps, key=lambda file: int(file.stem)) if steps else None


def open_archive(file: Path) -> Archive:
    """Look through an archive and find the checkpoint in it."""
    with decoding(file, "a zip archive", _REMEDY), zipfile.ZipFile(file) as opened:
        entries = [entry for entry in opened.infolist() if not entry.is_dir()]
        _check(file, entries, opened.start_dir)
        names = [entry.filename for entry in entries]
        place = _arrays(names)
        if place is None:
            raise UserError(f"{file} holds no checkpoint of the released code: there are no Orbax arrays in it.")
        within = tuple(name.removeprefix(place) for name in names if name.startswith(place))
        folder = _unpack_facts(file, opened, entries)
    return Archive(Zipped(file.resolve(), place, within), folder)


def _check(file: Path, entries: list[zipfile.ZipInfo], end: int) -> None:
    """Refuse what no checkpoint holds. end: offset of the archive's directory, where its last entry ends."""
    total, packed = sum(entry.file_size for entry in entries), sum(entry.compress_size for entry in entries)
    if len(entries) > _MOST_ENTRIES or total > _MOST_BYTES:
        raise UserError(f"{file} unpacks to {len(entries):,} files of {total:,} bytes: that is no checkpoint.")
    for entry in entries:
        name, parts = entry.filename, entry.filename.split("/")
        if name.startswith("/") or "\\" in name or ".." in parts or ":" in parts[0]:
            raise UserError(f"{file} names {brief(name)}, which lies outside of it. {_REMEDY}")
        if entry.flag_bits & 1:
            raise UserError(f"{file} is encrypted: unpack it yourself, and name the folder.")
        if entry.file_size > _SMALL and entry.file_size > _MOST_RATIO * max(entry.compress_size, 1):
            raise UserError(f"{file}: {brief(name)} unpacks to {entry.file_size:,} bytes: that is no checkpoint.")
    if total > _SMALL and total > _MOST_RATIO * packed:
        raise UserError(f"{file}: {packed:,} bytes unpack to {total:,}: that is no checkpoint.")
    _check_distinct(file, entries, end)


def _check_distinct(file: Path, entries: list[zipfile.ZipInfo], end: int) -> None:
    """Refuse names and bytes that stand twice: what is compared with its checksum might not be what is read."""
    names: set[str] = set()
    for entry in entries:
        if entry.filename in names:
            raise UserError(f"{file} names {brief(entry.filename)} twice. {_REMEDY}")
        names.add(entry.filename)
    ordered = sorted(entries, key=lambda entry: entry.header_offset)
    ends = [*(entry.header_offset for entry in ordered[1:]), end]
    for entry, following in zip(ordered, ends, strict=True):
        if entry.header_offset + _HEADER + entry.compress_size > following:
            raise UserError(f"{file}: the bytes of {brief(entry.filename)} overlap with what follows. {_REMEDY}")


def _arrays(names: list[str]) -> str | None:
    """The folder of the arrays, with a slash at its end: `params` before others, the outermost that holds arrays."""
    stores = [name.removesuffix(MANIFEST) for name in names if name.split("/")[-1] == MANIFEST]
    if not stores:
        stores = [
            "/".join([*name.split("/")[:-2], ""]).lstrip("/")
            for name in names
            for array in ARRAY_FILES
            if name.endswith(array)
        ]
    return min(stores, key=lambda place: (not place.endswith("params/"), place.count("/"), place), default=None)


def _unpack_facts(file: Path, opened: zipfile.ZipFile, entries: list[zipfile.ZipInfo]) -> Path:
    """Write the variant's name and the statistics, as a released step has them, and return the folder."""
    key = file.resolve(), file.stat().st_mtime_ns
    if key in _facts:
        return Path(_facts[key].name)
    unpacked = _facts[key] = tempfile.TemporaryDirectory(prefix="mme-vla-")
    folder = Path(unpacked.name)
    for entry in entries:
        *above, last = entry.filename.split("/")
        if last == VARIANT_FILE:
            target = folder / VARIANT_FILE
        elif last == "norm_stats.json" and above:
            target = folder / "assets" / safe_name(above[-1]) / last
        else:
            continue
        if entry.file_size > _SMALL:
            raise UserError(f"{file}: {brief(entry.filename)} has {entry.file_size:,} bytes. {_REMEDY}")
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(opened.read(entry))
    return folder


FORMATS = {
    "ours": "save_pretrained() of this library",
    "lerobot": "LeRobot's pi05 (safetensors)",
    "openpi": "openpi's PyTorch π0.5 (safetensors)",
    "released": "openpi's and MME-VLA's JAX parameter trees (Orbax)",
    "diffusion_policy": "Diffusion Policy as RoboMME's authors train it (.pth)",
    "sam2act_plus": "SAM2Act and SAM2Act+ as their authors train them (.pth)",
    "openvla": "OpenVLA, or a run of OpenVLA-OFT, merged or beside its base (safetensors, with .pt files)",
    "memoryvla": "MemoryVLA as its authors train it (.pt)",
}


@dataclass(frozen=True)
class NativeFormat:
    """A format of one method, told by its tensors' names.

    matches: whether names are its. plain: tensors under the one spelling that its name table knows.
    """

    matches: Callable[[Sequence[str]], bool]
    to_native: Callable[[Mapping[str, Tensor], str], dict[str, Tensor]]


NATIVE_FORMATS = {
    "diffusion_policy": NativeFormat(is_diffusion_policy, unwrap_names),
    "sam2act_plus": NativeFormat(is_sam2act, unwrap_sam2act_names),
    "memoryvla": NativeFormat(is_memoryvla, read_names),
}
"""Formats in files of `torch.save`; each is called as the model it holds."""

VARIANTS = {
    "pi05_baseline": "pi05",
    "symbolic-simple-subgoal": "simplesg",
    "symbolic-grounded-subgoal": "groundsg",
} | {
    f"{kind}-{memory}-{integration}": f"{memory}_{integration}"
    for kind, memories in (("perceptual", ("framesamp", "tokendrop")), ("recurrent", ("rmt", "ttt")))
    for memory in memories
    for integration in ("context", "modul", "expert")
}
"""The released code's names of the variants, and ours."""


@dataclass(frozen=True)
class Source:
    """A checkpoint that was found.

    format: a key of `FORMATS`. folder: what belongs to it lies here: configuration, statistics.
    files: its safetensors files; empty for an Orbax checkpoint.
    params: the Orbax arrays' folder, or their place in an archive.
    base: of a run that holds adapters alone, what they were trained on.
    """

    format: str
    folder: Path
    files: tuple[Path, ...] = ()
    params: Path | Zipped | None = None
    base: "Source | None" = None

    def tensors(self, fits: Callable[[Mapping[str, Tensor]], None] | None = None) -> dict[str, Tensor]:
        """Read all tensors, under the one spelling that the format's name table knows.

        Args:
            fits: where reading takes memory (Orbax), called before with tensors of the same names and shapes on meta;
                raises where they do not fit.
        """
        if self.params is not None:
            return read_orbax(self.params, fits)
        if self.format in NATIVE_FORMATS:
            return NATIVE_FORMATS[self.format].to_native(read_torch_file(self.files[0]), str(self.files[0]))
        if self.base is not None:
            heads = with_heads({}, self.folder)
            return merged(self.base.tensors(), self.folder) | heads
        tensors = read_files(self.folder, self.files)
        if self.format == "openvla":
            return with_heads(tensors, self.folder)
        return from_port(tensors, str(self.folder)) if self.format in ("lerobot", "openpi") else tensors

    @property
    def label(self) -> str:
        """Where it is, for messages."""
        return str(self.params if isinstance(self.params, Zipped) else self.folder)

    @property
    def config(self) -> dict[str, Any]:
        """What `config.json` beside the weights says; empty without one."""
        return read_config(self.folder) if (self.folder / CONFIG).is_file() else {}

    @property
    def model(self) -> str | None:
        """Our name of the variant a checkpoint is, or None where it does not say."""
        if self.format in NATIVE_FORMATS:
            return self.format
        if self.format == "openvla":
            return "openvla_oft"
        name = None
        if self.params is not None:
            place = self.params.file if isinstance(self.params, Zipped) else self.params
            beside = [place.parent, place.parent.parent]
            name = variant_of([self.folder, *beside])
            if name is None:  # published runs lie in folders that are called as they are
                name = next((folder.name for folder in beside if folder.name in VARIANTS), None)
        if name is not None and name not in VARIANTS:
            # The word would become part of a configuration, where it could ask for more than a name.
            raise UserError(
                f"history_config.txt beside {self.folder} says {brief(name)}, no variant of the released code. "
                f"{did_you_mean(brief(name), VARIANTS)}"
            )
        return None if name is None else VARIANTS[name]


def detect_format(source: str | Path) -> str:
    """Say what `source` is: `ours`, `lerobot`, `openpi` or `released`."""
    return open_source(source).format


def open_source(
    source: str | Path, revision: str | None = None, token: str | None = None, base: str | Path | None = None
) -> Source:
    """Find a checkpoint: a folder, a safetensors file, an Orbax run or step, an archive of one, or a place on the hub.

    On the hub: `owner/name`, or `owner/name/folder/in/it`.

    Args:
        base: OpenVLA, for a run of OpenVLA-OFT that holds its adapters alone. A run's own word for it is not followed.
    """
    path = local_folder(source, revision, token)
    if not path.exists():
        raise UserError(f"No checkpoint at {path}: there is no such file or folder.")
    is_local = path.is_file() or (path / WEIGHTS).is_file() or (path / INDEX).is_file()
    if base is not None:
        if is_local or not has_adapters(path):
            raise UserError(
                f"base={str(base)!r} is for a run that holds {FOLDER} alone; {path} does not: leave it out."
            )
        base_source = open_source(base)
        if base_source.format != "openvla":
            raise UserError(
                f"base={str(base)!r} is {FORMATS[base_source.format]}; the adapters in {path} are OpenVLA's."
            )
        return Source("openvla", path, base=base_source)
    if path.is_file() and path.suffix in SUFFIXES:
        return _of_torch_file(path)
    if path.is_file() and path.suffix == SUFFIX:
        return _of_archive(path)
    if path.is_file():
        return _of_files(path.parent, (path,))
    if (path / WEIGHTS).is_file() or (path / INDEX).is_file():
        return _of_files(path, tuple(weight_files(path)))
    params = find_params(path)
    if params is not None:
        return Source("released", params.parent if params.name == "params" else params, params=params)
    if (zipped := find_archive(path)) is not None:
        return _of_archive(zipped)
    if has_adapters(path):
        raise UserError(
            f"{path} holds adapters apart from what they were trained on ({brief(named_base(path))}): name it, "
            "load_weights(policy, run, base=…), or mme-vla weights <run> <new folder> --base …"
        )
    if len(files := find_torch_files(path)) == 1:
        return _of_torch_file(files[0])
    if files:
        raise UserError(f"{path} holds {listed(file.name for file in files)}: name the one you mean.")
    if (path / "adapter_model.safetensors").is_file():
        raise UserError(f"{path} holds a PEFT adapter alone, not a policy: merge it into its base model first.")
    raise UserError(f"{path} holds no checkpoint of a known kind. Known: {'; '.join(FORMATS.values())}.")


def _of_archive(file: Path) -> Source:
    archive = open_archive(file)
    return Source("released", archive.folder, params=archive.params)


def _of_files(folder: Path, files: tuple[Path, ...]) -> Source:
    names = [name for file in files for name in _names(file)]
    if is_port(names):
        lerobot = any(name.startswith(LEROBOT_PREFIX) for name in names)
        described = Source("lerobot", folder).config.get("type") is not None
        return Source("lerobot" if lerobot or described else "openpi", folder, files)
    # Not every kind of policy has a backbone among its modules; each has one in its configuration.
    if any(name.startswith("backbone.") for name in names) or "backbone" in Source("ours", folder).config:
        return Source("ours", folder, files)
    if is_openvla(names):
        return Source("openvla", folder, files)
    if any(name.startswith("PaliGemma/") for name in names):
        return Source("released", folder, files)
    few = listed(sorted(names), 3) or "none at all"
    raise UserError(
        f"{files[0]} is no policy of a known kind: its tensors are called {few}. Known: {'; '.join(FORMATS.values())}."
    )


def _of_torch_file(path: Path) -> Source:
    names = list(read_torch_file(path))
    for name, of in NATIVE_FORMATS.items():
        if of.matches(names):
            return Source(name, path.parent, (path,))
    few = listed(sorted(names), 3)
    raise UserError(
        f"{path} holds no policy known here: its tensors are called {few}. Known: {', '.join(NATIVE_FORMATS)}."
    )


def _names(file: Path) -> list[str]:
    """Tensor names in a safetensors file's header."""
    from safetensors import SafetensorError, safe_open

    check_header(file)
    try:
        with safe_open(file, "pt") as opened:
            return list(opened.keys())
    except (SafetensorError, OSError) as error:
        raise UserError(
            f"{file} is damaged or not a safetensors file: {brief(str(error), 300, quote=False)}"
        ) from error
