"""Names and paths that a stranger's file gives: used only where they stay in its folder."""

import os
import re
from pathlib import Path

from mme_vla.errors import UserError, brief


def inside(folder: Path, name: str, what: str = "file") -> Path:
    """Return the path of `name` in `folder`, symbolic links followed.

    A snapshot in the hub's cache is made of links to the files of its repository's folder, `../../blobs/…`: these count
    as its own.

    Raises:
        UserError: the name is empty, absolute, or leads out of the folder, by `..` or by a link.
    """
    place, root = folder / name, folder.resolve()
    try:
        found = place.resolve()
    except (OSError, ValueError, RuntimeError):  # a null character, a loop of links
        found = Path("/")
    within = found.is_relative_to(root) and found != root
    linked = ".." not in Path(name).parts and any(found.is_relative_to(blobs) for blobs in _blobs_of(root))
    if not name or Path(name).is_absolute() or not (within or linked):
        raise UserError(
            f"{folder} names the {what} {brief(name)}, which lies outside of it. Nothing outside a checkpoint's or "
            "dataset's own folder is read for it; copy the file into the folder, or correct the name."
        )
    return place


def _blobs_of(root: Path) -> list[Path]:
    """Where the hub's cache keeps the files of the snapshot that `root` is, or lies in; nowhere for other folders."""
    for place in (root, *root.parents):
        repository = place.parent.parent
        if place.parent.name == "snapshots" and _HUB_REPOSITORY.match(repository.name):
            return [repository / "blobs"]
    return []


_HUB_REPOSITORY = re.compile(r"(models|datasets|spaces)--")
_SAFE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._+=-]{0,99}")


def safe_name(name: str, what: str = "name") -> str:
    """Return `name` if it can be a folder's name anywhere: letters, digits, `. _ + = -`, at most 100 characters.

    Raises:
        UserError: it is something else, such as a path.
    """
    if not isinstance(name, str) or not _SAFE_NAME.fullmatch(name):
        raise UserError(
            f"{what}={brief(name)} cannot name a folder: use at most 100 letters, digits and . _ + = -, "
            "beginning with a letter or digit."
        )
    return name


def user_cache(kind: str) -> Path:
    """Where what can be made again is kept for this user: a folder in $MME_VLA_CACHE, else in ~/.cache/mme_vla."""
    return Path(os.environ.get("MME_VLA_CACHE", Path.home() / ".cache" / "mme_vla")) / kind
