"""The renderer, kept for the life of the process.

ManiSkill makes a render system for each scene. All of them share SAPIEN's engine, in which shaders and pipelines are
compiled when the first picture is taken, half a second where software renders; it goes with the last render system
that holds it. An episode that closes its scene before the next one opens so pays for it again. One more render system,
never released, keeps it; scenes stay separate, and pictures the same.

It also keeps one Vulkan device from being opened per environment, of which NVIDIA's driver bears some thirty only.
"""

import logging
from typing import TYPE_CHECKING

from mme_vla.envs.shaders import lean_shaders

if TYPE_CHECKING:
    import sapien

_CHECK_SIZE = 8

_kept: dict[str, "sapien.render.RenderSystem"] = {}


def keep_renderer(device: "sapien.Device") -> None:
    """Hold the engine that renders on a device until the process ends; asking again does nothing."""
    import sapien

    name = str(device.name)
    if name not in _kept:
        _kept[name] = sapien.render.RenderSystem(device)


def renderer_works() -> bool:
    """Whether each renderer that is kept still takes pictures; true where none is kept.

    A lost device or memory that ran out leaves a renderer behind that fails from then on, whatever is asked of it: only
    another process helps.
    """
    try:
        for system in _kept.values():
            _take_picture(system.device)
    except RuntimeError as error:  # all that Vulkan's errors become
        logging.getLogger(__name__).warning("the renderer has failed: %s", error)
        return False
    return True


def _take_picture(device: "sapien.Device") -> None:
    import sapien

    lean = lean_shaders() if device.is_cpu() else None
    sapien.render.set_camera_shader_dir("default" if lean is None else lean.shader_pack)
    scene = sapien.Scene([sapien.physx.PhysxCpuSystem(), sapien.render.RenderSystem(device)])
    camera = scene.add_camera("check", _CHECK_SIZE, _CHECK_SIZE, 1.0, 0.01, 1.0)
    scene.update_render()
    camera.take_picture()
    camera.get_picture("Color")
