"""The README's *Try it* with `env=mikasa`, in fresh processes."""

from pathlib import Path

import numpy as np
import pytest

from helpers.tried_env import SMALL, TRAINED, run, served_chunk, try_commands
from mme_vla.cli.results import main as results
from mme_vla.extras.probing.twins import read_twins

VARIABLES = {"OMP_NUM_THREADS": "1"}
ENV = ("env=mikasa",)
TASK = "tasks=[RememberColor3]"


@pytest.mark.nightly
@pytest.mark.usefixtures("simulator", "renderer")
def test_every_command_that_the_readme_tries_works_with_mikasa(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    records = try_commands(tmp_path, VARIABLES, ENV, TASK, "player=oracle")
    assert [(r.task, r.seed, r.env) for r in records] == [
        ("RememberColor3", 4_242_424_242, "mikasa"), ("RememberColor3", 4_242_424_243, "mikasa"),
    ]  # fmt: skip
    results([str(tmp_path / "evaluated")])
    assert "of 2 episodes of RememberColor3" in capsys.readouterr().out

    words = (*ENV, TASK, TRAINED, "episodes=1", "workers=1", "execute=8", "output=twins")
    run(tmp_path, VARIABLES, "probe", "twins", *words)
    (line,) = read_twins(tmp_path / "twins")
    assert line.candidates == 3 and line.left_out == ""


@pytest.mark.usefixtures("simulator", "renderer")
def test_a_policy_of_mikasas_robot_is_served(tmp_path: Path) -> None:
    pytest.importorskip(
        "websockets", reason="the server's packages are not installed: the extra `serve` has them"
    )
    words = (*ENV, "model=framesamp_modul", *SMALL)
    chunk = served_chunk(tmp_path, VARIABLES, words, "mikasa", "RememberColor3")
    assert chunk.shape == (8, 7) and np.isfinite(chunk).all()
