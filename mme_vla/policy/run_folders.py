"""Where a run of training lies on disk: its checkpoints, the newest of them, and what `latest`
means.
"""

import re
import shlex
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from mme_vla.errors import UserError, require
from mme_vla.registry import extensions, join_names

OUTPUTS = "outputs"
"""The folder of the current one in which commands write."""
CHECKPOINTS = "checkpoints"
EXAMPLE = f"{OUTPUTS}/<model>/<date>/{CHECKPOINTS}/step_000500"
"""A checkpoint's folder, for messages."""
STATE = "training_state.json"
"""The file of a checkpoint that is written last: where it is, the checkpoint is whole."""
_STEP = re.compile(r"step_(\d+)")


def checkpoints_in(folder: Path) -> list[Path]:
    """The finished checkpoints in a `checkpoints` folder, oldest step first."""
    folders = []
    for path in folder.glob("step_*"):
        if _STEP.fullmatch(path.name) and (path / STATE).is_file():
            folders.append(path)
    return sorted(folders, key=step_of)


def checkpoint_name(step: int) -> str:
    """The folder name of the checkpoint after `step` updates."""
    return f"step_{step:06d}"


def step_of(checkpoint: Path) -> int:
    """The step in a checkpoint folder's name."""
    match = _STEP.fullmatch(checkpoint.name)
    return int(match[1]) if match else -1


_TRAINING = re.compile(r"training_(\d+)")


def training_name(number: int) -> str:
    """The folder name of one of several trainings of one recipe, counted from 0."""
    return f"training_{number}"


def trainings_in(folder: Path) -> list[Path]:
    """The run folders of the trainings of one recipe in `folder` that wrote a checkpoint, in their
    order.
    """
    runs = []
    for path in folder.glob("training_*"):
        if _TRAINING.fullmatch(path.name) and checkpoints_in(path / CHECKPOINTS):
            runs.append(path)
    return sorted(runs, key=lambda path: int(path.name.removeprefix("training_")))


def newest_write(run: Path) -> int:
    """When a run, or one of its trainings, wrote a checkpoint last, in nanoseconds; 0 without a
    checkpoint.
    """
    newest = 0
    for folder in (run, *trainings_in(run)):
        checkpoints = checkpoints_in(folder / CHECKPOINTS)
        if checkpoints:
            newest = max(newest, checkpoints[-1].stat().st_mtime_ns)
    return newest


LATEST = "latest"
"""`outputs/<model>/latest` is the run in `outputs/<model>` that wrote a checkpoint last. Where a
folder is a run itself, its `latest` is that run. No folder is called so.
"""


def check_output(place: str | Path) -> None:
    """Make sure that `output` has a name, none that means another folder, and can be made."""
    require(
        str(place).strip(),
        "output= is empty: name the place to write to, such as output=outputs/mine.",
    )
    folder = Path(place)
    require(
        folder.name != LATEST,
        f"output={folder}: {LATEST!r} is reserved, {folder} means the newest run in"
        f" {folder.parent}. Choose another name.",
    )
    try:
        nearest = folder.expanduser().absolute()
        is_new = not nearest.exists()
        while not nearest.exists():
            nearest = nearest.parent
        if is_new:
            # Permissions alone do not tell: some file systems take no folders.
            tempfile.TemporaryDirectory(dir=nearest).cleanup()
    except OSError as error:
        raise UserError(
            f"output={folder} cannot be made: {error.strerror}. Choose another place."
        ) from error


def shipped_checkpoints() -> dict[str, Path]:
    """The checkpoints that extras and installed packages bring along: name → folder."""
    brought = [(extension, extension.checkpoints) for extension in extensions()]
    return join_names("checkpoint", {}, brought)


def shipped_name(folder: Path) -> str | None:
    """The name under which a checkpoint folder ships; None for any other folder."""
    for name, shipped in shipped_checkpoints().items():
        if shipped == folder:
            return name
    return None


def find_run(path: Path) -> Path:
    """`path`, the newest run where it ends in `latest`, or the checkpoint that ships under this
    name (`shipped_checkpoints`).

    A file or folder of that name goes first.
    """
    if path.exists():
        return path
    shipped = shipped_checkpoints().get(str(path))
    if shipped is not None:
        return shipped
    if path.name != LATEST:
        return path
    runs = [run for run in path.parent.glob("*") if newest_write(run)]
    if not runs and newest_write(path.parent):
        return path.parent  # it is a run itself
    if runs:
        return max(runs, key=lambda run: (newest_write(run), run.name))
    hint = ""
    trained = [run for run in Path(OUTPUTS).glob("*/*") if newest_write(run)]
    if trained:
        hint = f" Did you mean {max(trained, key=newest_write).parent / LATEST}?"
    raise UserError(
        f"No run with a checkpoint in {path.parent}, so there is no {path}: train one, or name"
        f" another.{hint}"
    )


def check_checkpoint(config: Mapping[str, Any]) -> None:
    """Check that the checkpoint of a command's configuration is there, without PyTorch."""
    if config["checkpoint"] is not None:
        resolve_checkpoint(Path(str(config["checkpoint"])))


def resolve_checkpoint(path: Path) -> Path:
    """A checkpoint folder from what a user gives: itself, its run folder or the `checkpoints`
    folder (then the newest).

    A path that ends in `latest` means the newest run of its folder, and a name of
    `shipped_checkpoints` that checkpoint.
    """
    newest = newest_checkpoint(path)
    if newest != path or (path / "config.json").is_file():
        return newest
    if trainings := trainings_in(path):
        raise UserError(
            f"{path} holds {len(trainings)} trainings of one recipe: name one of them, such as"
            f" {trainings[0]}. mme-vla evaluate and results take all of them."
        )
    # A run of the released code, a step of one, its arrays, or the zip of a step.
    steps = [step for step in path.glob("*") if step.stem.isdigit()]
    for step in [path, *steps]:
        if step.suffix == ".zip" or step.name == "params" or (step / "params").is_dir():
            raise UserError(
                f"{path} is a checkpoint of the released code, in another format. Convert it, then"
                f" name the new folder: mme-vla weights {shlex.quote(str(path))}"
                f" {shlex.quote(str(path).removesuffix('.zip') + '_converted')} (with model=<model>"
                " where no history_config.txt names the variant)."
            )
    require(
        str(path) not in shipped_checkpoints(),
        f"The folder {path} holds no checkpoint, and hides the one that ships under this name:"
        " rename it, or run the command in another folder.",
    )
    reason = "" if path.exists() else " there is no such folder;"
    raise UserError(
        f"No checkpoint at {path}:{reason} expected a folder such as {EXAMPLE}, or the run folder"
        " above it."
    )


def newest_checkpoint(path: Path) -> Path:
    """The newest checkpoint of a run, of its `checkpoints` folder or of a name of `find_run`; else
    `path` itself.
    """
    path = find_run(path)
    checkpoints = checkpoints_in(path) or checkpoints_in(path / CHECKPOINTS)
    return checkpoints[-1] if checkpoints else path


def locate_checkpoint(source: str | Path) -> str:
    """The checkpoint folder that `source` names; `source` itself where it is none on this machine,
    but on the hub.

    Raises:
        UserError: a folder on this machine, or a path of `check_on_machine`, without a checkpoint.
    """
    path = find_run(Path(source).expanduser())
    check_on_machine(path)
    if not path.exists():
        return str(source)
    return str(resolve_checkpoint(path))


def check_on_machine(path: Path) -> None:
    """Refuse a missing path that cannot be of the hub: its names are `owner/name` or
    `owner/name/folder`, relative, and not in `outputs/`.

    A path of three parts or more whose first folder is on this machine is never of the hub.
    """
    if path.exists():
        return
    parts = path.parts
    below_folder = len(parts) > 2 and Path(parts[0]).is_dir()
    is_path = path.is_absolute() or parts[0] in (OUTPUTS, "..")
    require(
        len(parts) > 1 and not is_path and not below_folder,
        f"No checkpoint at {path}: there is no such folder. Expected one with a config.json, such"
        f" as {EXAMPLE}, the run folder above it, a checkpoint that ships"
        f" ({', '.join(shipped_checkpoints())}), or owner/name of a repository on the hub.",
    )
