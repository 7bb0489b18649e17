"""Whether this machine can render, and what to install if it cannot."""

import logging
import re
import shutil
import subprocess
from functools import cache

from mme_vla.errors import UserError

INSTALL_HINT = (
    "Rendering needs a Vulkan driver: an NVIDIA GPU's own, or, without one, Mesa's software driver, 24 or newer. "
    "On Debian and Ubuntu run scripts/install_vulkan.sh (it installs libvulkan1 and mesa-vulkan-drivers >= 24; on "
    "Debian 12 from bookworm-backports). Or pass render=False for an environment without images."
)
OLDEST_MESA = 24


@cache
def render_backend() -> str:
    """The simulator's name for the device that renders: the GPU if there is one, else the CPU.

    Raises:
        UserError: there is no Vulkan driver, or it is too old; the message says what to install.
    """
    import sapien

    try:
        summary = str(sapien.render.get_device_summary())
    except RuntimeError as error:
        raise UserError(f"This machine cannot render ({error}). {INSTALL_HINT}") from None
    supported = [name for name, yes in devices(summary) if yes]
    if not supported:
        raise UserError(f"No Vulkan driver here is new enough:\n{summary.strip()}\n{INSTALL_HINT}")
    try:
        if sapien.Device("cuda").can_render():
            return "sapien_cuda"
    except RuntimeError:
        logging.getLogger(__name__).debug("no CUDA device to render on")
    if all("llvmpipe" in name for name in supported):
        version = mesa_version()
        if version is not None and version < OLDEST_MESA:
            raise UserError(f"mesa-vulkan-drivers {version} is too old to render with. {INSTALL_HINT}")
    return "sapien_cpu"


def devices(summary: str) -> list[tuple[str, bool]]:
    """Name of each device in SAPIEN's summary, and whether SAPIEN supports it."""
    found = re.findall(r"GPU:\s*(.+?)\s*\n\s*Supported:\s*(\d)", summary)
    return [(name, flag == "1") for name, flag in found]


def mesa_version() -> int | None:
    """Major version of the installed package mesa-vulkan-drivers; None where the system is not Debian's kind."""
    if shutil.which("dpkg-query") is None:
        return None
    command = ["dpkg-query", "-W", "-f=${Version}", "mesa-vulkan-drivers"]
    answer = subprocess.run(command, capture_output=True, text=True, check=False).stdout
    major = re.match(r"(?:\d+:)?(\d+)\.", answer)
    return int(major.group(1)) if major else None
