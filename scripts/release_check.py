"""Check that a release is what its tag says, before it is built: version, change log and address.

    python scripts/release_check.py v0.1.0 ADDRESS

ADDRESS is the address of the repository that runs the release workflow.
"""

import re
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]


def problems(tag: str, repository: str, root: Path = ROOT) -> list[str]:
    """What keeps this tree from being released under a tag."""
    pyproject = tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))
    version = pyproject["project"]["version"]
    address = pyproject["tool"]["hatch"]["metadata"]["hooks"]["custom"]["repository"]
    changes = (root / "CHANGELOG.md").read_text(encoding="utf-8")
    messages = []
    if tag != f"v{version}":
        messages.append(f"The tag is {tag}, and pyproject.toml has the version {version}.")
    if address != repository:
        messages.append(
            f"The address in pyproject.toml is {address}. This repository is {repository}."
        )
    if not re.search(rf"^## {re.escape(version)} \(\d{{4}}-\d\d-\d\d\)$", changes, re.MULTILINE):
        messages.append(f"CHANGELOG.md has no heading `## {version} (year-month-day)`.")
    return messages


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    if messages := problems(*sys.argv[1:]):
        sys.exit("\n".join(messages))
