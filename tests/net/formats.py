"""A policy in the formats of others, a dataset whose images are videos, and what commands say of
them.

Every function works in the current folder with relative paths, as in `net.runs`.
"""

import shutil
from pathlib import Path

from safetensors.torch import load_file

import mme_vla
from net.archives import command
from net.models import PI05, words
from net.runs import numbers

POLICY = "pi05_past_actions"
"""The saved model that is exported; it is in the archive too."""
FORMATS = ("lerobot", "openpi", "released")


def make() -> None:
    """The exports of the folder `policy`, and two synthetic episodes as a dataset with lossless
    videos, LeRobot's names and keyframes, with a side file of first execution frames.
    """
    from helpers.h5_files import write_file

    for target in FORMATS:
        command("weights", "policy", Path("exports", target), "--to", target)
    Path("h5").mkdir()
    file = Path("h5", "record_dataset_PickXtimes.h5")
    write_file(file, [22, 20], [6, 0], poses=True, depth=True, choices=True)
    command("convert", "input=h5", "output=dataset_video", "names=lerobot", "keyframes=true")
    command("exec-starts", "input=h5", "output=exec_starts.json")
    shutil.rmtree("h5")


def converted_back(target: str) -> list[str]:
    """The tensors that differ after an export was converted back."""
    command(
        "weights", Path("exports", target), "ours", f"model={POLICY}", "backbone=tiny", *words(PI05)
    )
    converted = load_file("ours/model.safetensors")
    policy = load_file("policy/model.safetensors")
    different = sorted(converted.keys() ^ policy.keys())
    for name in converted.keys() & policy.keys():
        if not converted[name].equal(policy[name]):
            different.append(name)
    return different


def inspected() -> list[str]:
    """What `inspect` counts in the dataset, whose checksums it compares."""
    printed = command("inspect", "dataset=dataset_video", "exec_starts=exec_starts.json")
    # The names of states and actions hold numbers too.
    lines = [line for line in printed.splitlines() if not line.startswith(("state: ", "action: "))]
    return numbers("\n".join(lines))


def nano_tower() -> str:
    """A hash of the vision tower of the shipped checkpoint, on which vision caches depend."""
    return str(mme_vla.MMEPolicy.from_pretrained("nano").vision_fingerprint())
