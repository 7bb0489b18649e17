"""LeRobot's own commands, in forks of one process that has imported them: importing takes longer than they do.

That process is this file, run as a script. Of each line that it reads, the path of a JSON file, it runs what stands
there: `{"paths": [of sys.path, …], "commands": [[module, word, …], …], "said": where it is printed}`.
"""

import importlib
import json
import os
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

from plugin_packages import PLUGINS

TRAIN, EVAL, VIZ = (f"lerobot.scripts.lerobot_{name}" for name in ("train", "eval", "dataset_viz"))


class LeRobot:
    """The process that runs LeRobot's commands."""

    def __init__(self, process: "subprocess.Popen[str]") -> None:
        self._process = process

    def run(self, folder: Path, commands: Sequence[Sequence[str]], plugins: Mapping[str, str]) -> str:
        """Run commands with some of our plugins there as if installed: distribution → folder in plugins/.

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
        listed, said = folder / "commands.json", folder / "said.txt"
        listed.write_text(json.dumps({"paths": paths, "commands": [list(c) for c in commands], "said": str(said)}))
        assert self._process.stdin is not None and self._process.stdout is not None
        print(listed, file=self._process.stdin, flush=True)
        ended = self._process.stdout.readline().strip()
        printed = said.read_text()
        assert ended == "0", printed[-6000:]
        return printed


@contextmanager
def lerobot(folder: Path) -> Iterator[LeRobot]:
    """LeRobot's commands, on the CPU, with this folder for what Hugging Face's libraries keep."""
    environment = os.environ | {
        "PYTHONPATH": str(PLUGINS.parent),
        "HF_HUB_OFFLINE": "1",
        "HF_HOME": str(folder),
        "ACCELERATE_USE_CPU": "true",
    }
    command = [sys.executable, __file__]
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
    ) as process:
        yield LeRobot(process)


def _main() -> None:
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what is printed while importing is no answer
    for module in (TRAIN, EVAL, "mme_vla.envs.vector.preloaded"):
        importlib.import_module(module)
    for line in sys.stdin:
        child = os.fork()
        if child == 0:
            return _run(**json.loads(Path(line.strip()).read_text()))
        print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), file=answers, flush=True)


def _run(paths: Sequence[str], commands: Sequence[Sequence[str]], said: str) -> None:
    with Path(said).open("wb") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    sys.path[:0] = paths
    for module, *words in commands:
        print(f"\n$ {module} {' '.join(words)}", flush=True)
        sys.argv = [module, *words]
        importlib.import_module(module).main()


if __name__ == "__main__":
    _main()
