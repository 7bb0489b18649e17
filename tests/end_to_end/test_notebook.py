"""The cells of examples/evaluate.ipynb run, in order, with a few steps; its outputs are those of a full run."""

import json
from pathlib import Path
from typing import Any

import pytest

from helpers import REPOSITORY
from mme_vla.envs.rendering import render_backend
from mme_vla.errors import UserError

pytestmark = pytest.mark.slow

pytest.importorskip("mani_skill", reason="the simulator is not installed: the extra `sim` has it")
NOTEBOOK = REPOSITORY / "examples" / "evaluate.ipynb"
SETTINGS = {"OUTPUT =": 'OUTPUT = "records"', "EPISODES =": "EPISODES = [0]", "MAX_STEPS =": "MAX_STEPS = 3"}


def code_cells() -> list[dict[str, Any]]:
    return [cell for cell in json.loads(NOTEBOOK.read_text())["cells"] if cell["cell_type"] == "code"]


def test_the_notebook_keeps_the_outputs_of_a_run() -> None:
    outputs = [output for cell in code_cells() for output in cell["outputs"]]
    text = "".join(line for output in outputs for line in output.get("text", []))
    assert "success 100 %" in text and "0 % without" in text
    assert sum("image/png" in output.get("data", {}) for output in outputs) == 2
    assert NOTEBOOK.stat().st_size < 1_000_000


def test_the_cells_of_the_notebook_run(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    try:
        render_backend()
    except UserError as error:
        pytest.skip(f"cannot render here: {error}")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MPLBACKEND", "agg")
    space: dict[str, Any] = {}
    for number, cell in enumerate(code_cells()):
        lines = "".join(cell["source"]).splitlines()
        lines = [next((new for start, new in SETTINGS.items() if line.startswith(start)), line) for line in lines]
        exec(compile("\n".join(lines), f"{NOTEBOOK.name}, cell {number}", "exec"), space)
    assert [(record.task, record.episode) for record in space["run"].records] == [("VideoUnmask", 0)]
    assert list(space["remembered"][0]) == [0] and all(len(frames) <= 4 for frames in space["remembered"])
    assert [comparison.episodes for comparison in space["probed"].comparisons] == [1]
