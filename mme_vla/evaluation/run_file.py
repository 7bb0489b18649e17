"""`run.json` beside a run's records: the settings that decide its results, so that a run resumes as what it was."""

import hashlib
import json
import os
import time
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from mme_vla.errors import UserError, brief
from mme_vla.files import draft_of, plain, read_json, remove_drafts, sealed, unsealed

RUN_FILE = "run.json"
INDIFFERENT = ("workers", "batch_size", "device", "cache", "key_variable", "base_url", "timeout", "retries", "backoff",
               "requests_per_minute", "input_price", "output_price")  # fmt: skip
"""Options of a model that predicts or plays which do not decide what it says, and may differ when a run goes on."""


def fingerprint(settings: Mapping[str, Any]) -> str:
    """SHA-256 of the settings, whatever the order of their keys."""
    return hashlib.sha256(json.dumps(settings, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def claim_run(folder: Path, settings: Mapping[str, Any], notes: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Begin a run in `folder`, or go on with the one that is there.

    Args:
        settings: plain values that decide the outcomes: checkpoint, seeds, split, step limit, action space, …
        notes: what does not (device, workers, versions); written down when the run begins, never compared.

    Returns:
        What `run.json` holds. Several shards may claim the same folder at once: the first writes it.

    Raises:
        UserError: the folder holds a run with other settings; each difference is named.
    """
    settings = plain(settings)  # as they will be read back
    content = {
        "settings": settings,
        "fingerprint": fingerprint(settings),
        "notes": dict(notes or {}),
        "begun": datetime.now(UTC).isoformat(timespec="seconds"),
    }
    folder.mkdir(parents=True, exist_ok=True)
    try:
        _write_new(folder / RUN_FILE, json.dumps(sealed(content), indent=2, sort_keys=True) + "\n")
        return content
    except FileExistsError:
        _await_content(folder / RUN_FILE)
    there = read_run(folder)
    if there["fingerprint"] != content["fingerprint"]:
        raise UserError(
            f"{folder} holds a run with other settings: {_differences(there['settings'], settings)}. "
            "Resume it with its own settings, or choose another folder."
        )
    return there


def read_run(folder: Path) -> dict[str, Any]:
    """Read a folder's `run.json`.

    Raises:
        UserError: it is missing or damaged.
    """
    path = folder / RUN_FILE
    content = read_json(path, "a run's settings", finite=False)
    if not isinstance(content.get("settings"), dict) or not isinstance(content.get("fingerprint"), str):
        raise UserError(
            f"{path} is damaged: it lacks settings or their fingerprint; remove it if the records beside "
            "it are of this run."
        )
    if content["fingerprint"] != fingerprint(content["settings"]):
        raise UserError(f"{path} was changed by hand: its settings do not have its fingerprint.")
    return unsealed(content, str(path))


def _write_new(target: Path, text: str) -> None:
    """Write a file that is not there yet.

    Raises:
        FileExistsError: it is.
    """
    remove_drafts(target.parent)
    mine = draft_of(target)
    mine.write_text(text)
    try:
        os.link(mine, target)  # whole or not at all, and never over another's
    except FileExistsError:
        raise
    except OSError:  # a file system without hard links
        with target.open("x") as file:
            file.write(text)
    finally:
        mine.unlink(missing_ok=True)


def _await_content(path: Path, patience: float = 2) -> None:
    """Without hard links another process may have made the file, but not filled it yet."""
    end = time.monotonic() + patience
    while path.stat().st_size == 0 and time.monotonic() < end:
        time.sleep(0.05)


def _differences(there: Mapping[str, Any], now: Mapping[str, Any]) -> str:
    before, after = _flat(there), _flat(now)
    changed = [key for key in sorted({*before, *after}) if before.get(key, _NOTHING) != after.get(key, _NOTHING)]
    told = (f"{key} was {brief(before.get(key, 'not set'))}, is {brief(after.get(key, 'not set'))}" for key in changed)
    return "; ".join(told)


_NOTHING = object()


def _flat(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in values.items():
        flat |= _flat(value, f"{prefix}{key}.") if isinstance(value, Mapping) else {f"{prefix}{key}": value}
    return flat
