"""From a policy to results with the commands a user types, in the real simulator; needs the extra
`sim` and Vulkan.
"""

from pathlib import Path

import pytest

from helpers import commands
from mme_vla.evaluation.store import read_records
from mme_vla.testing.small import small_policy

EPISODES = [
    "tasks=[PickXtimes,StopCube]",
    "episodes=2",
    "max_steps=18",
    "max_batch=1",
    "flow_steps=3",
]
ONE = "workers=1"


def call(module: str, *words: str) -> str:
    done = commands.run(f"mme_vla.{module}", *words)
    assert done.returncode == 0, done.stderr
    return done.stdout + done.stderr


@pytest.mark.nightly
@pytest.mark.usefixtures("renderer")
def test_a_policy_is_evaluated_in_two_parts_with_the_same_results(tmp_path: Path) -> None:
    saved = tmp_path / "policy"
    small_policy("framesamp_modul").save_pretrained(saved)

    output = call(
        "evaluate",
        f"checkpoint={saved}",
        *EPISODES,
        ONE,
        f"output={tmp_path / 'whole'}",
        "video=all",
    )
    folder = tmp_path / "whole"
    assert f"videos: {folder / 'videos'}\nnext: mme-vla results {folder}\n" in output
    straight = {r.key: (r.outcome, r.steps, r.actions_sha256) for r in records(tmp_path / "whole")}
    assert len(straight) == 4 and len({digest for _, _, digest in straight.values()}) == 4
    assert all(outcome in ("timeout", "fail", "success") for outcome, _, _ in straight.values()), (
        straight
    )
    assert len(list((tmp_path / "whole" / "videos").glob("*.mp4"))) == 4

    call(
        "evaluate",
        f"checkpoint={saved}",
        *EPISODES,
        "episodes=1",
        ONE,
        f"output={tmp_path / 'part'}",
    )
    output = call("evaluate", f"checkpoint={saved}", *EPISODES, ONE, f"output={tmp_path / 'part'}")
    assert "holds 2 of 4 episodes: continuing" in output
    assert {
        r.key: (r.outcome, r.steps, r.actions_sha256) for r in records(tmp_path / "part")
    } == straight

    table = call(
        "results", str(tmp_path / "part"), "--tasks", "PickXtimes", "StopCube", "--episodes", "2"
    )
    assert "framesamp_modul" in table and "18" in table


def records(folder: Path) -> list:
    return read_records(folder / "episodes.jsonl")
