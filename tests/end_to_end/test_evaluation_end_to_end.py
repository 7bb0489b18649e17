"""From training to results with the commands a user types, in the real simulator; needs the extra `sim` and Vulkan."""

from pathlib import Path

import pytest

from helpers import commands

pytest.importorskip("mani_skill", reason="needs the simulator: uv sync --inexact --extra sim")

from mme_vla.envs.rendering import render_backend
from mme_vla.errors import UserError
from mme_vla.evaluation.store import read_records

EPISODES = ["tasks=[PickXtimes,StopCube]", "episodes=2", "max_steps=18", "max_batch=1", "flow_steps=3"]
ONE = "workers=1"


def call(module: str, *words: str) -> str:
    done = commands.run(f"mme_vla.{module}", *words)
    assert done.returncode == 0, done.stderr
    return done.stdout + done.stderr


@pytest.mark.slow
def test_a_trained_policy_is_evaluated_in_two_parts_with_the_same_results(tmp_path: Path) -> None:
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

    call("evaluate", f"checkpoint={trained}", *EPISODES, "episodes=1", ONE, f"output={tmp_path / 'part'}")
    output = call("evaluate", f"checkpoint={trained}", *EPISODES, ONE, f"output={tmp_path / 'part'}")
    assert "holds 2 of 4 episodes: continuing" in output
    assert {r.key: (r.outcome, r.steps, r.extra["actions_sha256"]) for r in records(tmp_path / "part")} == straight

    table = call("results", str(tmp_path / "part"), "--tasks", "PickXtimes", "StopCube", "--episodes", "2")
    assert "framesamp_modul" in table and "18" in table


def records(folder: Path) -> list:
    return read_records(folder / "episodes.jsonl")
