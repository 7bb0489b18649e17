"""Run a function as a command with a Hydra configuration."""

import argparse
import functools
import logging
import os
import pkgutil
import sys
import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import ClassVar, NoReturn

import hydra
from hydra import version
from hydra._internal.utils import _run_hydra, get_args_parser
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.types import Override, ValueType
from hydra.errors import HydraException
from hydra.experimental.callback import Callback
from omegaconf import DictConfig, OmegaConf

from mme_vla.cli.errors import MISTAKE, print_user_errors
from mme_vla.cli.help import help_page
from mme_vla.config import plugins
from mme_vla.config.composition import (
    VERSION_BASE,
    command_trees,
    compose,
    join_plugins,
    local_hydra,
    parse,
    resolved,
)
from mme_vla.config.naming import expand_overrides, name_composition
from mme_vla.config.override_errors import Names, bare_word, paths, unknown_option
from mme_vla.config.plugins import TRUST_FLAG
from mme_vla.config.trees import config_dir, library_trees
from mme_vla.errors import UserError, printable, require
from mme_vla.policy.run_folders import check_output, shipped_checkpoints


def run_configured(
    config_name: str,
    main: Callable[[DictConfig], object],
    directory: Path | None = None,
    check: str = "",
) -> None:
    """Run a command under Hydra: run folder, `--multirun`, `--help`, `--cfg job`, `--config-dir`.

    The command line is checked before `main` is called. `print_user_errors` surrounds both:
    exceptions that are bugs keep their traceback.

    Args:
        config_name: a YAML of the tree's top level, without its suffix.
        main: takes the composed configuration.
        directory: the tree; the library's own by default.
        check: `module:function` that is given the plain configuration before `main` is called.
    """
    tree = directory or config_dir()
    words = expand_overrides(plugins.trust_as_override(sys.argv[1:]))

    @functools.wraps(main)  # Hydra names the job after the module
    def job(cfg: DictConfig) -> object:
        with print_user_errors():
            # here too: Hydra would print a traceback before it gets further
            if missing := sorted(OmegaConf.missing_keys(resolved(cfg))):
                needed = " ".join(f"{key}=…" for key in missing)
                raise UserError(f"A value is needed for {', '.join(missing)}: add {needed}")
            hydra_cfg = HydraConfig.get()
            name_composition(cfg, hydra_cfg.overrides.task)
            name = str(hydra_cfg.job.config_name)
            join_plugins(cfg, name, command_trees(), hydra_cfg.overrides.task)
            # also in the processes of a launcher
            plugins.import_plugins(plugins.plugins_of(cfg, "the configuration"))
            return main(cfg)

    with print_user_errors():
        args = _checked_arguments(words, config_name, tree, check)
        version.setbase(VERSION_BASE)
        # Hydra makes the run folder: what the disk says to that is to come here, not to be printed
        # there.
        os.environ.setdefault("HYDRA_FULL_ERROR", "1")
        try:
            # `hydra.main` would parse the words again, and refuse options behind overrides.
            _run_hydra(args, get_args_parser(), job, str(tree.resolve()), config_name)
        except HydraException as error:
            raise UserError(str(error)) from error
        except SystemExit as ended:
            if ended.code == MISTAKE:
                for folder in NewFolders.made:
                    with suppress(OSError):
                        folder.rmdir()  # it stays if it holds anything
            raise


class NewFolders(Callback):
    """Notes which folders Hydra makes for a run, so that a command that is refused leaves none.

    `hydra.callbacks` of a command's file names it.
    """

    made: ClassVar[list[Path]] = []
    """The run's folder and those above it that were not there, from the inside."""

    def on_run_start(self, config: DictConfig, **_: object) -> None:
        """Called by Hydra before it makes the folder, which the composition may give its name."""
        name_composition(config, config.hydra.overrides.task)
        folder = Path(str(config.hydra.run.dir)).absolute()
        NewFolders.made = [path for path in (folder, *folder.parents) if not path.exists()]


def _checked_arguments(
    words: Sequence[str], config_name: str, tree: Path, check: str
) -> argparse.Namespace:
    """Hydra's options and overrides on a command line, in any order."""

    def refuse(message: str) -> NoReturn:
        """Such as "argument --config-dir/-cd: expected one argument"."""
        raise UserError(f"{message.capitalize()}. --help lists the options.")

    parser = get_args_parser()
    parser.error = refuse  # type: ignore[method-assign]
    parser.allow_abbrev = False  # `--config` is told what it may mean, as any unknown option
    args, unknown = parser.parse_known_intermixed_args(words)
    if unknown:
        raise unknown_option(unknown[0], words, _names(config_name, tree, []))
    require(not args.experimental_rerun, "--experimental-rerun reads pickled runs: there are none.")
    require(
        not args.shell_completion,
        "--shell-completion completes a program of one command: there is none here. --help lists"
        " the words.",
    )
    modes = []
    for mode in ("run", "multirun", "cfg", "info"):
        if getattr(args, mode):
            modes.append(f"--{mode}")
    require(len(modes) < 2, f"Use one of {' and '.join(modes)}, not both.")
    extra = [Path(args.config_dir).resolve()] if args.config_dir else []
    if args.help:
        # As Hydra searches them: the extras' trees come before the user's.
        trees = [tree.resolve()]
        if tree == config_dir():
            trees = list(library_trees())
        print(help_page(args.config_name or config_name, args.overrides, [*trees, *extra]))
        raise SystemExit(0)
    if args.hydra_help or args.config_path:
        return args  # nothing of this tree is composed
    name = args.config_name or config_name
    overrides = parse(
        args.overrides, lambda words, number: bare_word(words, number, _names(name, tree, extra))
    )
    composed = check_overrides(name, args.overrides, directory=tree, extra_dirs=extra)
    names_output = any(override.key_or_group == "output" for override in overrides)
    for cfg in composed:
        # not resolved: Hydra knows what `${hydra:…}` means once the command runs
        output = OmegaConf.to_container(cfg).get("output")  # type: ignore[union-attr]
        if names_output and output is not None:
            check_output(str(output))
        if check and not args.cfg:
            values = resolved(cfg)
            if not OmegaConf.missing_keys(values):
                plugins.import_plugins(plugins.plugins_of(cfg, "the configuration"))
                pkgutil.resolve_name(check)(values)
    return args


def _names(config_name: str, tree: Path, extra_dirs: Sequence[Path]) -> Names:
    """What the words of a command line may name."""
    options = [TRUST_FLAG]
    for action in get_args_parser()._actions:
        options += [option for option in action.option_strings if option.startswith("--")]
    with local_hydra(tree, extra_dirs) as engine:
        loader = engine.config_loader
        keys = list(paths(OmegaConf.to_container(hydra.compose(config_name))))
        groups = {group: loader.get_group_options(group) for group in loader.list_groups("")}
    groups.pop("hydra", None)
    return Names(keys, groups, options, list(shipped_checkpoints()))


def check_overrides(
    config_name: str,
    overrides: Sequence[str],
    *,
    directory: Path | None = None,
    extra_dirs: Sequence[Path] = (),
) -> list[DictConfig]:
    """Compose once to see that the overrides fit, every choice of a sweep
    (`model=a,b`) included. Returns the configurations.
    """
    columns = [column for column in map(_choices, parse(overrides)) if column]
    n_rows = max(map(len, columns), default=1)
    composed = []
    for row in range(n_rows):
        # A column shorter than the longest stays at its first choice: every choice is seen once,
        # not their product.
        words = [column[row] if row < len(column) else column[0] for column in columns]
        composed.append(compose(config_name, words, directory=directory, extra_dirs=extra_dirs))
    return composed


def _choices(override: Override) -> list[str]:
    """The overrides that a sweep means; the override itself when it is none."""
    if not override.is_sweep_override():
        return [str(override.input_line)]
    if not override.is_discrete_sweep() or override.value_type == ValueType.GLOB_CHOICE_SWEEP:
        return []  # an interval has no list of values, a glob names only what exists
    left = str(override.input_line).partition("=")[0]
    return [f"{left}={value}" for value in override.sweep_string_iterator()]


def log_to_terminal(logger: logging.Logger, clock: bool = False) -> None:
    """Write a command's log and warnings to standard error; `clock` puts the time of day before
    each line.
    """
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(
        _Printable("%(asctime)s %(message)s" if clock else "%(message)s", "%H:%M:%S")
    )
    logger.setLevel(logging.INFO)
    logger.handlers = [handler]
    logger.propagate = False
    warnings.showwarning = lambda message, *_, **__: logger.warning("%s", message)


class _Printable(logging.Formatter):
    """Lines as a terminal may have them: they name what untrusted files and clients sent."""

    def format(self, record: logging.LogRecord) -> str:
        return printable(super().format(record))
