"""Concepts, comparisons and FAQ of the documentation: their Python runs, their messages and figures
are real.
"""

import ast
import csv
import re
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

from helpers import REPOSITORY

DOCS = REPOSITORY / "docs"
BLOCKS = re.compile(r"```python\n(.*?)```", re.DOTALL)
PRINTED = re.compile(r"^ *print\(.*\)  # (.+)$", re.MULTILINE)
GUIDES = [
    page for page in sorted((DOCS / "concepts").glob("*.md")) if PRINTED.search(page.read_text())
]


@pytest.mark.parametrize("page", GUIDES, ids=lambda page: page.stem)
def test_the_python_of_a_page_prints_what_it_says(
    page: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    space: dict = {}
    for block in BLOCKS.findall(page.read_text()):
        capsys.readouterr()
        exec(compile(block, str(page), "exec"), space)
        lines = capsys.readouterr().out.splitlines()
        for line, comment in zip(lines, PRINTED.findall(block), strict=True):
            assert comment.startswith(line) or line.startswith(comment.rstrip("…")), line


@cache
def messages() -> str:
    """All text of the library, what f-strings insert as `…`, white space as one space."""
    parts = []
    for path in sorted((REPOSITORY / "mme_vla").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.JoinedStr):
                parts.append(
                    "".join(v.value if isinstance(v, ast.Constant) else "…" for v in node.values)
                )
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                parts.append(node.value)
    return re.sub(r"\s+", " ", "\n".join(parts))


def quoted() -> list[str]:
    text = (DOCS / "start" / "troubleshooting.md").read_text()
    rows = [line for line in text.splitlines() if line.startswith("| `")]
    return [row.split("`")[1] for row in rows]


OF_OTHERS = {"Could not load libtorchcodec", "CUDA out of memory", "keepalive ping timeout"}
"""Messages of the page that PyTorch, torchcodec and websockets print."""


@pytest.mark.slow
@pytest.mark.parametrize("message", sorted(set(quoted()) - OF_OTHERS))
def test_a_message_of_the_troubleshooting_page_is_one_of_the_library(message: str) -> None:
    fragments = [part.strip() for part in message.split("…") if part.strip()]
    assert fragments
    for fragment in fragments:
        assert fragment in messages(), fragment


def test_the_troubleshooting_page_has_enough_messages() -> None:
    assert len(quoted()) == len(set(quoted())) >= 25
    assert set(quoted()) >= OF_OTHERS


def test_every_task_has_a_video_in_the_gallery() -> None:
    from mme_vla.envs.metadata import TASK_NAMES

    page = (DOCS / "benchmark" / "gallery.md").read_text()
    assert set(re.findall(r"\(gallery/(\w+)\.webp\)", page)) == set(TASK_NAMES)
    assert {path.stem for path in (DOCS / "benchmark" / "gallery").glob("*.webp")} == set(
        TASK_NAMES
    )


def test_published_numbers_of_the_comparison_are_the_papers() -> None:
    with (REPOSITORY / "mme_vla" / "assets" / "paper" / "suites.csv").open() as file:
        averages = {row["method"]: row["average"] for row in csv.DictReader(file)}
    page = (DOCS / "compare" / "memories.md").read_text()
    for memory, method in {
        "framesamp": "FrameSamp",
        "tokendrop": "TokenDrop",
        "ttt": "TTT",
        "rmt": "RMT",
    }.items():
        row = next(line for line in page.splitlines() if line.startswith(f"| `{memory}`"))
        published = ", ".join(averages[f"{method}+{way}"] for way in ("Modul", "Context", "Expert"))
        assert row.split("|")[-2].strip() == published


@pytest.mark.nightly
def test_the_figures_come_from_the_sample(tmp_path: Path) -> None:
    command = [
        sys.executable,
        str(REPOSITORY / "scripts" / "figures.py"),
        "--output",
        str(tmp_path),
    ]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert {path.stem for path in tmp_path.glob("*.svg")} == {
        "memory",
        "history",
        "budget",
        "integration",
    }
