"""Which packages and modules are installed, and how to run Python where some cannot be found."""

import os
import tomllib
from collections.abc import Iterable
from functools import cache
from importlib.metadata import distributions, packages_distributions, requires

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from helpers import REPOSITORY

HIDDEN_MODULES = REPOSITORY / "tests" / "data" / "hidden_modules"
LEROBOT_EXTRAS = ("dataset",)  # of which the library itself depends


@cache
def needs() -> dict[str, set[str]]:
    """The packages that each extra names; those of the library itself under an empty name, the
    tools under `dev`.
    """
    pyproject = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())
    project = pyproject["project"]
    lines = {
        "": project["dependencies"],
        **project["optional-dependencies"],
        "dev": pyproject["dependency-groups"]["dev"],
    }
    packages = {
        extra: {canonicalize_name(Requirement(line).name) for line in required}
        for extra, required in lines.items()
    }
    packages["dev"].remove("mme-vla")  # with all extras
    return packages


@cache
def modules() -> dict[str, set[str]]:
    """The modules of each installed package; a namespace that several share belongs to none."""
    owned: dict[str, set[str]] = {}
    for module, owners in packages_distributions().items():
        if len(set(owners)) == 1:
            owned.setdefault(canonicalize_name(owners[0]), set()).add(module)
    return owned


def is_installed(extra: str) -> bool:
    """Whether all packages of an extra are there, those whose modules lie in a folder of their own
    included (Pinocchio's).
    """
    present = {canonicalize_name(each.name) for each in distributions()}
    return needs()[extra] <= present


def with_dependencies(packages: Iterable[str]) -> set[str]:
    """Installed packages, and all that these require."""
    required: set[str] = set()
    left = list(packages)
    while left:
        package = left.pop()
        if package in required or package not in modules():
            continue
        required.add(package)
        for requirement in map(Requirement, requires(package) or []):
            extras = ("", *LEROBOT_EXTRAS) if package == "lerobot" else ("",)
            if requirement.marker is None or any(
                requirement.marker.evaluate({"extra": extra}) for extra in extras
            ):
                left.append(canonicalize_name(requirement.name))
    return required


def modules_beyond(packages: Iterable[str], *, deep: bool = False) -> set[str]:
    """Modules of the packages that the library or an extra names and that `packages` do not
    require; with `deep`, of what those require too.
    """
    present = with_dependencies(packages)
    named = set().union(*needs().values())
    if deep:
        named = with_dependencies(named)
    return set().union(*(modules().get(package, set()) for package in named - present))


def without_modules(hidden: Iterable[str]) -> dict[str, str]:
    """Environment variables of a Python that finds none of these modules."""
    path = os.pathsep.join([str(HIDDEN_MODULES), str(REPOSITORY)])
    return {**os.environ, "PYTHONPATH": path, "HIDDEN_MODULES": " ".join(sorted(hidden))}
