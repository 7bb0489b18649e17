"""The folders of YAML files: the library's own, those of extras and of installed packages."""

from collections.abc import Iterable
from pathlib import Path

from mme_vla.errors import require
from mme_vla.registry import extras, installed_extensions


def config_dir() -> Path:
    """Return the folder of the YAML tree: inside the package when a wheel is installed, else the
    repository's.
    """
    package = Path(__file__).resolve().parents[1]
    shipped = package / "configs"
    return shipped if shipped.is_dir() else package.parent / "configs"


def library_trees() -> tuple[Path, ...]:
    """Return the folders in the order of search: the core's, those of extras, then those of
    installed packages.

    Raises:
        UserError: the folder of a package does not exist, or a file in it has the name of another.
    """
    owners = {config_dir(): "the library"}
    for extension in extras():
        if extension.configs is not None:
            owners[extension.configs] = extension.owner
    for extension in installed_extensions():
        tree = extension.configs
        if tree is None or tree in owners:
            continue
        require(
            tree.is_dir(), f"{extension.owner} has no folder {tree}: install it with its files."
        )
        for file in sorted(tree.rglob("*.yaml")):
            for folder, owner in owners.items():
                name = file.relative_to(tree)
                require(
                    not (folder / name).exists(),
                    f"Two packages define the configuration {str(name)!r}: {owner}"
                    f" ({folder / name}), and {extension.owner} ({file}). Rename the file in one"
                    " of them, or uninstall one.",
                )
        owners[tree] = extension.owner
    return tuple(owners)


def yaml_files(trees: Iterable[Path], group: str) -> dict[str, Path]:
    """Name → file of a group (of the top level where it is empty), sorted by name.

    trees: in the order of search. Of files with one name the first counts, as in Hydra.
    """
    files: dict[str, Path] = {}
    for tree in trees:
        for file in (tree / group).glob("*.yaml"):
            files.setdefault(file.stem, file)
    return dict(sorted(files.items()))


def library_files(group: str) -> dict[str, Path]:
    """Name → file of a group in all `library_trees`."""
    return yaml_files(library_trees(), group)
