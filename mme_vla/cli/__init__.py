"""The commands: the only place that reads a command line. `mme-vla NAME` and
`python -m mme_vla NAME` run them.
"""

import os
import sys
from collections.abc import Callable
from importlib import import_module
from typing import TYPE_CHECKING

from mme_vla.cli.errors import print_user_errors
from mme_vla.errors import require
from mme_vla.registry import Command, extensions
from mme_vla.utils.processes import started_processes

if TYPE_CHECKING:
    from omegaconf import DictConfig

COMMANDS = {
    "train": Command(
        "mme_vla.cli.train",
        "train a policy",
        config="train",
        usage="python -m mme_vla.train",
        processes="shared",
    ),
    "evaluate": Command(
        "mme_vla.cli.evaluate",
        "run a policy on the benchmark",
        config="evaluate",
        usage="python -m mme_vla.evaluate",
        processes="shared",
    ),
    "results": Command(
        "mme_vla.cli.results",
        "tables, comparisons and a report from finished runs",
        usage="python -m mme_vla.results",
        processes="any",
    ),
    "inspect": Command(
        "mme_vla.cli.inspect",
        "what is in a checkpoint, a dataset or an episode, and what a memory remembers of it",
        config="inspect",
        usage="python -m mme_vla.inspect",
        processes="any",
    ),
    "serve": Command(
        "mme_vla.cli.serve",
        "put a policy behind a port",
        config="serve",
        usage="python -m mme_vla.serve",
    ),
    "harness": Command("mme_vla.cli.harness", "put a policy behind AI2's vla-evaluation-harness"),
    "convert": Command(
        "mme_vla.cli.convert",
        "official HDF5 demonstrations to one LeRobot dataset",
        config="convert",
    ),
    "exec-starts": Command(
        "mme_vla.cli.exec_starts",
        "where the conditioning videos of a dataset end, if it has no such column",
        config="exec_starts",
    ),
    "cache": Command(
        "mme_vla.cli.cache",
        "the vision tokens of a dataset, computed once",
        config="cache",
        processes="shared",
    ),
    "record": Command(
        "mme_vla.cli.record",
        "demonstrate episodes of the benchmark and keep them as a dataset",
        config="record",
    ),
    "gallery": Command(
        "mme_vla.cli.gallery",
        "the tasks at a glance, one demonstrated episode each, on one page",
        config="show",
    ),
    "weights": Command("mme_vla.cli.weights", "a checkpoint from one format to another"),
    "subgoal-build": Command(
        "mme_vla.cli.subgoal_build",
        "training data of the subgoal predictors",
        config="subgoal_build",
    ),
    "subgoal-train": Command(
        "mme_vla.cli.subgoal_train",
        "fine-tune a subgoal predictor",
        config="subgoal_train",
        processes="shared",
    ),
    "sample": Command("mme_vla.cli.sample", "the dataset that the package ships, from a full one"),
    "train-tokenizer": Command("mme_vla.cli.train_tokenizer", "the small tokenizer of the package"),
    "docs": Command(
        "mme_vla.cli.docs", "this documentation as a site, built and opened without a network"
    ),
}
"""The core's commands by the name on the command line."""


def commands() -> dict[str, Command]:
    """All commands: the core's, its extras', and those of installed packages."""
    all_commands = dict(COMMANDS)
    for extension in extensions():
        for name, command in extension.commands.items():
            all_commands.setdefault(name, command)
    return all_commands


_PRINTING = {"-h", "--help", "--hydra-help", "-c", "--cfg"}  # Options that only print


def run(name: str) -> None:
    """Run a command: check its words, import its module, and call its `main`.

    A command with a configuration is imported once that is composed, so that help and mistakes do
    not wait for PyTorch. Ctrl-C ends an import with a message, too.
    """
    # Threads that wait for each other asleep leave their cores to data workers and environments:
    # busy waiting slows a step tenfold. It counts only when set before PyTorch is imported.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
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
        run_configured(command.config, main)


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
