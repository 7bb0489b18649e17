"""LeRobot's own commands, one after the other in one process of their own: importing them takes longer than they do.

Run as a script it takes a JSON file with a list of [module, word, …]; tests call `run_commands`.
"""

import importlib
import json
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from plugin_packages import PLUGINS

TRAIN, EVAL, VIZ = (f"lerobot.scripts.lerobot_{name}" for name in ("train", "eval", "dataset_viz"))


def run_commands(folder: Path, commands: Sequence[Sequence[str]], plugins: Mapping[str, str]) -> str:
    """Run LeRobot's commands with some of our plugins there as if installed: distribution → folder in plugins/.

    Returns:
        What they printed. A command that fails fails the test, with all of it.
    """
    paths = []
    for name, plugin in plugins.items():
        source = PLUGINS / plugin / "src"
        installed = folder / "site" / f"{name}-0.1.0.dist-info"  # what LeRobot looks for
        installed.mkdir(parents=True)
        (installed / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 0.1.0\n")
        paths += [str(source), str(installed.parent)]
    listed = folder / "commands.json"
    listed.write_text(json.dumps([list(command) for command in commands]))
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join([str(PLUGINS.parent), *paths]),
        "HF_HUB_OFFLINE": "1",
        "HF_HOME": str(folder / "hf"),
        "ACCELERATE_USE_CPU": "true",
    }
    done = subprocess.run(
        [sys.executable, __file__, str(listed)], capture_output=True, text=True, env=environment, timeout=280
    )
    said = done.stdout + done.stderr
    assert done.returncode == 0, said[-6000:]
    return said


def _main(listed: Path) -> None:
    for module, *words in json.loads(listed.read_text()):
        print(f"\n$ {module} {' '.join(words)}", flush=True)
        sys.argv = [module, *words]
        importlib.import_module(module).main()


if __name__ == "__main__":
    _main(Path(sys.argv[1]))
