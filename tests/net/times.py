"""How long an import and a help text take, and how many modules they import."""

import os
import statistics
import subprocess
import sys
import time
from collections.abc import Sequence
from typing import Any

from net.archives import PACKAGE_PATH

COMMANDS = {
    "import mme_vla": ["-c", "import mme_vla"],
    "mme-vla --help": ["-m", "mme_vla", "--help"],
    "mme-vla train --help": ["-m", "mme_vla", "train", "--help"],
}


def measure(words: Sequence[str], repeats: int = 1) -> dict[str, Any]:
    """Median of the seconds that a fresh process takes, and the modules that it imports, Python's
    own included.
    """
    environment = {**os.environ, "PYTHONPATH": str(PACKAGE_PATH)}
    seconds = []
    for _ in range(repeats):
        begun = time.perf_counter()
        subprocess.run([sys.executable, *words], check=True, capture_output=True, env=environment)
        seconds.append(time.perf_counter() - begun)
    counted = [sys.executable, "-X", "importtime", *words]
    lines = subprocess.run(
        counted, check=True, capture_output=True, text=True, env=environment
    ).stderr.splitlines()
    modules = {
        line.rsplit("|", 1)[1].strip() for line in lines if line.startswith("import time:")
    } - {"imported package"}
    return {
        "seconds": round(statistics.median(seconds), 3),
        "modules": len(modules),
        "of_the_library": sum(name.partition(".")[0] == "mme_vla" for name in modules),
    }
