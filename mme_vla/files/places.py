"""Names and paths that a stranger's file gives: used only where they stay in its folder."""

import re
from pathlib import Path

from mme_vla.errors import UserError, brief


def inside(folder: Path, name: str, what: str = "file") -> Path:
    """Return the path of `name` in `folder`, symbolic links followed.

    Raises:
        UserError: the name is empty, absolute, or leads out of the folder, by `..` or by a link.
    """
    place, root = folder / name, folder.resolve()
    try:
        found = place.resolve()
    except (OSError, ValueError, RuntimeError):  # a null character, a loop of links
        found = Path("/")
    if not name or Path(name).is_absolute() or not found.is_relative_to(root) or found == root:
        raise UserError(
            f"{folder} names the {what} {brief(name)}, which lies outside of it. Nothing outside a checkpoint's or "
            "dataset's own folder is read for it; copy the file into the folder, or correct the name."
        )
    return place


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
