"""The commands: the only place that reads a command line. `mme-vla NAME` and
`python -m mme_vla NAME` run them; `table.py` lists them.
"""

import atexit
import os
import sys
import warnings
from collections.abc import Callable
from importlib import import_module
from typing import TYPE_CHECKING

from mme_vla.cli.errors import print_user_errors
from mme_vla.cli.table import commands as commands
from mme_vla.errors import printable, require
from mme_vla.registry import Command
from mme_vla.utils.processes import started_processes

if TYPE_CHECKING:
    from omegaconf import DictConfig

_PRINTING = {"-h", "--help", "--hydra-help", "-c", "--cfg"}  # Options that only print


def run(name: str) -> None:
    """Run a command: check its words, import its module, and call its `main`.

    A command with a configuration is imported once that is composed, so that help and mistakes do
    not wait for PyTorch. Ctrl-C ends an import with a message, too.
    """
    # Threads that wait for each other asleep leave their cores to data workers and environments:
    # busy waiting slows a step tenfold. It counts only when set before PyTorch is imported.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    atexit.register(_end_quietly)
    warnings.showwarning = _show_warning
    with print_user_errors():
        command = commands()[name]
        if _PRINTING.isdisjoint(sys.argv[1:]):
            check_launcher(name)
        if command.reads_words or not command.config:
            load_main(command)()
            return
        from mme_vla.cli.command import run_configured  # Hydra, which other commands do without

        def main(cfg: "DictConfig") -> object:
            return load_main(command)(cfg)

        main.__module__ = command.module
        run_configured(command.config, main, check=command.check)


def _show_warning(message: Warning | str, *_: object, **__: object) -> None:
    """Print a warning without its place in the code."""
    print(f"Warning: {printable(str(message))}", file=sys.stderr)


def _end_quietly() -> None:
    """Close standard error last of all, where the planner's package was loaded.

    OMPL's extension module lists, at the interpreter's end, what it did not free: tens of lines
    after a command's result.
    """
    if "ompl" in sys.modules and sys.stderr is not None:
        sys.stderr.flush()
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)


def load_main(command: Command) -> Callable[..., object]:
    """Import a command's module.

    A terminal gets a line at once, since imports take seconds. Logs and pipes stay as they are.
    """
    is_first = os.environ.get("LOCAL_RANK", "0") == "0"
    is_printing = not _PRINTING.isdisjoint(sys.argv[1:])
    if is_first and not is_printing and command.module not in sys.modules and sys.stderr.isatty():
        print("Loading PyTorch and LeRobot …", file=sys.stderr, flush=True)
    main: Callable[..., object] = import_module(command.module).main
    return main


def check_launcher(name: str) -> None:
    """Refuse to start a command in several processes that would each do all of its work.

    Raises:
        UserError: a launcher started this process beside others, and the command does not share its
            work; or a launcher was asked for several processes and started one.
    """
    known = commands()
    if known[name].processes != "one":
        return
    started = started_processes()
    sharing = ", ".join(name for name, command in known.items() if command.processes == "shared")
    require(
        started == 1,
        f"{started} processes were started (WORLD_SIZE), and each would do all of this command's"
        f" work: start it without a launcher. Commands that share their work: {sharing}.",
    )
