"""Run the fast tests with the oldest and the newest versions that pyproject.toml allows, and write
docs/reference/compatibility.md.

    python scripts/compatibility.py                    # every environment
    python scripts/compatibility.py oldest newest      # some of them
    python scripts/compatibility.py --page             # the page alone, from the recorded rows

Each environment is made anew in `outputs/compatibility/NAME` (about 8 GB). Its row in
`benchmarks/results/compatibility.csv` is replaced when its tests have ended.
`--python 3.13=/path/to/python3.13` names an interpreter that uv does not find.
"""

import argparse
import csv
import json
import subprocess
import sys
import tomllib
import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
TARGET = ROOT / "outputs" / "compatibility"
ROWS = ROOT / "benchmarks" / "results" / "compatibility.csv"
PAGE = ROOT / "docs" / "reference" / "compatibility.md"


@dataclass(frozen=True)
class Environment:
    """Versions to test: a Python, and how the versions of the packages are chosen."""

    python: str
    options: tuple[str, ...]
    meaning: str


ENVIRONMENTS = {
    "pinned": Environment("3.12", ("-c", "constraints.txt"), "the versions of `constraints.txt`"),
    "oldest": Environment(
        "3.12", ("--resolution", "lowest-direct"), "the lower bounds in `pyproject.toml`"
    ),
    "newest": Environment("3.13", (), "the newest that these bounds allow"),
}
PACKAGES = {
    "torch": "torch",
    "lerobot": "LeRobot",
    "transformers": "transformers",
    "mani-skill": "ManiSkill",
    "gymnasium": "Gymnasium",
    "numpy": "NumPy",
    "timm": "timm",
}
"""Packages of the table, and their names in it."""
COLUMNS = ["environment", "python", *PACKAGES, "passed", "skipped", "failed"]


def main() -> int:
    """Test the environments that were asked for, write the page, and return how many failed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", help=f"of {', '.join(ENVIRONMENTS)}; default: all")
    parser.add_argument("--page", action="store_true", help="write the page, and test nothing")
    parser.add_argument(
        "--python", action="append", default=[], metavar="VERSION=PATH", help="where a Python is"
    )
    args = parser.parse_args()
    unknown = set(args.names) - ENVIRONMENTS.keys()
    if unknown:
        parser.error(f"unknown: {', '.join(sorted(unknown))}; known: {', '.join(ENVIRONMENTS)}")
    paths = dict(text.split("=", 1) for text in args.python)
    failures = 0
    if not args.page:
        for name in args.names or ENVIRONMENTS:
            row = check(name, paths)
            record(row)
            failures += int(row["failed"])
    PAGE.write_text(page(recorded()), encoding="utf-8")
    return failures


def check(name: str, paths: dict[str, str]) -> dict[str, str]:
    """Make an environment, run the fast tests in it, and return its row."""
    environment = ENVIRONMENTS[name]
    folder = TARGET / name
    python = folder / "bin" / "python"
    interpreter = paths.get(environment.python, environment.python)
    overrides = TARGET / "overrides.txt"
    TARGET.mkdir(parents=True, exist_ok=True)
    overrides.write_text("\n".join(kept_overrides()) + "\n", encoding="utf-8")

    # `--no-config` leaves out the pins of pyproject.toml.
    run("uv", "venv", "--clear", "--python", interpreter, folder)
    run(
        *("uv", "pip", "install", "--no-config", "--python", python, "--override", overrides),
        *environment.options,
        *("-e", ".", "--group", "dev"),
    )
    report = folder / "tests.xml"
    tests = ("-m", "pytest", "-n", "auto", "--dist", "loadfile", f"--junitxml={report}")
    subprocess.run([python, *tests], cwd=ROOT, check=False)

    row = {"environment": name, **versions(python), **outcome(report)}
    print(" ".join(f"{key}={value}" for key, value in row.items()), flush=True)
    return row


def kept_overrides() -> list[str]:
    """The overrides that leave a package out. The others are pins."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    return [line for line in settings["tool"]["uv"]["override-dependencies"] if ";" in line]


def versions(python: Path) -> dict[str, str]:
    """The versions of Python and of the packages of the table in an environment."""
    listed = run("uv", "pip", "list", "--no-config", "--python", python, "--format", "json")
    installed = {package["name"]: package["version"] for package in json.loads(listed)}
    version = run(python, "-c", "import platform; print(platform.python_version())").strip()
    return {"python": version, **{package: installed[package] for package in PACKAGES}}


def outcome(report: Path) -> dict[str, str]:
    """How many tests of a JUnit file passed, were skipped and failed."""
    suite = ET.parse(report).getroot().find("testsuite")
    if suite is None:
        sys.exit(f"{report} has no results.")
    total = int(suite.attrib["tests"])
    skipped = int(suite.attrib["skipped"])
    failed = int(suite.attrib["failures"]) + int(suite.attrib["errors"])
    passed = total - skipped - failed
    return {"passed": str(passed), "skipped": str(skipped), "failed": str(failed)}


def run(*command: str | Path) -> str:
    """Run a command from the root of the repository, and return what it prints."""
    done = subprocess.run(command, cwd=ROOT, check=True, stdout=subprocess.PIPE, text=True)
    return done.stdout


def recorded() -> dict[str, dict[str, str]]:
    """The recorded rows by environment."""
    if not ROWS.exists():
        return {}
    with ROWS.open(encoding="utf-8", newline="") as file:
        return {row["environment"]: row for row in csv.DictReader(file)}


def record(row: dict[str, str]) -> None:
    """Replace the row of an environment."""
    rows = recorded() | {row["environment"]: row}
    with ROWS.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        for name in ENVIRONMENTS:
            if name in rows:
                writer.writerow(rows[name])


def page(rows: dict[str, dict[str, str]]) -> str:
    """The page: one column an environment that was tested."""
    tested = [name for name in ENVIRONMENTS if name in rows]
    lines = [
        "# Compatibility",
        "",
        "Which versions pass the fast tests. `python scripts/compatibility.py` makes each"
        " environment anew, runs the tests in it, and writes this page.",
        "",
        "| | " + " | ".join(tested) + " |",
        "|---|" + "---|" * len(tested),
    ]
    titles = {"python": "Python", **PACKAGES}
    titles |= {"passed": "tests passed", "skipped": "skipped", "failed": "failed"}
    for column, title in titles.items():
        lines.append(f"| {title} | " + " | ".join(rows[name][column] for name in tested) + " |")
    lines.append("")
    for name in tested:
        lines.append(f"- **{name}**: {ENVIRONMENTS[name].meaning}.")
    lines += [
        "",
        "Requirements: Linux, Python 3.12 or newer. LeRobot 0.6 sets the upper bounds of torch,"
        " transformers, NumPy and pandas. ManiSkill requires `mplib`, which has no wheel for"
        " Python 3.13. Nothing here imports it: uv leaves it out there, and with pip the extra"
        " `sim` installs on Python 3.12 alone.",
    ]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    sys.exit(main())
