"""Orbax checkpoints without JAX: every leaf is a zarr array, which tensorstore reads and writes.

The arrays lie in one OCDBT store or, in the plain layout, in a folder each. Layout of a
released run:

    <run>/history_config.txt             which variant (absent for the memoryless baseline)
    <run>/<step>/params/                 the arrays
    <run>/<step>/assets/<dataset>/norm_stats.json
                                         normalisation statistics
"""

import json
import math
import re
import tempfile
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mme_vla.errors import UserError, brief, missing_extra, require
from mme_vla.utils import (
    SUMS,
    check_sums,
    checked_file,
    decoding,
    inside,
    read_text,
    require_file,
    safe_name,
)

MANIFEST, METADATA = "manifest.ocdbt", "_METADATA"
ARRAY_FILES = {"/.zarray": "zarr", "/zarr.json": "zarr3"}
VARIANT_FILE = "history_config.txt"
_REMEDY = "Download or copy it again."
_SMALL_PIECE = 2**20  # numbers
_DICT_KEY = 2  # Orbax's number for "this step of the path is a dictionary's key"


@dataclass(frozen=True)
class Zipped:
    """Arrays inside a zip archive: `place` is their folder in it, with a slash at its end, `names`
    what lies there.
    """

    file: Path
    place: str
    names: tuple[str, ...]

    def __str__(self) -> str:
        return f"{self.file} ({self.place or 'at its top'})"

    def check(self) -> None:
        """Compare what lies there with the checksums in the archive, and the archive with those
        beside it, if any.

        Tensorstore asks for neither.
        """
        check_sums(self.file.parent, [self.file.name])
        with (
            decoding(self.file, "a zip archive", _REMEDY),
            zipfile.ZipFile(self.file) as opened,
        ):
            for name in self.names:
                with opened.open(self.place + name) as piece:
                    while piece.read(2**22):
                        pass


def find_params(folder: Path) -> Path | None:
    """The folder with the arrays of a run (its newest step), a step, or the arrays' folder itself;
    None without any.
    """
    if _holds_arrays(folder):
        return folder
    if _holds_arrays(folder / "params"):
        return folder / "params"
    steps = []
    for path in folder.glob("*"):
        if path.name.isdigit() and _holds_arrays(path / "params"):
            steps.append(path)
    if not steps:
        return None
    return max(steps, key=lambda path: int(path.name)) / "params"


def variant_of(folders: Sequence[Path]) -> str | None:
    """What `history_config.txt` says in the first of these that has one, such as
    `perceptual-framesamp-modul`.
    """
    for folder in folders:
        note = folder / VARIANT_FILE
        if note.is_file():
            text = read_text(checked_file(folder, note.name), "the name of a variant", limit=4096)
            return Path(text.strip()).name.removesuffix(".yaml")
    return None


def read_orbax(
    params: Path | Zipped, fits: Callable[[Mapping[str, Tensor]], None] | None = None
) -> dict[str, Tensor]:
    """Read all arrays of a checkpoint, named by their path without the leading `params/` and the
    trailing `/value`.

    A `SHA256SUMS` in the arrays' folder, or in that of their step, must list each of their files,
    and fit it.

    Args:
        params: the arrays' folder, or where they are in an archive.
        fits: called with tensors of the arrays' names and shapes on meta, before memory is taken
            for any.
    """
    ts = _tensorstore()
    if isinstance(params, Zipped):
        params.check()
    else:
        _check_files(params)
    parsing = partial(decoding, str(params), "an Orbax checkpoint", _REMEDY)
    with parsing():
        # All are requested before the first is waited for, so that reading overlaps.
        pending = {}
        for path, (name, driver) in _list_arrays(ts, params).items():
            spec = {
                "driver": driver,
                "kvstore": _store(params, path, _is_ocdbt(params)),
                # A missing part is an error, not zeros: Orbax and this library write zeros too.
                "fill_missing_data_reads": False,
            }
            pending[name] = ts.open(spec, open=True, read=True)
        stores = {name: opened.result() for name, opened in pending.items()}
        shapes = {}
        for name, store in stores.items():  # a few bytes on disk would fill the memory
            piece = math.prod(store.chunk_layout.read_chunk.shape or ())
            require(
                piece <= max(2 * math.prod(store.shape), _SMALL_PIECE),
                f"The Orbax checkpoint {params} is damaged: {brief(name)} of shape"
                f" {brief(tuple(store.shape))} would lie in pieces of {piece:,} numbers.",
            )
            shapes[name] = torch.empty(store.shape, device="meta")
    if fits is not None:
        fits(shapes)
    with parsing():
        reads = {name: store.read() for name, store in stores.items()}
        tree = {}
        for name, read in reads.items():
            array = np.array(read.result())
            if array.dtype.name == "bfloat16":  # which numpy knows only through an extension
                tree[name] = torch.from_numpy(array.view(np.uint16)).view(torch.bfloat16)
            else:
                tree[name] = torch.from_numpy(array)
    require(tree, f"The Orbax checkpoint {params} holds no arrays: it was not written to its end.")
    return tree


def _check_files(params: Path) -> None:
    """Make sure that the arrays' files are files inside their folder, and compare them with the
    checksums there or in the folder of their step.
    """
    parts = []
    for place in params.rglob("*"):
        if place.is_symlink():
            inside(params, place.relative_to(params).as_posix(), "part of the checkpoint")
        if not place.is_dir():  # tensorstore would wait for a pipe without end
            require_file(place, "a part of an Orbax checkpoint")
            if place.name != SUMS:
                parts.append(place)
    folders = [params]
    if params.name == "params":
        folders.append(params.parent)
    for folder in folders:
        check_sums(folder, sorted(part.relative_to(folder).as_posix() for part in parts))


def leaf_names(params: Path | Zipped) -> set[str]:
    """The names of a checkpoint's arrays, as `read_orbax` gives them; no array is read."""
    with decoding(str(params), "an Orbax checkpoint", _REMEDY):
        return {name for name, _ in _list_arrays(_tensorstore(), params).values()}


def write_orbax(tree: Mapping[str, Tensor], params: Path) -> None:
    """Write a tree as Orbax does (OCDBT, zarr, full keys `params/…/value`), so that Orbax restores
    it.
    """
    ts = _tensorstore()
    params.mkdir(parents=True)
    leaves: dict[str, Any] = {}
    arrays: dict[str, np.ndarray] = {}
    for name, tensor in sorted(tree.items()):
        path = ("params", *name.split("/"), "value")
        values = tensor.detach().cpu().contiguous()
        if values.dtype == torch.bfloat16:
            import ml_dtypes  # comes with tensorstore

            array = values.view(torch.uint16).numpy().view(ml_dtypes.bfloat16)
        else:
            array = values.numpy()
        arrays[".".join(path)] = array
        leaves[str(path)] = {
            "key_metadata": [{"key": key, "key_type": _DICT_KEY} for key in path],
            "value_metadata": {"value_type": "np.ndarray", "skip_deserialize": False},
        }
    # One context, and all writes at once: the store then gathers them into few files.
    context = ts.Context()
    stores = {}
    for key, array in arrays.items():
        compressor = {"id": "zstd", "level": 1}
        spec = {
            "driver": "zarr",
            "kvstore": _store(params, key, True),
            "metadata": {"compressor": compressor, "chunks": array.shape},
        }
        stores[key] = ts.open(
            spec, create=True, dtype=array.dtype, shape=array.shape, context=context
        )
    futures = [store.result().write(arrays[key]) for key, store in stores.items()]
    for write in futures:
        write.result()
    about = {"tree_metadata": leaves, "use_ocdbt": True, "use_zarr3": False}
    (params / METADATA).write_text(json.dumps(about), encoding="utf-8")


def _holds_arrays(folder: Path) -> bool:
    if (folder / MANIFEST).is_file():
        return True
    return any(any(folder.glob(f"*{name}")) for name in ARRAY_FILES)


def _is_ocdbt(params: Path | Zipped) -> bool:
    if isinstance(params, Zipped):
        return MANIFEST in params.names
    return (params / MANIFEST).is_file()


def _list_arrays(ts: Any, params: Path | Zipped) -> dict[str, tuple[str, str]]:
    """The key of each array in its store → its name, and the driver that reads it."""
    keys = []
    if _is_ocdbt(params):
        store = ts.KvStore.open(_store(params, "", True)).result()
        keys = [key.decode() for key in store.list().result()]
    elif isinstance(params, Zipped):
        keys = [key for key in params.names if key.count("/") == 1]
    else:
        for name in ARRAY_FILES:
            for file in params.glob(f"*{name}"):
                keys.append(f"{file.parent.name}/{file.name}")
    arrays = {}
    for key in keys:
        path, slash, file = key.rpartition("/")
        if slash + file in ARRAY_FILES:
            name = re.sub(r"^params/|/value$", "", path.replace(".", "/"))
            arrays[path] = (name, ARRAY_FILES[slash + file])
    return arrays


def _store(params: Path | Zipped, path: str, ocdbt: bool) -> dict[str, Any]:
    """Tensorstore's description of where an array lies; an empty path means the store of all."""
    within = f"{path}/" if path else ""
    if isinstance(params, Zipped):
        archive = {"driver": "zip", "base": f"file://{params.file.as_posix()}"}
        if ocdbt:
            return {"driver": "ocdbt", "base": archive | {"path": params.place}, "path": within}
        return archive | {"path": f"{params.place}{path}/"}
    place = params.resolve().as_posix()
    if ocdbt:
        return {"driver": "ocdbt", "base": f"file://{place}/", "path": within}
    return {"driver": "file", "path": f"{place}/{path}/"}


def _tensorstore() -> Any:
    try:
        import tensorstore
    except ImportError:
        raise missing_extra("Reading and writing Orbax checkpoints", "orbax") from None
    return tensorstore


ARCHIVE_SUFFIX = ".zip"
_MOST_ENTRIES, _MOST_BYTES, _MOST_RATIO = 200_000, 2**38, 200
"""Of an archive, of all it unpacks to, and of one file or all against the packed size: beyond, it
is no checkpoint.
"""
_SMALL = 4 * 2**20  # bytes of a file that is unpacked
_HEADER = 30  # least bytes before the content of a file
_facts: dict[tuple[Path, int], tempfile.TemporaryDirectory[str]] = {}


def find_archive(folder: Path) -> Path | None:
    """The archive of the newest step in a folder, such as `79999.zip`; None without any."""
    steps = [file for file in folder.glob(f"*{ARCHIVE_SUFFIX}") if file.stem.isdigit()]
    return max(steps, key=lambda file: int(file.stem), default=None)


def open_archive(file: Path) -> tuple[Zipped, Path]:
    """Find the checkpoint in an archive: its arrays, and a folder of its variant's name and
    statistics, unpacked.
    """
    with decoding(file, "a zip archive", _REMEDY), zipfile.ZipFile(file) as opened:
        entries = [entry for entry in opened.infolist() if not entry.is_dir()]
        _check(file, entries, opened.start_dir)
        names = [entry.filename for entry in entries]
        place = _arrays(names)
        if place is None:
            raise UserError(
                f"{file} holds no checkpoint of the released code: there are no Orbax arrays in it."
            )
        within = tuple(name.removeprefix(place) for name in names if name.startswith(place))
        folder = _unpack_facts(file, opened, entries, place)
    return Zipped(file.resolve(), place, within), folder


def _check(file: Path, entries: list[zipfile.ZipInfo], end: int) -> None:
    """Refuse what no checkpoint holds. end: offset of the archive's directory, where its last entry
    ends.
    """
    total = sum(entry.file_size for entry in entries)
    packed = sum(entry.compress_size for entry in entries)
    if len(entries) > _MOST_ENTRIES or total > _MOST_BYTES:
        raise UserError(
            f"{file} unpacks to {len(entries):,} files of {total:,} bytes: that is no checkpoint."
        )
    for entry in entries:
        name = entry.filename
        parts = name.split("/")
        if name.startswith("/") or "\\" in name or ".." in parts or ":" in parts[0]:
            raise UserError(f"{file} names {brief(name)}, which lies outside of it. {_REMEDY}")
        if entry.flag_bits & 1:
            raise UserError(f"{file} is encrypted: unpack it yourself, and name the folder.")
        if entry.file_size > _SMALL and entry.file_size > _MOST_RATIO * max(entry.compress_size, 1):
            raise UserError(
                f"{file}: {brief(name)} unpacks to {entry.file_size:,} bytes: that is no"
                " checkpoint."
            )
    if total > _SMALL and total > _MOST_RATIO * packed:
        raise UserError(f"{file}: {packed:,} bytes unpack to {total:,}: that is no checkpoint.")
    # Names and bytes that stand twice: what is compared with its checksum might not be what is
    # read.
    names: set[str] = set()
    for entry in entries:
        if entry.filename in names:
            raise UserError(f"{file} names {brief(entry.filename)} twice. {_REMEDY}")
        names.add(entry.filename)
    ordered = sorted(entries, key=lambda entry: entry.header_offset)
    ends = [*(entry.header_offset for entry in ordered[1:]), end]
    for entry, following in zip(ordered, ends, strict=True):
        if entry.header_offset + _HEADER + entry.compress_size > following:
            raise UserError(
                f"{file}: the bytes of {brief(entry.filename)} overlap with what follows. {_REMEDY}"
            )


def _arrays(names: list[str]) -> str | None:
    """The folder of the arrays, with a slash at its end: `params` before others, the outermost that
    holds arrays, of several steps the newest.
    """
    stores = [name.removesuffix(MANIFEST) for name in names if name.split("/")[-1] == MANIFEST]
    if not stores:
        for name in names:
            if name.endswith(tuple(ARRAY_FILES)):
                *above, _, _ = name.split("/")  # without the array's folder and file
                stores.append("/".join([*above, ""]).lstrip("/"))

    def rank(place: str) -> tuple[bool, int, int, str]:
        step = re.search(r"(?:^|/)(\d{1,18})/params/$", place)
        number = int(step[1]) if step else 0
        return (not place.endswith("params/"), place.count("/"), -number, place)

    return min(stores, key=rank, default=None)


def _unpack_facts(
    file: Path, opened: zipfile.ZipFile, entries: list[zipfile.ZipInfo], place: str
) -> Path:
    """Write the variant's name and the statistics that belong to the arrays at `place`, as a
    released step has them, and return the folder.
    """
    key = file.resolve(), file.stat().st_mtime_ns
    if key in _facts:
        return Path(_facts[key].name)
    unpacked = tempfile.TemporaryDirectory(prefix="mme-vla-")
    folder = Path(unpacked.name)
    for entry in entries:
        *above, last = entry.filename.split("/")
        if last == VARIANT_FILE:
            target = folder / last
        elif last == "norm_stats.json" and "assets" in above:
            start = above.index("assets")
            target = folder.joinpath("assets", *map(safe_name, above[start + 1 :]), last)
            above = above[:start]
        else:
            continue
        if not place.startswith("/".join([*above, ""])):
            continue  # of another step
        if entry.file_size > _SMALL:
            raise UserError(
                f"{file}: {brief(entry.filename)} has {entry.file_size:,} bytes. {_REMEDY}"
            )
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(opened.read(entry))
    _facts[key] = unpacked
    return folder
