"""Composition of the YAML tree, and the decorator that turns a function into a `python -m` command.

Every command and `build_policy` read the same Hydra tree. Mistakes in what the user typed are found here, before any
work starts, and come back as one `UserError` with the near names.
"""

import functools
import importlib
import logging
import os
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import zip_longest
from pathlib import Path

import hydra
from hydra import version
from hydra._internal.hydra import Hydra
from hydra._internal.utils import create_config_search_path, get_args_parser
from hydra.core.config_search_path import SearchPathQuery
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, ValueType
from hydra.core.utils import JobRuntime
from hydra.errors import HydraException, OverrideParseException
from omegaconf import DictConfig, OmegaConf

from mme_vla.config.endings import print_user_errors as print_user_errors
from mme_vla.config.mistakes import COMPOSITION_ERRORS, ConfigTree
from mme_vla.errors import UserError

VERSION_BASE = "1.3"


def config_dir() -> Path:
    """Return the folder of the YAML tree: inside the package when a wheel is installed, else the repository's."""
    package = Path(__file__).resolve().parent
    shipped = package / "configs"
    return shipped if shipped.is_dir() else package.parent / "configs"


def compose(
    config_name: str,
    overrides: Sequence[str] = (),
    *,
    directory: Path | None = None,
    extra_dirs: Sequence[Path] = (),
) -> DictConfig:
    """Compose `config_name` under Hydra's override grammar; also from inside a running Hydra command.

    Args:
        config_name: a YAML of the tree's top level, without its suffix.
        overrides: as on the command line: `["model=framesamp_modul", "train.lr=1e-4"]`.
        directory: the tree; the library's own by default.
        extra_dirs: further trees searched after it, as `--config-dir` adds them.

    Raises:
        UserError: a name or key that does not exist, a value of the wrong kind, or a file that cannot be read.
    """
    directory = (directory or config_dir()).resolve()
    for folder in (directory, *extra_dirs):
        if not folder.is_dir():
            raise UserError(f"The config folder {str(folder)!r} does not exist.")
    with _own_hydra(directory, extra_dirs) as engine:
        tree = ConfigTree(engine.config_loader, config_name, _parse(overrides))
        try:
            cfg = hydra.compose(config_name, list(overrides))
        except COMPOSITION_ERRORS as error:
            raise UserError(tree.explain(error)) from None
        tree.check_kinds()
        return cfg


def check_overrides(
    config_name: str,
    overrides: Sequence[str],
    *,
    directory: Path | None = None,
    extra_dirs: Sequence[Path] = (),
) -> None:
    """Compose once to see that the overrides fit, every choice of a sweep (`model=a,b`) included.

    Raises:
        UserError: as `compose`.
    """
    columns = [_choices(override) for override in _parse(overrides)]
    for row in zip_longest(*columns) if columns else [()]:
        # A column shorter than the longest stays at its first choice: every choice is seen once, not their product.
        chosen = [column[0] if value is None else value for value, column in zip(row, columns, strict=True) if column]
        compose(config_name, chosen, directory=directory, extra_dirs=extra_dirs)


def import_plugins(cfg: DictConfig) -> None:
    """Import the modules named by the key `plugins`, whose decorators register a user's own memories.

    The current directory counts as importable, so that a file beside the command is enough.

    Raises:
        UserError: there is no such module.
    """
    names = cfg.get("plugins") or []
    for name in [names] if isinstance(names, str) else names:
        here = str(Path.cwd())
        if here not in sys.path:
            sys.path.insert(0, here)
        try:
            importlib.import_module(name)
        except ModuleNotFoundError as error:
            if error.name is None or not f"{name}.".startswith(f"{error.name}."):
                raise  # the plugin was found, something it imports was not
            raise UserError(
                f"No module named {name!r} (from `plugins`). Looked in {here} and the installed packages; "
                "give a dotted module name, not a file name."
            ) from error


def cli[T](
    config_name: str, directory: Path | None = None
) -> Callable[[Callable[[DictConfig], T]], Callable[..., T | None]]:
    """Make `main(cfg)` a Hydra command: run folder, `--multirun`, `--help`, `--cfg job`, `--config-dir`.

    Before the command starts the overrides are checked. How it ends when the user, the system or the disk ends it is
    `print_user_errors`' matter; any other exception keeps its traceback. Called with a config, the decorated function
    runs `main` directly.
    """

    def decorate(main: Callable[[DictConfig], T]) -> Callable[..., T | None]:
        @functools.wraps(main)
        def job(cfg: DictConfig) -> T:
            with print_user_errors():  # here too: Hydra would print a traceback before it gets further
                _require_values(cfg)
                import_plugins(cfg)
                return main(cfg)

        @functools.wraps(main)
        def command(cfg: DictConfig | None = None) -> T | None:
            if cfg is not None:
                return main(cfg)
            tree = directory or config_dir()
            with print_user_errors():
                _check_command_line(config_name, tree)
                start = hydra.main(version_base=VERSION_BASE, config_path=str(tree.resolve()), config_name=config_name)
                # Hydra makes the run folder: what the disk says to that is to come here, not to be printed there.
                os.environ.setdefault("HYDRA_FULL_ERROR", "1")
                try:
                    start(job)()
                except HydraException as error:
                    raise UserError(str(error)) from error
            return None

        return command

    return decorate


def _check_command_line(config_name: str, tree: Path) -> None:
    args = get_args_parser().parse_args()
    if args.hydra_help or args.shell_completion or args.experimental_rerun or args.config_path:
        return  # nothing of this tree is composed
    extra = [Path(args.config_dir).resolve()] if args.config_dir else []
    check_overrides(args.config_name or config_name, args.overrides, directory=tree, extra_dirs=extra)


def log_to_terminal(logger: logging.Logger, clock: bool = False) -> None:
    """Let a command's logger, and warnings, speak on standard error; `clock` puts the time of day before each line."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(logging.Formatter("%(asctime)s %(message)s" if clock else "%(message)s", "%H:%M:%S"))
    logger.setLevel(logging.INFO)
    logger.handlers = [handler]
    logger.propagate = False
    warnings.showwarning = lambda message, *_, **__: logger.warning("%s", message)


@contextmanager
def _own_hydra(directory: Path, extra_dirs: Sequence[Path]) -> Iterator[Hydra]:
    """Hydra's compose API with further folders, handing back the Hydra that a surrounding command runs under."""
    base = version.VersionBase.instance()
    outer, outer_base = GlobalHydra.instance().hydra, base.version_base
    GlobalHydra.instance().clear()
    search_path = create_config_search_path(str(directory))
    for folder in extra_dirs:
        search_path.prepend("command-line", f"file://{folder.resolve()}", anchor=SearchPathQuery(provider="schema"))
    try:
        version.setbase(VERSION_BASE)
        name = JobRuntime.instance().get("name")  # a sweep's next job is still to be called by it
        yield Hydra.create_main_hydra2(task_name=name, config_search_path=search_path)
    finally:
        GlobalHydra.instance().hydra = outer
        base.version_base = outer_base


def _parse(overrides: Sequence[str]) -> list[Override]:
    try:
        parsed = OverridesParser.create().parse_overrides(list(overrides))
        for override in parsed:
            if not override.key_or_group:
                raise OverrideParseException(str(override.input_line), "the key is missing")
    except OverrideParseException as error:
        raise UserError(
            f"Cannot read the override {error.override!r}: {error.message.splitlines()[0]}. "
            "Write key=value, +key=value to add a key, ~key to remove one; quote values with special characters."
        ) from error
    return parsed


def _choices(override: Override) -> list[str]:
    """The overrides that a sweep stands for; the override itself when it is none."""
    if not override.is_sweep_override():
        return [str(override.input_line)]
    if not override.is_discrete_sweep() or override.value_type == ValueType.GLOB_CHOICE_SWEEP:
        return []  # an interval has no list of values, a glob names only what exists
    left = str(override.input_line).partition("=")[0]
    return [f"{left}={value}" for value in override.sweep_string_iterator()]


def _require_values(cfg: DictConfig) -> None:
    missing = sorted(OmegaConf.missing_keys(cfg))
    if missing:
        raise UserError(f"A value is needed for {', '.join(missing)}: add {' '.join(f'{key}=…' for key in missing)}")
