"""The shell of the project: pins, the two commands, and what must not be in the files."""

import re
import subprocess
import tomllib
from collections.abc import Iterator
from pathlib import Path

import constraints
import pytest
import yaml

REPOSITORY = Path(__file__).resolve().parents[2]


def pyproject() -> dict:
    return tomllib.loads((REPOSITORY / "pyproject.toml").read_text())


def test_pins_for_pip_are_written_from_those_for_uv() -> None:
    text = (REPOSITORY / "pyproject.toml").read_text()
    assert constraints.constraints(text) == (REPOSITORY / "constraints.txt").read_text()
    pins = pyproject()["tool"]["uv"]["constraint-dependencies"]
    assert len({pin.partition("==")[0] for pin in pins}) == len(pins), "a pin stands twice"
    assert all(re.fullmatch(r"[\w.-]+==[\w.]+", pin) for pin in pins), (
        "only name==version: no addresses, no ranges"
    )


def test_the_tools_come_with_every_extra() -> None:
    extras = pyproject()["project"]["optional-dependencies"]
    groups = pyproject()["dependency-groups"]
    requirement = next(line for line in groups["dev"] if line.startswith("mme-vla["))
    listed = set(re.findall(r"[\w-]+", requirement.partition("[")[2]))
    # pip refuses mikasa's wheel, and has to install the group.
    assert listed == extras.keys() - {"mikasa"}


def test_the_version_is_the_same_everywhere() -> None:
    version = pyproject()["project"]["version"]
    citation = yaml.safe_load((REPOSITORY / "CITATION.cff").read_text())
    assert str(citation["version"]) == version
    changes = (REPOSITORY / "CHANGELOG.md").read_text()
    newest = re.search(r"^## (\d[\w.]*)", changes, re.MULTILINE)
    assert newest is not None and newest[1] == version
    for plugin in ("lerobot_policy_mme_vla", "robomme"):
        file = REPOSITORY / "plugins" / plugin / "pyproject.toml"
        assert tomllib.loads(file.read_text())["project"]["version"] == version


def test_the_address_of_the_project_is_in_one_place() -> None:
    address = pyproject()["tool"]["hatch"]["metadata"]["hooks"]["custom"]["repository"]
    owner = address.removeprefix("https://github.com/").partition("/")[0]
    hits = []
    for file in project_files():
        try:
            hits += [file.name] * file.read_text().count(f"github.com/{owner}/")
        except UnicodeDecodeError:
            continue
    assert hits == ["pyproject.toml"]


def test_ci_runs_the_commands_of_the_readme() -> None:
    pattern = r"^((?:pip install uv && .*|)uv run (?:--group dev|python).*)$"
    documented = re.findall(pattern, (REPOSITORY / "README.md").read_text(), re.MULTILINE)
    run_by_ci = re.findall(r"^run '(.*)'$", (REPOSITORY / ".ci" / "run").read_text(), re.MULTILINE)
    assert run_by_ci[:3] == documented
    assert len(documented) == 3 and "-m slow" in documented[2]
    # Style and types, as CONTRIBUTING.md says.
    contributing = (REPOSITORY / "CONTRIBUTING.md").read_text()
    (checks,) = run_by_ci[3:]
    for command in checks.replace(" --group dev", "").split(" && "):
        assert command in contributing


def test_tests_that_the_documentation_names_exist() -> None:
    for page in (REPOSITORY / "docs").rglob("*.md"):
        for name in re.findall(r"tests/[\w/]+\.py", page.read_text()):
            assert (REPOSITORY / name).is_file(), f"{page}: {name}"


def test_links_in_the_documentation_lead_to_files() -> None:
    broken = []
    for page in [*REPOSITORY.glob("*.md"), *(REPOSITORY / "docs").glob("**/*.md")]:
        for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", page.read_text()):
            if "://" not in target and not (page.parent / target).exists():
                broken.append(f"{page.relative_to(REPOSITORY)} → {target}")
    assert broken == []


def test_no_file_names_a_place_on_somebodys_machine() -> None:
    # Bracketed so that the pattern does not find itself.
    places = re.compile(
        r"(?<![\w.~])/(?:wor[k]|roo[t]|hom[e]|User[s]|opt/\w+)/\w|index-ur[l]|find-link[s]|pypi\.or[g]"
    )
    hits = []
    for file in project_files():
        try:
            text = file.read_text()
        except UnicodeDecodeError:
            continue
        hits += [f"{file.relative_to(REPOSITORY)}: {hit[0]}" for hit in places.finditer(text)]
    assert hits == []


def test_every_exported_name_can_be_reached() -> None:
    import mme_vla

    assert set(mme_vla.__all__) <= set(dir(mme_vla))
    assert all(getattr(mme_vla, name) is not None for name in mme_vla.__all__)
    assert mme_vla.__version__ == pyproject()["project"]["version"]
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = mme_vla.nothing


def project_files() -> Iterator[Path]:
    """What git tracks or would track; without git, the package and what stands beside it."""
    listed = subprocess.run(
        ["git", "ls-files", "-co", "--exclude-standard", "-z"],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
    )
    if listed.returncode == 0:
        yield from (
            REPOSITORY / name
            for name in listed.stdout.split("\0")
            if name and (REPOSITORY / name).is_file()
        )
    else:
        for pattern in ("*.*", "mme_vla/**/*.*", "configs/**/*.*", "tests/**/*.*", "docs/**/*.*"):
            yield from (file for file in REPOSITORY.glob(pattern) if file.is_file())
