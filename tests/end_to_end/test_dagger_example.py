"""The DAgger example from another folder, with few scenes: its loss falls, and every command takes
its policy.
"""

import re
from pathlib import Path

import numpy as np
import pytest

from helpers import REPOSITORY, commands
from mme_vla.evaluation.store import find_records, read_folders
from mme_vla.serving.client import Client

EXAMPLES = REPOSITORY / "examples" / "trajectories"
ENVIRONMENT = {"PYTHONPATH": f"{REPOSITORY}:{EXAMPLES}", "OMP_NUM_THREADS": "1"}
OPTIONS = [
    {"label": label, "action": f"press button {label}", "need_parameter": label == "a"}
    for label in "ab"
]
FEW = (
    "import dagger\n\nif __name__ == '__main__':\n    dagger.main(scenes=(8, 2, 2), updates=100)\n"
)


def run(folder: Path, module: str, *words: str) -> str:
    done = commands.run(module, *words, cwd=folder, env=ENVIRONMENT)
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout


@pytest.mark.nightly
@pytest.mark.usefixtures("renderer")
def test_dagger_learns_from_the_oracle_and_its_policy_works_in_every_command(
    tmp_path: Path,
) -> None:
    (tmp_path / "few.py").write_text(FEW)
    printed = run(tmp_path, "few")
    assert (
        re.findall(r"round (\d)", printed) == ["0", "1", "2"] and "round 0: success 1.00" in printed
    )
    first, last = (float(loss) for loss in re.findall(r"loss (\d\.\d+)", printed)[:2])
    assert last < first / 2
    trained = "checkpoint=outputs/dagger"
    run(
        tmp_path,
        "mme_vla.evaluate",
        trained,
        "tasks=VideoUnmask",
        "episodes=1",
        "workers=1",
        "output=evaluated",
    )
    (record,) = read_folders(find_records([tmp_path / "evaluated"]))
    assert record.outcome in ("success", "fail"), record.error
    probe = (
        "offline=false",
        "online=true",
        "tasks=VideoUnmask",
        "episodes=1",
        "with=[shuffle]",
        "workers=1",
    )
    run(tmp_path, "mme_vla.probe", trained, *probe, "output=probed")
    assert list((tmp_path / "probed").rglob("*.json*"))
    served(tmp_path, trained)


def served(folder: Path, checkpoint: str) -> None:
    """A choice from a server in a process of its own."""
    with (
        commands.serving("mme_vla.serve", checkpoint, cwd=folder, env=ENVIRONMENT) as port,
        Client(f"ws://127.0.0.1:{port}") as client,
    ):
        client.reset()
        reply = client.infer(
            {
                "task_goal": ["press the button"],
                "is_first_step": True,
                "available_multi_choices": OPTIONS,
                "front_rgb_list": [np.zeros((256, 256, 3), np.uint8)],
                "joint_state_list": [np.zeros(7)],
                "gripper_state_list": [np.zeros(2)],
            }
        )
    assert reply["choices"][0]["choice"] in ("A", "B")
