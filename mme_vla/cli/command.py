"""Run a function as a command with a Hydra configuration."""

import functools
import logging
import os
import sys
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path

import hydra
from hydra._internal.utils import get_args_parser
from hydra.core.hydra_config import HydraConfig
from hydra.core.override_parser.types import Override, ValueType
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf

from mme_vla.cli.errors import print_user_errors
from mme_vla.cli.help import help_page
from mme_vla.config import plugins
from mme_vla.config.composition import (
    VERSION_BASE,
    command_trees,
    compose,
    join_plugins,
    local_hydra,
    parse,
)
from mme_vla.config.naming import join_memories, several_memories
from mme_vla.config.override_errors import paths, unknown_option
from mme_vla.config.trees import config_dir, library_trees
from mme_vla.errors import UserError, printable, require


def run_configured(
    config_name: str, main: Callable[[DictConfig], object], directory: Path | None = None
) -> None:
    """Run a command under Hydra: run folder, `--multirun`, `--help`, `--cfg job`, `--config-dir`.

    The command line is checked before `main` is called. `print_user_errors` surrounds both:
    exceptions that are bugs keep their traceback.

    Args:
        config_name: a YAML of the tree's top level, without its suffix.
        main: takes the composed configuration.
        directory: the tree; the library's own by default.
    """
    tree = directory or config_dir()
    sys.argv[1:] = options_first(several_memories(plugins.trust_as_override(sys.argv[1:])))

    @functools.wraps(main)  # Hydra names the job after the module
    def job(cfg: DictConfig) -> object:
        with print_user_errors():
            # here too: Hydra would print a traceback before it gets further
            if missing := sorted(OmegaConf.missing_keys(cfg)):
                words = " ".join(f"{key}=…" for key in missing)
                raise UserError(f"A value is needed for {', '.join(missing)}: add {words}")
            join_memories(cfg)
            hydra_cfg = HydraConfig.get()
            name = str(hydra_cfg.job.config_name)
            join_plugins(cfg, name, command_trees(), hydra_cfg.overrides.task)
            plugins.import_plugins(plugins.plugins_of(cfg, "the configuration"))
            return main(cfg)

    with print_user_errors():
        _check_command_line(config_name, tree)
        start = hydra.main(
            version_base=VERSION_BASE, config_path=str(tree.resolve()), config_name=config_name
        )
        # Hydra makes the run folder: what the disk says to that is to come here, not to be printed
        # there.
        os.environ.setdefault("HYDRA_FULL_ERROR", "1")
        try:
            start(job)()
        except HydraException as error:
            raise UserError(str(error)) from error


def options_first(words: Sequence[str]) -> list[str]:
    """Move the options of a command line before its overrides: Hydra's parser takes no other order.

    A command line with an unknown option stays as it is.
    """
    args, unknown = get_args_parser().parse_known_intermixed_args(words)
    if unknown:
        return list(words)
    options = list(words)
    options.reverse()
    for override in reversed(args.overrides):
        options.remove(override)  # its last occurrence: the value of an option may be the same word
    return [*reversed(options), *args.overrides]


def _check_command_line(config_name: str, tree: Path) -> None:
    args, unknown = get_args_parser().parse_known_intermixed_args()
    if unknown:
        with local_hydra(tree, []):
            known = list(paths(OmegaConf.to_container(hydra.compose(config_name))))
        raise unknown_option(unknown[0], sys.argv[1:], known)
    modes = []
    for mode in ("run", "multirun", "cfg", "info", "shell_completion"):
        if getattr(args, mode):
            modes.append(f"--{mode}".replace("_", "-"))
    require(len(modes) < 2, f"Use one of {' and '.join(modes)}, not both.")
    extra = [Path(args.config_dir).resolve()] if args.config_dir else []
    if args.help:
        # As Hydra searches them: the extras' trees come before the user's.
        trees = [tree.resolve()]
        if tree == config_dir():
            trees = list(library_trees())
        print(help_page(args.config_name or config_name, args.overrides, [*trees, *extra]))
        raise SystemExit(0)
    if args.hydra_help or args.shell_completion or args.experimental_rerun or args.config_path:
        return  # nothing of this tree is composed
    check_overrides(
        args.config_name or config_name, args.overrides, directory=tree, extra_dirs=extra
    )


def check_overrides(
    config_name: str,
    overrides: Sequence[str],
    *,
    directory: Path | None = None,
    extra_dirs: Sequence[Path] = (),
) -> None:
    """Compose once to see that the overrides fit, every choice of a sweep
    (`model=a,b`) included.
    """
    columns = [_choices(override) for override in parse(overrides)]
    columns = [column for column in columns if column]
    n_rows = max((len(column) for column in columns), default=1)
    for row in range(n_rows):
        # A column shorter than the longest stays at its first choice: every choice is seen once,
        # not their product.
        words = [column[row] if row < len(column) else column[0] for column in columns]
        compose(config_name, words, directory=directory, extra_dirs=extra_dirs)


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
