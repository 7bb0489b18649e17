"""LeRobot's own commands, in forks of one process that has imported them: importing takes longer than they do.

That process is itself forked from the one that has imported PyTorch, LeRobot's datasets and the simulator.
"""

import importlib
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from plugin_packages import PLUGINS

from mme_vla.envs.vector import worker

TRAIN, EVAL, VIZ = (f"lerobot.scripts.lerobot_{name}" for name in ("train", "eval", "dataset_viz"))


class LeRobot:
    """The process that runs LeRobot's commands, at the other end of a connection."""

    def __init__(self, connection: "Connection[object, int]") -> None:
        self._connection = connection

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
        said = folder / "said.txt"
        self._connection.send((paths, commands, said))
        ended, printed = self._connection.recv(), said.read_text()
        assert ended == 0, printed[-6000:]
        return printed


@contextmanager
def lerobot(folder: Path) -> Iterator[LeRobot]:
    """LeRobot's commands, on the CPU, with this folder for what Hugging Face's libraries keep."""
    environment = os.environ | {"ACCELERATE_USE_CPU": "true"}
    context = worker.simulating_processes()
    ours, theirs = context.Pipe()
    process = context.Process(target=worker.begin, args=(environment, _serve, theirs, folder))
    process.start()
    theirs.close()
    with ours:
        yield LeRobot(ours)
    process.join()


def _serve(connection: "Connection[int, object]", folder: Path) -> None:
    import datasets.config
    import draccus.wrappers.docstring as described
    import huggingface_hub.constants

    # What the variables HF_HUB_OFFLINE and HF_HOME say to a process that has yet to import these.
    huggingface_hub.constants.HF_HUB_OFFLINE = datasets.config.HF_HUB_OFFLINE = True
    datasets.config.HF_DATASETS_CACHE = folder
    # Nobody reads the help, which is searched for in the source of every class, for each command anew.
    described.get_attribute_docstring = lambda *_: described.AttributeDocString()
    sys.path.insert(0, str(PLUGINS.parent))
    for module in (TRAIN, EVAL):
        importlib.import_module(module)
    while True:
        try:
            asked: Any = connection.recv()
        except EOFError:
            return
        child = os.fork()
        if child == 0:
            return _run(*asked)
        connection.send(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))


def _run(paths: Sequence[str], commands: Sequence[Sequence[str]], said: Path) -> None:
    with said.open("wb") as file:
        os.dup2(file.fileno(), 1)
        os.dup2(file.fileno(), 2)
    sys.path[:0] = paths
    for module, *words in commands:
        print(f"\n$ {module} {' '.join(words)}", flush=True)
        sys.argv = [module, *words]
        importlib.import_module(module).main()
