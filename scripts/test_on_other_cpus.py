"""Run the tests of scenes, numbers and replays as libraries compute on other CPUs.

`uv run --group dev python scripts/test_on_other_cpus.py [PYTEST ARGUMENTS]`

Each setting makes a library choose the kernels of another CPU, or PyTorch another number of
threads. Libraries read the variables when they are loaded, so every setting is one process of
pytest. The command ends with the settings that failed.
"""

import os
import subprocess
import sys
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(REPOSITORY / "tests"))

from helpers.cpu_settings import KERNELS, THREADS, name_of  # noqa: E402

TESTS = (
    "tests/envs/test_scenes_on_other_cpus.py",
    "tests/envs/test_scene_values.py",
    "tests/envs/test_scene_parity.py",
    "tests/envs/test_recorded_texts.py",
    "tests/training/test_numbers_on_other_cpus.py",
    "tests/training/test_resume_exactly.py",
    "tests/memory/test_streaming.py",
    "tests/net/test_net.py::test_saved_policy_gives_the_same_loss_and_actions",
)


def main() -> int:
    """Run all settings, and return how many failed."""
    failed = []
    for setting in KERNELS + THREADS:
        name = name_of(setting)
        print(f"+ {name}", flush=True)
        command = [sys.executable, "-m", "pytest", "-q", "-m", "not nightly", *TESTS]
        command += sys.argv[1:]
        variables = {"OMP_NUM_THREADS": "1", **os.environ, **setting}
        if subprocess.run(command, cwd=REPOSITORY, env=variables, check=False).returncode:
            failed.append(name)
    print("failed: " + ", ".join(failed) if failed else "all settings pass")
    return len(failed)


if __name__ == "__main__":
    raise SystemExit(main())
