"""docs/start/first-hour.md: its notebooks and its shortest path run, and it shows the files that
run.
"""

import json
import os
import re
import subprocess
import sys
from pathlib import Path
from shutil import copytree, ignore_patterns
from typing import Any

import pytest

from helpers import REPOSITORY
from mme_vla.evaluation.store import find_records, read_folders

EXAMPLE = REPOSITORY / "examples" / "first_hour"
PAGE = REPOSITORY / "docs" / "start" / "first-hour.md"
SMALL_POLICY = (
    "train.steps=2 train.val_samples=2 train.open_loop_chunks=1 backbone.depth=1"
    " backbone.vision.depth=1"
)
SETTINGS = {
    "01_train.ipynb": {"OPTIONS": f'"{SMALL_POLICY}"'},
    "02_closed_loop.ipynb": {"EPISODES": "[0]", "MAX_STEPS": "3"},
    "03_own_memory.ipynb": {
        "DEMONSTRATIONS": "2",
        "UPDATES": "1",
        "EPISODES": "1",
        "MORE": '"videos=false train.batch_size=2 train.val_samples=2"',
    },
    "04_probe.ipynb": {
        "POLICY": '"nano"',
        "EPISODES": '"[4]"',
        "ARMS": '["drop:all"]',
        "DRAWS, DECISIONS": "2, 1",
    },
}
"""Notebook → values of its first cell that shorten the run."""


def code_cells(name: str) -> list[dict[str, Any]]:
    cells = json.loads((EXAMPLE / name).read_text())["cells"]
    return [cell for cell in cells if cell["cell_type"] == "code"]


def source_of(cell: dict[str, Any], settings: dict[str, str]) -> str:
    """The code of a cell with other settings, its shell commands as calls."""
    lines = "".join(cell["source"]).splitlines()
    for number, line in enumerate(lines):
        name, equals, _ = line.partition(" = ")
        if equals and name in settings:
            lines[number] = f"{name} = {settings[name]}"
        elif line.lstrip().startswith("!"):
            indent, command = line.split("!", 1)
            lines[number] = f"{indent}shell(f'''{command}''')"
    return "\n".join(lines)


def shell(command: str) -> None:
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    words = ["bash", "-o", "pipefail", "-c", command]
    done = subprocess.run(words, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout


@pytest.mark.nightly
@pytest.mark.parametrize("name", SETTINGS)
def test_the_cells_of_a_notebook_run(
    name: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    if name != "01_train.ipynb":
        request.getfixturevalue("renderer")
    copytree(EXAMPLE, tmp_path / "folder", ignore=ignore_patterns("outputs"))
    monkeypatch.chdir(tmp_path / "folder")
    monkeypatch.setenv("MPLBACKEND", "agg")
    monkeypatch.syspath_prepend(tmp_path / "folder")
    space: dict[str, Any] = {"shell": shell}
    for number, cell in enumerate(code_cells(name)):
        exec(compile(source_of(cell, SETTINGS[name]), f"{name}, cell {number}", "exec"), space)
    assert any(Path("outputs").rglob("*.json*"))


@pytest.mark.parametrize("name", SETTINGS)
def test_a_notebook_keeps_the_outputs_of_a_full_run(name: str) -> None:
    cells = code_cells(name)
    assert [cell["execution_count"] for cell in cells] == list(range(1, len(cells) + 1))
    outputs = json.dumps([cell["outputs"] for cell in cells])
    assert "Traceback" not in outputs
    assert "image/png" in outputs or "text/html" in outputs or "text/markdown" in outputs
    assert (EXAMPLE / name).stat().st_size < 1_000_000


def test_the_page_shows_the_files_of_the_example() -> None:
    page = PAGE.read_text()
    for file in ("video_frames.py", "configs/model/video_frames_modul.yaml"):
        assert (EXAMPLE / file).read_text().strip() in page, file


def shortest_path() -> list[str]:
    """The commands of the page's last section that follow the installation."""
    section = PAGE.read_text().partition("## The shortest path")[2]
    return re.findall(r"```bash\n(.*?)```", section, re.DOTALL)[1].strip().splitlines()


def bounds_of_the_page() -> tuple[float, float]:
    """What the page says of the held-out error with and without memory, in centimetres."""
    row = re.search(r"below ([\d.]+) cm.*above ([\d.]+) cm", PAGE.read_text())
    assert row is not None
    return float(row[1]), float(row[2])


def centimetres(line: str) -> float:
    match = re.search(r"off by ([\d.]+) cm", line)
    assert match is not None, line
    return float(match[1])


@pytest.mark.nightly
@pytest.mark.usefixtures("renderer")
def test_the_shortest_path_leads_to_a_memory_in_closed_loop(tmp_path: Path) -> None:
    unneeded = ignore_patterns(".*", "__pycache__", "outputs", "tests", "docs", "*.egg-info")
    clone = copytree(REPOSITORY, tmp_path / "clone", ignore=unneeded)
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    environment = {**os.environ, "PATH": path, "PYTHONPATH": str(clone)}
    script = "\n".join(
        ["set -e", *shortest_path(), "python -c 'import mme_vla; print(mme_vla.__file__)'"]
    )
    done = subprocess.run(
        ["bash", "-c", script], cwd=clone, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    *printed, video_line, without, place = done.stdout.strip().splitlines()
    assert place == f"{clone}/mme_vla/__init__.py"
    assert printed[-1].endswith("outputs/small/page.md"), "the result follows the page at once"
    assert "nanobind" not in done.stderr and "Traceback" not in done.stderr
    below, above = bounds_of_the_page()
    for line, model in ((video_line, "video_frames_modul"), (without, "pi05")):
        assert re.fullmatch(rf"{model}\S*: off by [\d.]+ cm on .*, \d of 4 episodes solved", line)
    assert centimetres(video_line) < below and centimetres(without) > above
    output = clone / "examples" / "first_hour" / "outputs" / "small"
    records = read_folders(find_records([output]))
    assert sorted((record.model.partition("-")[0], record.episode) for record in records) == [
        (model, episode) for model in ("pi05", "video_frames_modul") for episode in range(4)
    ]
    solved = {record.model.partition("-")[0] for record in records if record.success}
    assert "pi05" not in solved, "a policy without memory cannot know the container"
    assert "| video_frames_modul | 4 |" in (output / "page.md").read_text()
