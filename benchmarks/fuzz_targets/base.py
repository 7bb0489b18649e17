"""What `benchmarks/fuzz.py` damages: a kind of file, how to make one and how the library reads it."""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np


def _never(valid: object, result: object) -> bool:
    return False


@dataclass(frozen=True)
class Target:
    """One kind of artefact.

    Attributes:
        name: its name on the command line and in the table.
        make: writes a small valid artefact into a folder, which exists and is empty.
        files: the files of that folder that are damaged, one at a time.
        read: reads all of the artefact with the library's own reader, and returns something comparable with `==`, such
            as a digest of everything that was read: a damaged artefact that reads equal does no harm, one that reads
            otherwise was accepted silently.
        untellable: whether no reader of this format can know that the second of two results is not the first one's
            artefact, because the format has no checksum; such cases are counted apart.
    """

    name: str
    make: Callable[[Path], None]
    files: Callable[[Path], list[Path]]
    read: Callable[[Path], object]
    untellable: Callable[[object, object], bool] = _never


def every_file(folder: Path) -> list[Path]:
    """All files in and below a folder, in order."""
    return sorted(path for path in folder.rglob("*") if path.is_file())


def digest(*values: object) -> str:
    """A hash of arrays and of whatever has a faithful `repr`."""
    hasher = hashlib.sha256()
    for value in values:
        if isinstance(value, np.ndarray):
            hasher.update(f"{value.dtype} {value.shape}".encode() + np.ascontiguousarray(value).tobytes())
        else:
            hasher.update(repr(value).encode("utf-8", "surrogatepass"))
    return hasher.hexdigest()
