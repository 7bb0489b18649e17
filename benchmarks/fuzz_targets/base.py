"""What `benchmarks/fuzz.py` damages: a kind of file, how to make one and how the library reads it."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path


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
    """

    name: str
    make: Callable[[Path], None]
    files: Callable[[Path], list[Path]]
    read: Callable[[Path], object]
