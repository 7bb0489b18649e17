"""Write constraints.txt, which pip reads, from the versions in pyproject.toml, which uv reads.

python scripts/constraints.py            # write the file
python scripts/constraints.py --check    # exit with 1 where it is out of date
"""

import argparse
import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
HEAD = """\
# Versions known to work together, for pip: pip install -c constraints.txt -e . --group dev
# The extra mikasa needs uv, or the line in docs/benchmark/mikasa.md.
# Written by `python scripts/constraints.py` from pyproject.toml. torch pins its own CUDA libraries.
"""
LIST = re.compile(r"^constraint-dependencies = \[\n(.*?)^\]$", re.DOTALL | re.MULTILINE)


def constraints(pyproject: str) -> str:
    """The text of constraints.txt: one version a line, with the comments of the list."""
    match = LIST.search(pyproject)
    if match is None:
        raise ValueError("pyproject.toml has no list `constraint-dependencies`.")
    lines = [HEAD]
    for line in match[1].splitlines():
        pins, _, comment = line.strip().partition("#")
        names = re.findall(r'"([^"]+)"', pins)
        if not names:
            lines.append(f"# {comment.strip()}\n")
            continue
        note = f"  # {comment.strip()}" if comment else ""
        lines += [f"{name}{note}\n" for name in names]
    return "".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--check", action="store_true", help="compare, and write nothing")
    args = parser.parse_args()
    target = ROOT / "constraints.txt"
    text = constraints((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    if not args.check:
        target.write_text(text, encoding="utf-8")
    elif target.read_text(encoding="utf-8") != text:
        sys.exit("constraints.txt is out of date. Run: python scripts/constraints.py")


if __name__ == "__main__":
    main()
