"""`python -m mme_vla.nano`: from nothing to rows of results, for all sixteen tasks or for one, on
two cores.
"""

import logging
import re
import sys
from collections.abc import Sequence

from omegaconf import DictConfig

from mme_vla.cli.command import log_to_terminal, run_configured
from mme_vla.config.composition import command_trees, compose, resolved
from mme_vla.config.trees import library_files, library_trees, yaml_files

ALL_TASKS = "nano16"
"""The file of configs/nano for a command that names no task."""
KEYS = {"model": "with_memory", "backbone": "with_backbone", "embodiment": "with_embodiment"}
"""Words that would choose a file for the whole tree, and the keys of `configs/nano.yaml`
that they set here.
"""


def main() -> None:
    """Run the command with the task's own settings, where it has a file of them."""
    if sys.argv[1:2] == ["board"]:  # a command of its own, which runs this one to add a row
        from mme_vla.extras.nano.cli import board

        return board.main(sys.argv[2:], main, with_settings)
    # Beside --help words name files to show, and choose none.
    if not {"--help", "-h"} & {*sys.argv}:
        sys.argv[1:] = with_settings(sys.argv[1:])
    run_configured("nano", command)


def with_settings(words: Sequence[str]) -> list[str]:
    """The words of a command line, and the choice of the task's file in configs/nano; what is typed
    counts more.

    A command that names no task is for all sixteen: `nano=nano16`. `nano=null` does without a file.
    `model=…` would be a choice for a tree that holds one model; here it names the first of several,
    and leaves out the further models of the task's file. `backbone=…` and `embodiment=…` are those
    of all models. `model=a,b` and `budget=4,16` are lists of one run, which shares demonstrations
    and has one table. Other lists of values are sweeps of `--multirun`.
    """
    named = any(word.startswith("model=") for word in words)
    if named and not any(word.startswith("also=") for word in words):
        words = [*words, "also=[]"]
    renamed = []
    for word in words:
        key, equals, value = word.partition("=")
        renamed.append(f"{KEYS.get(key, key)}{equals}{value}")
    words = _as_lists(renamed)
    if "nano=null" in words:  # without the task's file; Hydra takes no null for a group
        return [word for word in words if word != "nano=null"]
    if any(word.startswith("nano=") for word in words):
        return words
    tasks = [word.removeprefix("task=") for word in words if word.startswith("task=")]
    name = tasks[-1] if tasks else ALL_TASKS
    if name in library_files("nano"):
        words = [f"nano={name}", *words]
    return words


def _as_lists(words: Sequence[str]) -> list[str]:
    """The words with `with_memory=a,b` and `budget=4,16` as lists, without `--multirun` where
    nothing else is swept.
    """
    lists = []
    is_sweep = False
    for word in words:
        key, _, value = word.partition("=")
        outside_brackets = re.sub(r"[\[{(].*[\]})]", "", value)
        if key in ("with_memory", "budget") and "," in value and not value.startswith("["):
            word = f"{key}=[{value}]"
        elif "," in outside_brackets:
            is_sweep = True
        lists.append(word)
    if is_sweep or lists == list(words):
        return lists
    return [word for word in lists if word not in ("--multirun", "-m")]


def command(cfg: DictConfig) -> None:
    """Record, train, evaluate and write the page; what exists is skipped."""
    from mme_vla.extras.nano.settings import NanoRun

    nano = NanoRun.from_config(resolved(cfg))
    trees = command_trees()[1:]
    for model in nano.models:
        if model not in yaml_files([*library_trees(), *trees], "model"):
            compose("policy", [f"model={model}"], extra_dirs=trees)  # says what is near
    log_to_terminal(logging.getLogger("mme_vla.nano"))
    from mme_vla.envs.episodes import choose_tasks
    from mme_vla.envs.make import check_names, require_simulator
    from mme_vla.extras.nano.runs import run

    for task in choose_tasks(nano.task):
        check_names(task, "waypoint", None, None)
    require_simulator()
    run(nano, trees)
