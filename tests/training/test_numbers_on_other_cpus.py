"""What a seed means beside scenes (noise, order of samples, bootstraps, tokens) has the same bits
on every CPU.

`torch.randn` of 16 and more numbers uses vector instructions for logarithm and sine where a CPU has
AVX2. The digest of noise holds for these CPUs, which all that the library is tested on are.
"""

import json
import os
import subprocess
import sys

import pytest
import torch

from helpers import REPOSITORY, number_digests
from helpers.cpu_settings import KERNELS, name_of

RECORDED = {
    "noise": "e610e6d0bd84d63c",
    "order": "a177904211f268c7",
    "bootstraps": "4f29ccc3303b900a",
    "tokens": "0d9a53aa3b8de47b",
}


@pytest.mark.parametrize("name", ["order", "bootstraps", "tokens"])
def test_numbers_of_a_seed_have_the_recorded_bits(name: str) -> None:
    assert getattr(number_digests, name)() == RECORDED[name]


def test_noise_of_a_seed_has_the_recorded_bits() -> None:
    if torch.backends.cpu.get_cpu_capability() == "DEFAULT":
        pytest.skip("PyTorch uses no AVX2 here: its normal numbers then differ in the last bits")
    assert number_digests.noise() == RECORDED["noise"]


@pytest.mark.nightly
@pytest.mark.parametrize("setting", KERNELS, ids=name_of)
def test_numbers_of_a_seed_do_not_depend_on_the_kernels_of_a_cpu(setting: dict[str, str]) -> None:
    environment = (
        os.environ | setting | {"PYTHONPATH": f"{REPOSITORY}{os.pathsep}{REPOSITORY / 'tests'}"}
    )
    command = [sys.executable, "-W", "ignore", "-m", "helpers.number_digests"]
    finished = subprocess.run(
        command, env=environment, cwd=REPOSITORY, capture_output=True, text=True, check=False
    )
    assert finished.returncode == 0, finished.stderr[-2000:]
    digests = json.loads(finished.stdout.splitlines()[-1])
    expected = dict(RECORDED)
    if setting.get("ATEN_CPU_CAPABILITY") == "default":  # no AVX2
        del digests["noise"], expected["noise"]
    assert digests == expected
