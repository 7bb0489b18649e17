"""Released checkpoints as they are published: a step of a run as one zip, read where it lies.

Arrays are read out of the archive by tensorstore, and nothing of it becomes a file but what says which variant it is
and its normalisation statistics, under names of this library's own.
"""

import tempfile
import zipfile
from dataclasses import dataclass
from pathlib import Path

from mme_vla.errors import UserError, brief
from mme_vla.files import decoding, safe_name
from mme_vla.weights.orbax import ARRAY_FILES, MANIFEST, VARIANT_FILE, Zipped

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
    """Look through an archive and find the checkpoint in it.

    Raises:
        UserError: it is damaged, names places outside of itself, unpacks to more than a checkpoint can, or holds none.
    """
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
    kept = _facts[key] = tempfile.TemporaryDirectory(prefix="mme-vla-")
    folder = Path(kept.name)
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
