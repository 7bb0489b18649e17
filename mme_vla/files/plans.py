"""Work folders: what a command is about to make stands in `plan.json`, so that a repetition knows its own."""

import shutil
from pathlib import Path
from typing import Any

from mme_vla.errors import UserError
from mme_vla.files.locks import LOCK
from mme_vla.files.reading import read_json
from mme_vla.files.writing import is_draft, remove_drafts, write_json

PLAN = "plan.json"


def claim_plan(folder: Path, plan: Any) -> bool:
    """Make `folder` the work folder of a plan, or recognise it as such. The caller holds its lock.

    A folder without any work is nobody's, whatever a run left that was killed while it wrote its plan.

    Args:
        plan: plain JSON, an object or a list.

    Returns:
        Whether the folder is this plan's; False where it holds something else.
    """
    folder.mkdir(parents=True, exist_ok=True)
    record, about = folder / PLAN, "the plan of a command's work"
    if record.exists():
        try:
            if read_json(record, about, kind=(dict, list)) == plan:
                remove_drafts(folder)
                return True
        except UserError:
            pass  # cut off when the machine went down: nobody's, if there is no work yet
        else:
            return False
    if any(_is_work(path) for path in folder.iterdir()):
        return False
    remove_drafts(folder)
    write_json(record, plan, indent=1)
    return True


def drop_plan(folder: Path) -> None:
    """Remove a plan's work folder, the plan last: a removal that was cut off is recognised, and repeated.

    The caller holds the folder's lock, whose release removes the folder itself.
    """
    for path in folder.iterdir():
        if path.name not in (PLAN, LOCK):
            if path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            else:
                path.unlink()
    (folder / PLAN).unlink(missing_ok=True)


def _is_work(path: Path) -> bool:
    if path.name in (PLAN, LOCK) or is_draft(path):
        return False
    return not path.is_dir() or any(path.iterdir())
