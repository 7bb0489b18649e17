"""The cells of examples/evaluate.ipynb run, in order, with a few steps."""

import json
from pathlib import Path
from typing import Any

import pytest
from conftest import REPOSITORY

pytest.importorskip("mani_skill", reason="the simulator is not installed: the extra `sim` has it")
NOTEBOOK = REPOSITORY / "examples" / "evaluate.ipynb"
SETTINGS = {"OUTPUT =": 'OUTPUT = "records"', "EPISODES =": "EPISODES = [0]", "MAX_STEPS =": "MAX_STEPS = 3"}


def test_the_cells_of_the_notebook_run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    cells = [cell for cell in json.loads(NOTEBOOK.read_text())["cells"] if cell["cell_type"] == "code"]
    assert all(cell["outputs"] == [] for cell in cells), "clear the outputs before it is stored"
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    space: dict[str, Any] = {}
    for number, cell in enumerate(cells):
        lines = "".join(cell["source"]).splitlines()
        lines = [next((new for start, new in SETTINGS.items() if line.startswith(start)), line) for line in lines]
        exec(compile("\n".join(lines), f"{NOTEBOOK.name}, cell {number}", "exec"), space)
    assert [(record.task, record.episode) for record in space["run"].records] == [("StopCube", 0)]
    assert [list(frames) for frames in space["remembered"]] == [[0], [0, 1], [0, 1, 2]]
    assert list((tmp_path / "records").iterdir())
