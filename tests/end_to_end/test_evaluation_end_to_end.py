"""From training to results with the commands a user types, in the real simulator; needs the extra `sim` and Vulkan."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from helpers import REPOSITORY, commands

pytest.importorskip("mani_skill", reason="needs the simulator: uv sync --inexact --extra sim")

from mme_vla.envs.rendering import render_backend
from mme_vla.errors import UserError
from mme_vla.evaluation.store import read_records

EPISODES = ["tasks=[PickXtimes,StopCube]", "episodes=2", "max_steps=18", "max_batch=1", "flow_steps=3"]
ONE, TWO = "workers=1", "workers=2"  # each worker computes for seconds before its first image


def command(module: str, *words: str) -> list[str]:
    return [sys.executable, "-W", "ignore", "-m", f"mme_vla.{module}", *words]


def call(module: str, *words: str) -> str:
    done = commands.run(f"mme_vla.{module}", *words)
    assert done.returncode == 0, done.stderr
    return done.stdout + done.stderr


@contextmanager
def started(*words: str) -> Iterator[subprocess.Popen]:
    """A command in a process group of its own, which is gone in the end."""
    process = subprocess.Popen(command(*words), cwd=REPOSITORY, stderr=subprocess.DEVNULL, start_new_session=True)
    try:
        yield process
    finally:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def group_is_empty(group: int) -> bool:
    try:
        os.killpg(group, 0)
    except ProcessLookupError:
        return True
    return False


@pytest.mark.slow
def test_a_trained_policy_is_evaluated_killed_and_resumed_with_the_same_results(tmp_path: Path) -> None:
    try:
        render_backend()
    except UserError as error:
        pytest.skip(str(error))
    trained = tmp_path / "trained"
    steps = ["train.steps=10", "train.warmup=3", "train.open_loop_chunks=0", "train.val_every=10", "train.workers=0"]
    call("train", "model=framesamp_modul", f"output={trained}", *steps)

    output = call("evaluate", f"checkpoint={trained}", *EPISODES, ONE, f"output={tmp_path / 'whole'}", "video=all")
    assert "python -m mme_vla.results" in output
    straight = {r.key: (r.outcome, r.steps, r.extra["actions_sha256"]) for r in records(tmp_path / "whole")}
    assert len(straight) == 4 and len({digest for _, _, digest in straight.values()}) == 4
    assert all(outcome in ("timeout", "fail", "success") for outcome, _, _ in straight.values()), straight
    assert len(list((tmp_path / "whole" / "videos").glob("*.mp4"))) == 4

    words = ("evaluate", f"checkpoint={trained}", *EPISODES, f"output={tmp_path / 'killed'}")
    with started(*words, TWO) as process:
        until = time.monotonic() + 400
        while len(finished := lines(tmp_path / "killed")) < 2:
            assert process.poll() is None and time.monotonic() < until
            time.sleep(0.05)
        process.send_signal(signal.SIGKILL)
        process.wait()
        until = time.monotonic() + 30
        while not group_is_empty(process.pid):
            assert time.monotonic() < until, "workers outlive a run that was killed"
            time.sleep(0.1)
    finished = lines(tmp_path / "killed")
    assert 2 <= len(finished) < 4
    output = call(*words, ONE)
    assert "of 4 episodes: continuing" in output
    assert lines(tmp_path / "killed")[: len(finished)] == finished, "what was finished was run again"
    assert {r.key: (r.outcome, r.steps, r.extra["actions_sha256"]) for r in records(tmp_path / "killed")} == straight

    table = call("results", str(tmp_path / "killed"), "--tasks", "PickXtimes", "StopCube", "--episodes", "2")
    assert "framesamp_modul" in table and "18" in table


def records(folder: Path) -> list:
    return read_records(folder / "episodes.jsonl")


def lines(folder: Path) -> list[bytes]:
    """The whole lines of a file of records that may be being written."""
    path = folder / "episodes.jsonl"
    return path.read_bytes().split(b"\n")[:-1] if path.exists() else []
