"""Compiled code on disk: where it is kept, and whether it can be made."""

import os
import shutil
import sys
from importlib.util import find_spec
from pathlib import Path

import torch

from mme_vla.utils import user_cache

CACHE_VARIABLE = "TORCHINDUCTOR_CACHE_DIR"
CHOICE_OF_KERNELS = (
    "torch.nn.attention._backend_from_string",
    "torch.nn.attention._sdpa_kernel",
)
"""What `fused_kernels` leaves in a graph. PyTorch keeps no traced graph that calls these
(pytorch#194007), although their arguments, which are in its key, say all that they do.
"""


def keep_compiled_code() -> Path:
    """Keep what `torch.compile` makes in the user's cache folder, and return the folder.

    A later process reads it in seconds. The folder belongs to the user alone and is never beside a
    checkpoint: compiled code is executed, and a checkpoint may come from anybody. Where
    `TORCHINDUCTOR_CACHE_DIR` is set, it names the folder.
    """
    from torch._inductor import config
    from torch._inductor.runtime.cache_dir_utils import default_cache_dir

    # Where it is not set, that import sets it: to a folder among the temporary ones of all users.
    if os.environ.get(CACHE_VARIABLE, default_cache_dir()) == default_cache_dir():
        folder = user_cache("compiled")
        folder.mkdir(parents=True, exist_ok=True)
        folder.chmod(0o700)
        os.environ[CACHE_VARIABLE] = str(folder)
    cacheable = dict.fromkeys(CHOICE_OF_KERNELS, torch.__version__)
    config.unsafe_marked_cacheable_functions = config.unsafe_marked_cacheable_functions | cacheable
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
