"""The commands: the only place that reads a command line. `mme-vla NAME` and
`python -m mme_vla NAME` run them.
"""

import os
import sys
from importlib import import_module

from mme_vla.cli.errors import print_user_errors
from mme_vla.errors import require
from mme_vla.utils.processes import started_processes

COMMANDS: dict[str, tuple[str, str]] = {
    "train": ("train", "train a policy"),
    "evaluate": ("evaluate", "run a policy on the benchmark"),
    "results": ("results", "tables, comparisons and a report from finished runs"),
    "analyse": ("analyse", "what a memory attends to, selects, modulates and costs"),
    "probe": (
        "probe",
        "what a policy takes from its memory, on recorded episodes and in closed loop",
    ),
    "inspect": (
        "inspect",
        "what is in a checkpoint, a dataset or an episode, and what a memory remembers of it",
    ),
    "serve": ("serve", "put a policy behind a port"),
    "harness": ("harness", "put a policy behind AI2's vla-evaluation-harness"),
    "play": ("play", "play the tasks yourself, or let a model play"),
    "convert": ("convert", "official HDF5 demonstrations to one LeRobot dataset"),
    "exec-starts": (
        "exec_starts",
        "where the conditioning videos of a dataset end, if it has no such column",
    ),
    "cache": ("cache", "the vision tokens of a dataset, computed once"),
    "nano": (
        "nano",
        "small policies from nothing to results on two cores; `nano board` ranks them",
    ),
    "vision-pretrain": (
        "vision_pretrain",
        "the vision tower of the nano backbone, from renders of the tasks",
    ),
    "record": ("record", "demonstrate episodes of the benchmark and keep them as a dataset"),
    "gallery": ("gallery", "the tasks at a glance, one demonstrated episode each, on one page"),
    "weights": ("weights", "a checkpoint from one format to another"),
    "subgoal-build": ("subgoal_build", "training data of the subgoal predictors"),
    "subgoal-train": ("subgoal_train", "fine-tune a subgoal predictor"),
    "sample": ("sample", "the dataset that the package ships, from a full one"),
    "train-tokenizer": ("train_tokenizer", "the small tokenizer of the package"),
    "docs": ("docs", "this documentation as a site, built and opened without a network"),
}
"""Name on the command line → module of this package, and a line of help."""


SHARED = {"train", "evaluate", "probe", "cache", "subgoal_train"}
"""Modules of commands whose work several processes of a launcher share."""
READING = {"results", "analyse", "inspect"}
"""Modules of commands that print what exists, which any number of processes may do."""

_WITHOUT_PYTORCH = {"-h", "--help", "--hydra-help", "-c", "--cfg"}  # Options that only print


def run(module: str) -> None:
    """Run the command in a module of this package, importing it first: Ctrl-C ends the import with
    a message, too.

    A terminal gets a line at once, since imports take seconds. Logs and pipes stay as they are.
    """
    # Threads that wait for each other asleep leave their cores to data workers and environments:
    # busy waiting slows a step tenfold. It counts only when set before PyTorch is imported.
    os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
    with print_user_errors():
        if _WITHOUT_PYTORCH.isdisjoint(sys.argv[1:]):
            check_launcher(module)
        first = os.environ.get("LOCAL_RANK", "0") == "0"
        if first and sys.stderr.isatty() and _WITHOUT_PYTORCH.isdisjoint(sys.argv[1:]):
            print("Loading PyTorch and LeRobot …", file=sys.stderr, flush=True)
        import_module(f"{__name__}.{module}").main()


def check_launcher(module: str) -> None:
    """Refuse to start a command in several processes that would each do all of its work.

    Raises:
        UserError: a launcher started this process beside others, and the command does not share its
            work; or a launcher was asked for several processes and started one.
    """
    if module in SHARED | READING:
        return
    started = started_processes()
    sharing = ", ".join(name for name, (other, _) in COMMANDS.items() if other in SHARED)
    require(
        started == 1,
        f"{started} processes were started (WORLD_SIZE), and each would do all of this command's"
        f" work: start it without a launcher. Commands that share their work: {sharing}.",
    )
