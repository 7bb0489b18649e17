"""The files of a run's folder: its settings (`run.json`), and where its records are
(`episodes.jsonl`).
"""

import json
import os
import time
from collections.abc import Iterable, Mapping
from datetime import UTC, datetime
from glob import glob
from pathlib import Path
from typing import Any

from mme_vla.config.naming import digest, flat
from mme_vla.config.sections import without
from mme_vla.errors import UserError, brief, require
from mme_vla.evaluation.records import EpisodeRecord, read_records
from mme_vla.utils import (
    draft_of,
    is_draft,
    read_json,
    remove_drafts,
    to_json,
    verified,
    with_checksum,
)

RUN_FILE = "run.json"
INDIFFERENT = (
    "workers",
    "batch_size",
    "device",
    "cache",
    "key_variable",
    "base_url",
    "timeout",
    "retries",
)
"""Options of a model that predicts or plays which do not affect its output, and may differ when a
run continues.
"""


def fingerprint(settings: Mapping[str, Any]) -> str:
    """SHA-256 of the settings, whatever the order of their keys."""
    return digest(settings, 64)


def begin_run(
    folder: Path, settings: Mapping[str, Any], notes: Mapping[str, Any] | None = None
) -> dict[str, Any]:
    """Begin a run in `folder`, or continue with the one that is there.

    settings: plain values that decide the outcomes.
    notes: what does not decide them; written down when the run begins, never compared.

    Returns:
        What `run.json` holds. Several shards may claim the same folder at once: the first writes
        it.
    """
    for packed in sorted(folder.glob("episodes*.jsonl.xz")):
        raise UserError(
            f"{packed} is compressed, and a run continues with plain records: unpack it (xz -d), or"
            " choose another folder."
        )
    settings = to_json(settings)  # as they will be read back
    content = {
        "settings": settings,
        "fingerprint": fingerprint(settings),
        "notes": dict(notes or {}),
        "begun": datetime.now(UTC).isoformat(timespec="seconds"),
    }
    folder.mkdir(parents=True, exist_ok=True)
    try:
        write_new(
            folder / RUN_FILE, json.dumps(with_checksum(content), indent=2, sort_keys=True) + "\n"
        )
        return content
    except FileExistsError:
        await_content(folder / RUN_FILE)
    there = read_run(folder)
    if "split_sha256" not in there["settings"]:  # of a version that did not note it
        settings = without(settings, "split_sha256")
    if there["fingerprint"] != fingerprint(settings):
        earlier, later = flat(there["settings"]), flat(settings)
        changes = []
        for key in sorted({*earlier, *later}):
            old, new = earlier.get(key, "not set"), later.get(key, "not set")
            if old != new:
                changes.append(f"{key} was {brief(old)}, is {brief(new)}")
        raise UserError(
            f"{folder} holds a run with other settings: {'; '.join(changes)}. Resume it with its"
            " own settings, or choose another folder."
        )
    return there


def check_run_folder(folder: Path) -> None:
    """Make sure that a folder is new, empty, or holds a run already.

    Raises:
        UserError: it holds something else.
    """
    if (folder / RUN_FILE).exists() or any(folder.glob("episodes*.jsonl")):
        return
    require(
        not folder.exists() or folder.is_dir(),
        f"output={folder} is a file: name a folder.",
    )
    # another process that shares the run may be writing its first file
    is_empty = not folder.exists() or all(map(is_draft, folder.iterdir()))
    require(
        is_empty,
        f"output={folder} holds files, but no run of this command: choose a new folder, or an"
        " empty one.",
    )


def read_run(folder: Path) -> dict[str, Any]:
    """Read a folder's `run.json`."""
    path = folder / RUN_FILE
    content = read_json(path, "a run's settings", finite=False)
    require(
        content.get("fingerprint") == fingerprint(content.get("settings", {})),
        f"{path} is damaged or was changed manually: its settings do not have its fingerprint."
        " Remove it if the records beside it are of this run.",
    )
    return verified(content, str(path))


def write_new(target: Path, text: str) -> None:
    """Write a file that is not there yet.

    Raises:
        FileExistsError: it is.
    """
    remove_drafts(target.parent)
    mine = draft_of(target)
    mine.write_text(text, encoding="utf-8")
    try:
        os.link(mine, target)  # whole or not at all, and never over another's
    except FileExistsError:
        raise
    except OSError:  # a file system without hard links
        with target.open("x", encoding="utf-8") as file:
            file.write(text)
    finally:
        mine.unlink(missing_ok=True)


def await_content(path: Path) -> None:
    # Without hard links another process may have made the file, but not filled it yet.
    end = time.monotonic() + 2
    while path.stat().st_size == 0 and time.monotonic() < end:
        time.sleep(0.05)


RECORDS = "episodes.jsonl"  # Name of a run's file; its shards are called `episodes-<shard>.jsonl`


def read_folders(paths: Iterable[Path]) -> list[EpisodeRecord]:
    """Read files of records, such as `find_records` finds."""
    return [record for path in paths for record in read_records(path)]


def files_below(folder: Path, *names: str) -> list[Path]:
    """The files of these names in a folder or below, in order, each once; links to folders are
    followed.
    """
    matches: list[str] = []
    for name in names:
        matches += glob(  # noqa: PTH207 - a `Path` follows no links below itself
            f"**/{name}", root_dir=folder, recursive=True, include_hidden=True
        )
    paths = [folder / match for match in sorted(matches)]
    return list({path.resolve(): path for path in reversed(paths)}.values())[::-1]


def find_records(paths: Iterable[Path]) -> list[Path]:
    """The files behind a list of files and folders; of a folder, every `episodes*.jsonl`, or
    `.jsonl.xz`, below it.
    """
    files: list[Path] = []
    for path in paths:
        if path.is_file():
            files.append(path)
            continue
        if not path.is_dir():
            raise UserError(f"{path} does not exist: name files of records, or folders.")
        below = files_below(path, "episodes*.jsonl", "episodes*.jsonl.xz")
        if not below:
            raise UserError(
                f"{path} holds no results: no {RECORDS} or episodes-<shard>.jsonl in it or below."
            )
        files += below
    return list({path.resolve(): path for path in files}.values())
