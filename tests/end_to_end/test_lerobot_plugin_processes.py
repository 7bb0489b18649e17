"""Several processes that train behind LeRobot's interface build a vision cache once, and read the
same.
"""

import json
import socket
from pathlib import Path

import pytest

from helpers import commands

pytest.importorskip("lerobot", reason="LeRobot is not installed")
pytest.importorskip("gymnasium", reason="LeRobot's environments: uv sync --inexact --extra sim")


@pytest.mark.nightly
def test_the_first_process_builds_the_cache_and_the_others_open_it(tmp_path: Path) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        rendezvous = {
            "MASTER_ADDR": "127.0.0.1",
            "MASTER_PORT": str(free.getsockname()[1]),
            "WORLD_SIZE": "2",
        }
    words = ["helpers.lerobot_two_processes", str(tmp_path)]
    started = [
        commands.start(*words, env={**rendezvous, "RANK": str(rank), "LOCAL_RANK": str(rank)})
        for rank in range(2)
    ]
    ended = [commands.finish(process) for process in started]
    assert [end.returncode for end in ended] == [0, 0], ended[0].stderr + ended[1].stderr
    first, second = (json.loads((tmp_path / f"{rank}.json").read_text()) for rank in range(2))
    assert (first["built"], second["built"]) == (1, 0)
    assert first["sum"] == second["sum"] != 0
