"""The renderer: its device and shaders, culling of links, and the engine that is kept for the life
of the process.
"""

import hashlib
import logging
import os
import re
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cache
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mme_vla.errors import UserError, require
from mme_vla.utils import user_cache, write_text

if TYPE_CHECKING:
    import sapien
    from mani_skill.envs.sapien_env import BaseEnv
    from mani_skill.render import ShaderConfig
    from mani_skill.utils.structs.render_camera import RenderCamera

INSTALL_HINT = (
    "Rendering needs a Vulkan driver: an NVIDIA GPU's own, or, without one, Mesa's software driver,"
    " 24 or newer. On Debian and Ubuntu run scripts/install_vulkan.sh (it installs libvulkan1 and"
    " mesa-vulkan-drivers >= 24; on Debian 12 from bookworm-backports). Or pass render=False for an"
    " environment without images."
)
OLDEST_MESA = 24


_process: int | None = None
"""The process in which the renderer began."""


def render_backend() -> str:
    """The simulator's name for the device that renders: the GPU if there is one, else the CPU.

    Raises:
        UserError: this machine cannot render, or this process was forked from one in which the
            renderer had begun: its threads are not in the copy, which would wait for them for ever.
    """
    global _process
    if _process is None:
        _process = os.getpid()
    require(
        _process == os.getpid(),
        f"This process was forked from process {_process}, where images had been rendered:"
        " rendering would wait for ever here. Start processes afresh (`spawn` or `forkserver`:"
        ' AsyncVectorEnv(…, context="spawn"), DataLoader(…, multiprocessing_context="spawn")),'
        " fork before the first image, or pass images=False or render=False.",
    )
    return _find_backend()


@cache
def _find_backend() -> str:
    import sapien

    try:
        summary = str(sapien.render.get_device_summary())
    except RuntimeError as error:
        raise UserError(f"This machine cannot render ({error}). {INSTALL_HINT}") from None
    known = re.findall(r"GPU:\s*(.+?)\s*\n\s*Supported:\s*(\d)", summary)
    supported = [name for name, flag in known if flag == "1"]
    require(supported, f"No Vulkan driver here is new enough:\n{summary.strip()}\n{INSTALL_HINT}")
    try:
        if sapien.Device("cuda").can_render():
            return "sapien_cuda"
    except RuntimeError:
        logging.getLogger(__name__).debug("no CUDA device to render on")
    if all("llvmpipe" in name for name in supported):
        version = mesa_version()
        is_new = version is None or version >= OLDEST_MESA
        require(is_new, f"mesa-vulkan-drivers {version} is too old to render with. {INSTALL_HINT}")
    return "sapien_cpu"


def mesa_version() -> int | None:
    """Major version of the installed package mesa-vulkan-drivers; None where the system is not
    Debian's kind.
    """
    if shutil.which("dpkg-query") is None:
        return None
    command = ["dpkg-query", "-W", "-f=${Version}", "mesa-vulkan-drivers"]
    output = subprocess.run(command, capture_output=True, text=True, check=False).stdout
    major = re.match(r"(?:\d+:)?(\d+)\.", output)
    if major is None:
        return None
    return int(major.group(1))


_systems: dict[str, "sapien.render.RenderSystem"] = {}


def keep_renderer(device: "sapien.Device") -> None:
    """Keep the engine that renders on a device until the process ends; further calls have no
    effect.

    ManiSkill makes a render system for each scene, and all of them share SAPIEN's engine. Its
    shaders and pipelines are compiled for the first image, which takes half a second on a CPU, and
    are freed with the last render system. An additional render system keeps them, and a single
    Vulkan device, of which NVIDIA's driver supports some thirty.
    """
    import sapien

    name = str(device.name)
    if name not in _systems:
        _systems[name] = sapien.render.RenderSystem(device)


PACK = "minimal"
"""ManiSkill's shaders of cameras that observe."""
_TABLE = "samplerBRDFLUT"
_DECLARED = re.compile(rf"^layout\(.*\) uniform sampler2D {_TABLE};$", re.MULTILINE)
_READ = re.compile(rf"texture\({_TABLE}, vec2\([^()]*\)\)\.xy")


def without_table(source: str) -> str:
    """The text of a shader without the table; values read from it become zero."""
    return _DECLARED.sub("", _READ.sub("vec2(0)", source))


def lean_shaders() -> "ShaderConfig | None":
    """Shaders for cameras in scenes without an environment map; None where the installed ones are
    not as expected.

    Sets the formats of images, which ManiSkill sets by the pack's name, so call this right before
    the cameras are made.
    """
    from mani_skill.render.shaders import PREBUILT_SHADER_CONFIGS, set_shader_pack

    folder = _pipeline_folder()
    if folder is None:
        return None
    stock = PREBUILT_SHADER_CONFIGS[PACK]
    set_shader_pack(stock)
    return replace(stock, shader_pack=str(folder))


@cache
def _pipeline_folder() -> Path | None:
    """The folder of changed shaders, made once for an installed SAPIEN."""
    import sapien

    stock = Path(sapien.__file__).parent / "vulkan_shader"
    shaders = {}
    for part in (PACK, "common"):
        for file in sorted((stock / part).glob("*")):
            if file.is_file():
                shaders[file.relative_to(stock)] = file.read_text(encoding="utf-8")
    lean = {name: without_table(text) for name, text in shaders.items()}
    if lean == shaders or any(_TABLE in text for text in lean.values()):
        logging.getLogger(__name__).debug("unknown shaders are used unchanged: %s", stock)
        return None
    key = hashlib.sha256(repr(sorted(lean.items())).encode()).hexdigest()[:16]
    caches = user_cache("shaders") / key
    for name, text in lean.items():
        if not (caches / name).is_file():
            write_text(caches / name, text)
    return caches / PACK


MARGIN = 1e-3
"""Metres that a box must lie beyond the edge of an image."""


@contextmanager
def links_culled(env: "BaseEnv", camera: "RenderCamera") -> Iterator[None]:
    """While a camera renders on the CPU, hide the links of the robot that it cannot see; the image
    stays the same.

    A software renderer spends a millisecond on each link of the robot whose triangles all lie
    outside the image.
    """
    from sapien.render import RenderBodyComponent

    if not env._render_device.is_cpu():
        yield
        return
    bodies = []
    for link in env.agent.robot.links:
        body = link._objs[0].entity.find_component_by_type(RenderBodyComponent)
        if body is not None:
            bodies.append(body)
    boxes = np.array([body.get_global_aabb_fast() for body in bodies]).reshape(-1, 2, 3)
    corners = np.stack([boxes[:, ends, range(3)] for ends in product((0, 1), repeat=3)], 1)

    # Which boxes lie beyond one edge of the image [n].
    render_camera = camera._render_cameras[0]
    view = render_camera.global_pose.inv().to_transformation_matrix()
    # each [n, 8]
    x, y, z = np.moveaxis(corners @ view[:3, :3].T + view[:3, 3], -1, 0)  # forward, left, up
    right, top = x * np.tan(render_camera.fovx / 2), x * np.tan(render_camera.fovy / 2)
    outside = np.stack([y - right, -y - right, z - top, -z - top]) > MARGIN  # [4, n, 8]
    beyond = np.any(np.all(outside, axis=-1), axis=0)

    hidden = [(body, body.visibility) for body, flag in zip(bodies, beyond, strict=True) if flag]
    try:
        for body, _ in hidden:
            body.visibility = 0.0
        yield
    finally:
        for body, visibility in hidden:
            body.visibility = visibility
