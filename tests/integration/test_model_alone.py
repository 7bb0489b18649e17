"""The model without configuration, data and simulation: the examples of README.md and
docs/start/python.md.
"""

import ast
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest

from helpers import REPOSITORY
from helpers.tiers import slow_or_nightly

THIRD_PARTY = {"torch", "numpy", "einops", "timm"}
MAX_MODULES = 25
REPORT = """
import sys
print(*(name for name in sys.modules if name.split(".")[0] == "mme_vla"))
print(float(loss))
"""


def example(page: str) -> str:
    blocks = (
        part.split("```")[0] for part in (REPOSITORY / page).read_text().split("```python\n")[1:]
    )
    (code,) = (code for code in blocks if "MMEModel(" in code)
    return code


def third_party(module: str) -> set[str]:
    """Packages outside the standard library that a module names at its top level."""
    spec = find_spec(module)
    assert spec is not None and spec.origin is not None
    roots = set()
    for node in ast.parse(Path(spec.origin).read_text()).body:
        if isinstance(node, ast.Import):
            roots |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            roots.add(node.module.split(".")[0])
    return roots - set(sys.stdlib_module_names) - {"mme_vla"}


@pytest.mark.parametrize(
    "page", slow_or_nightly(["README.md", "docs/start/python.md"], lambda page: page == "README.md")
)
def test_example_trains_and_imports_little(page: str) -> None:
    code = example(page) + REPORT
    result = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=REPOSITORY
    )
    assert result.returncode == 0, result.stderr
    modules, loss = result.stdout.splitlines()
    assert float(loss) > 0
    names = modules.split()
    assert len(names) <= MAX_MODULES, names
    assert set().union(*map(third_party, names)) <= THIRD_PARTY


def test_readme_example_is_short() -> None:
    assert len([line for line in example("README.md").splitlines() if line.strip()]) <= 17
