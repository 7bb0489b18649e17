"""JSON is read in one place, where every kind of damage has its sentence."""

import ast
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[2] / "mme_vla"


def test_only_utils_parses_json() -> None:
    wrong = []
    for file in PACKAGE.rglob("*.py"):
        if file.parent.name == "utils":
            continue
        for node in ast.walk(ast.parse(file.read_text())):
            parses = isinstance(node, ast.Attribute) and ast.unparse(node) in ("json.load", "json.loads")
            imported = isinstance(node, ast.ImportFrom) and node.module == "json" and "load" in ast.unparse(node)
            if parses or imported:
                wrong.append(f"{file.relative_to(PACKAGE)}:{node.lineno}")
    assert wrong == [], "use mme_vla.utils.read_json, read_lines, parse_json or to_json"
