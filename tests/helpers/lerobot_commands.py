"""LeRobot's own commands in fresh processes, with packages of plugins/ as if installed."""

import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from helpers import REPOSITORY
from helpers.plugins import PLUGINS

TRAIN, EVAL, VIZ = (f"lerobot.scripts.lerobot_{name}" for name in ("train", "eval", "dataset_viz"))


def run_lerobot(folder: Path, commands: Sequence[Sequence[str]], plugins: Mapping[str, str]) -> str:
    """Run commands one after the other on the CPU, offline. A command that fails fails the test.

    Args:
        folder: of metadata of the plugins and of the files of Hugging Face's libraries.
        plugins: distribution name → folder in plugins/.

    Returns:
        The output of all commands.
    """
    paths = [str(REPOSITORY), str(REPOSITORY / "tests")]
    for name, plugin in plugins.items():
        metadata = folder / "site" / f"{name}-0.1.0.dist-info"  # LeRobot finds plugins by it
        metadata.mkdir(parents=True)
        (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 0.1.0\n")
        paths += [str(PLUGINS / plugin / "src"), str(metadata.parent)]
    variables = {"PYTHONPATH": os.pathsep.join(paths), "HF_HUB_OFFLINE": "1", "HF_HOME": str(folder / "hf")}
    printed = ""
    for command in commands:
        done = subprocess.run(
            [sys.executable, "-m", *command], env={**os.environ, **variables, "ACCELERATE_USE_CPU": "true"},
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        )  # fmt: skip
        assert done.returncode == 0, done.stdout[-6000:]
        printed += done.stdout
    return printed
