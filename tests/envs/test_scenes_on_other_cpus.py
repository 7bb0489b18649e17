"""Scenes are the same to the last bit whatever kernels the libraries choose: one digest of 90
scenes.

Each variable below makes a library compute as it does on another CPU. Libraries read it when they
load, so each setting has a process of its own. `qemu-x86_64` (package `qemu-user`) emulates a whole
CPU of another maker.
"""

import os
import shutil
import subprocess
import sys

import pytest

pytest.importorskip("mani_skill", reason="the simulation needs the extra 'sim'")

from helpers import REPOSITORY
from helpers.cpu_settings import KERNELS, name_of
from helpers.scene_digest import scene_digest

ALL = "83a1ec626029d931af403d2ff72ae18433d764a68bcde802d00bf4630ee7e499"
EVERY_TENTH = "57d0bfd8218067932f3a40cc3c174eda2fcba36eb806760c16e9007437167320"
EVERY_TWELFTH = "c8acb4980eb9f69d22ee29fb7a227e8128feba56a4bb3964bfe8bad97e6fb56e"


def digest_in_process(*command: str, every: int = 1, **settings: str) -> str:
    environment = (
        os.environ | settings | {"PYTHONPATH": f"{REPOSITORY}{os.pathsep}{REPOSITORY / 'tests'}"}
    )
    words = [*command, sys.executable, "-W", "ignore", "-m", "helpers.scene_digest", str(every)]
    finished = subprocess.run(
        words, env=environment, cwd=REPOSITORY, capture_output=True, text=True, check=False
    )
    assert finished.returncode == 0, finished.stderr[-2000:]
    return finished.stdout.split()[-1]


def test_scenes_here_have_the_recorded_bits() -> None:
    assert scene_digest(every=10) == EVERY_TENTH


@pytest.mark.nightly
@pytest.mark.parametrize("setting", KERNELS, ids=name_of)
def test_scenes_have_the_same_bits_with_the_kernels_of_another_cpu(setting: dict[str, str]) -> None:
    assert digest_in_process(**setting) == ALL


@pytest.mark.nightly
@pytest.mark.parametrize("model", ["EPYC-Milan", "Haswell"])
def test_scenes_have_the_same_bits_on_an_emulated_cpu_of_each_maker(model: str) -> None:
    emulator = shutil.which("qemu-x86_64")
    if emulator is None:
        pytest.skip(
            "needs qemu-x86_64 of version 10: apt-get install -t bookworm-backports qemu-user"
        )
    version = subprocess.run(
        [emulator, "--version"], capture_output=True, text=True, check=True
    ).stdout
    if int(version.split("version ")[1].split(".")[0]) < 10:
        pytest.skip(
            f"qemu-x86_64 is too old, earlier ones crash here: {version.splitlines()[0]}; expected"
            " version 10"
        )
    assert (
        digest_in_process(emulator, "-cpu", model, every=12, OMP_NUM_THREADS="1") == EVERY_TWELFTH
    )
