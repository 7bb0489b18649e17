"""Writing so that a reader, or the next run, sees the old file or the new one and nothing between."""

import json
import os
import re
import socket
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from mme_vla.files.trouble import name_place

_DRAFT = re.compile(r"\..+\.(?P<host>[^.]*)-(?P<process>\d+)-[0-9a-f]{8}\.partial")


@contextmanager
def write_atomically(path: Path) -> Iterator[Path]:
    """Yield a draft beside `path`, which becomes `path` in one rename if the block ends well and is removed otherwise.

    >>> with write_atomically(Path("plan.json")) as draft:
    ...     draft.write_text("{}")
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = draft_of(path)
    try:
        yield draft
        draft.replace(path)
    except BaseException as error:
        name_place(error, path)
        draft.unlink(missing_ok=True)
        raise


def write_json(path: Path, value: Any, indent: int | None = 2) -> None:
    """Write `value` as JSON in one rename; numbers that are not finite are refused (ValueError)."""
    with write_atomically(path) as draft:
        draft.write_text(json.dumps(value, indent=indent, allow_nan=False) + "\n")


def draft_of(path: Path) -> Path:
    """Where this process writes what is to become `path`.

    Machine and process are in the name, so that a killed one's can be told, and a random number, as both may repeat
    among containers: two writers never share a draft, and the last one to finish wins whole.
    """
    return path.with_name(f".{path.name}.{_host()}-{os.getpid()}-{uuid.uuid4().hex[:8]}.partial")


def is_draft(path: Path) -> bool:
    """Whether this is a draft, of whichever process."""
    return _DRAFT.fullmatch(path.name) is not None


def remove_drafts(folder: Path) -> None:
    """Remove the drafts in a folder whose writers, processes of this machine, were killed."""
    for path in folder.glob(".*.partial"):
        draft = _DRAFT.fullmatch(path.name)
        if draft is not None and draft["host"] == _host() and not _lives(int(draft["process"])):
            path.unlink(missing_ok=True)


def _host() -> str:
    return socket.gethostname().partition(".")[0]


def _lives(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):  # another user's
        return True
    return True
