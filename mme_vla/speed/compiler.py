"""Compiled code on disk: where it is kept, and whether it can be made."""

import os
import shutil
import sys
from importlib.util import find_spec
from pathlib import Path

import torch

from mme_vla.utils import user_cache

CACHE_VARIABLE = "TORCHINDUCTOR_CACHE_DIR"


def keep_compiled_code() -> Path:
    """Keep what `torch.compile` makes in the user's cache folder, and return the folder.

    A later process reads it in seconds. The folder belongs to the user alone and is never beside a
    checkpoint: compiled code is executed, and a checkpoint may come from anybody. Where
    `TORCHINDUCTOR_CACHE_DIR` is set, it names the folder.
    """
    if CACHE_VARIABLE not in os.environ:
        folder = user_cache("compiled")
        folder.mkdir(parents=True, exist_ok=True)
        folder.chmod(0o700)
        os.environ[CACHE_VARIABLE] = str(folder)
    return Path(os.environ[CACHE_VARIABLE])


def missing_compiler(device: torch.device) -> str | None:
    """What `torch.compile` needs on this device and does not find; None if it has all."""
    if device.type != "cuda":
        default = "clang++" if sys.platform == "darwin" else "g++"
        compiler = os.environ.get("CXX", default)
        return None if shutil.which(compiler) else f"the C++ compiler {compiler}"
    if find_spec("triton") is None:
        return "the package triton"
    # Triton compiles what launches its kernels.
    compilers = [os.environ["CC"]] if "CC" in os.environ else ["cc", "gcc", "clang"]
    if not any(shutil.which(compiler) for compiler in compilers):
        return f"a C compiler ({', '.join(compilers)})"
    return None
