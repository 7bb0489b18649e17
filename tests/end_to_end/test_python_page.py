"""The code blocks of docs/start/python.md run, in order, as they stand there."""

import re

import pytest

from helpers import REPOSITORY

LEFT_OUT = "left out by the test"


def test_the_blocks_of_the_page_run(monkeypatch: pytest.MonkeyPatch, tmp_path) -> None:
    blocks = re.findall(
        r"```python\n(.*?)```", (REPOSITORY / "docs" / "start" / "python.md").read_text(), re.DOTALL
    )
    run = [block for block in blocks if LEFT_OUT not in block]
    assert len(blocks) - 1 == len(run) >= 5
    monkeypatch.chdir(tmp_path)
    space: dict = {}
    for block in run:
        exec(compile(block, "docs/start/python.md", "exec"), space)
    assert space["chunk"].shape == (20, 8)
    assert space["loss"].ndim == 0
    assert space["again"].config["name"] == "framesamp_modul"
