"""The two robots of the benchmark: a Panda with a gripper and a Panda with a stick, both with a camera on the hand.

The stock simulator describes both; here the wrist camera gets the benchmark's size, and the stick robot, which has no
camera in stock, gets the mount of the gripper robot. Robots are also described without visual shapes, so that
physics can run where there is no renderer, and the wrist camera's own body with no more detail than shows.
"""

import hashlib
import os
import tempfile
from functools import cache
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import sapien
from mani_skill.agents.registration import register_agent
from mani_skill.agents.robots.panda.panda_stick import PandaStick
from mani_skill.agents.robots.panda.panda_wristcam import PandaWristCam
from mani_skill.sensors.camera import CameraConfig

from mme_vla.envs.rendering import CELL, coarsen, read_stl, stl_bytes
from mme_vla.utils import user_cache

WRISTCAM = "mme_vla_panda_wristcam"
"""Agent id of the Panda with gripper and wrist camera."""
STICK = "mme_vla_panda_stick"
"""Agent id of the Panda that holds a stick."""
ROBOT_BASE = (-0.615, 0.0, 0.0)
"""Where the robots stand, metres."""

CAMERA_LINK = "camera_link"
MOUNT = ("camera_base_link", CAMERA_LINK)
"""The links by which the wrist camera hangs on the hand."""
_CAMERA_MESH = "d415.stl"


def _camera(agent: Any) -> list[CameraConfig]:
    mount = agent.robot.links_map[CAMERA_LINK]
    return [CameraConfig("hand_camera", sapien.Pose(), 256, 256, np.pi / 2, 0.01, 100, mount=mount)]


@register_agent()
class WristCamPanda(PandaWristCam):
    """Panda with two fingers; its wrist camera has 256 x 256 pixels."""

    uid = WRISTCAM

    @property
    def urdf_path(self) -> str:
        return description(PandaWristCam.urdf_path, visible=self.scene.can_render())

    @property
    def _sensor_configs(self) -> list[CameraConfig]:
        return _camera(self)


@register_agent()
class StickPanda(PandaStick):
    """Panda with a fixed stick in place of the fingers, and the same wrist camera on the same mount."""

    uid = STICK

    @property
    def urdf_path(self) -> str:
        return description(PandaStick.urdf_path, mount_from=PandaWristCam.urdf_path, visible=self.scene.can_render())

    @property
    def _sensor_configs(self) -> list[CameraConfig]:
        return _camera(self)


@cache
def description(stock: str, mount_from: str | None = None, visible: bool = True) -> str:
    """Path of a robot description derived from a stock one; written once, next to a copy of its collision rules.

    Args:
        stock: URDF file to start from.
        mount_from: URDF file whose camera mount is added.
        visible: keep what is there to be seen; without it the robot can be built where there is no renderer.
    """
    source = Path(stock)
    robot = ElementTree.parse(source).getroot()
    if mount_from is not None:
        _add_mount(robot, ElementTree.parse(mount_from).getroot())
    for link in robot.iter("link"):
        for visual in [] if visible else link.findall("visual"):
            link.remove(visual)
    caches = user_cache("robots")
    for mesh in robot.iter("mesh"):
        mesh.set("filename", str(source.parent / mesh.attrib["filename"]))
    for mesh in robot.iterfind("link/visual/geometry/mesh"):
        if Path(mesh.attrib["filename"]).name == _CAMERA_MESH:
            mesh.set("filename", str(_coarse(Path(mesh.attrib["filename"]), caches)))
    text = ElementTree.tostring(robot)
    folder = caches / hashlib.sha256(text).hexdigest()[:16]
    folder.mkdir(parents=True, exist_ok=True)
    _write(folder / source.with_suffix(".srdf").name, source.with_suffix(".srdf").read_bytes())
    _write(folder / source.name, text)
    return str(folder / source.name)


def _add_mount(robot: ElementTree.Element, donor: ElementTree.Element) -> None:
    joints = [joint for joint in donor.findall("joint") if joint.find("child").attrib["link"] in MOUNT]  # type: ignore[union-attr]
    links = [link for link in donor.findall("link") if link.attrib["name"] in MOUNT]
    for visual in [visual for link in links for visual in link.findall("visual")]:
        for material in visual.findall("material"):  # the camera is white in the official images
            visual.remove(material)
    robot.extend([*links, *joints])


def _coarse(mesh: Path, caches: Path) -> Path:
    """The mesh with no more detail than shows; made once."""
    key = hashlib.sha256(mesh.read_bytes() + str(CELL).encode()).hexdigest()[:16]
    coarse = caches / key / mesh.name
    if not coarse.exists():
        coarse.parent.mkdir(parents=True, exist_ok=True)
        _write(coarse, stl_bytes(coarsen(read_stl(mesh))))
    return coarse


def _write(path: Path, content: bytes) -> None:
    if path.exists():
        return
    # Several processes may write at once: each writes its own file and moves it into place.
    handle, name = tempfile.mkstemp(dir=path.parent)
    with os.fdopen(handle, "wb") as file:
        file.write(content)
    Path(name).replace(path)
