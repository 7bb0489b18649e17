"""The two robots of the benchmark: a Panda with a gripper and a Panda with a stick, both with a
camera on the hand.

The stock simulator describes both; here the wrist camera gets the benchmark's size, and the stick
robot, which has no camera in stock, gets the mount of the gripper robot. Robots are also described
without visual shapes, so that physics can run where there is no renderer, and the wrist camera's
own body with no more detail than shows.
"""

import hashlib
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

from mme_vla.utils import user_cache, write_atomically

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
CELL = 0.001
"""Width of a cell, metres: less than a pixel covers from 0.13 metres on."""
_HEADER_BYTES = 80
_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


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

    _sensor_configs = property(_camera)


@register_agent()
class StickPanda(PandaStick):
    """Panda with a fixed stick in place of the fingers, and the same wrist camera on the same
    mount.
    """

    uid = STICK

    @property
    def urdf_path(self) -> str:
        return description(
            PandaStick.urdf_path,
            mount_from=PandaWristCam.urdf_path,
            visible=self.scene.can_render(),
        )

    _sensor_configs = property(_camera)


@cache
def description(stock: str, mount_from: str | None = None, visible: bool = True) -> str:
    """Path of a robot description derived from a stock one; written once, next to a copy of its
    collision rules.

    Args:
        stock: URDF file to start from.
        mount_from: URDF file whose camera mount is added.
        visible: keep what is there to be seen; without it the robot can be built where there is no
            renderer.
    """
    source = Path(stock)
    robot = ElementTree.parse(source).getroot()
    if mount_from is not None:
        _add_mount(robot, ElementTree.parse(mount_from).getroot())
    if not visible:
        for link in robot.iter("link"):
            for visual in link.findall("visual"):
                link.remove(visual)
    caches = user_cache("robots")
    for mesh in robot.iter("mesh"):
        mesh.set("filename", str(source.parent / mesh.attrib["filename"]))
    for mesh in robot.iterfind("link/visual/geometry/mesh"):
        stock_mesh = Path(mesh.attrib["filename"])
        if stock_mesh.name == _CAMERA_MESH:
            # With no more detail than shows; made once.
            key = hashlib.sha256(stock_mesh.read_bytes() + str(CELL).encode()).hexdigest()[:16]
            coarse = caches / key / stock_mesh.name
            if not coarse.exists():
                _write(coarse, stl_bytes(coarsen(read_stl(stock_mesh))))
            mesh.set("filename", str(coarse))
    text = ElementTree.tostring(robot)
    folder = caches / hashlib.sha256(text).hexdigest()[:16]
    _write(folder / source.with_suffix(".srdf").name, source.with_suffix(".srdf").read_bytes())
    _write(folder / source.name, text)
    return str(folder / source.name)


def _add_mount(robot: ElementTree.Element, donor: ElementTree.Element) -> None:
    joints = []
    for joint in donor.findall("joint"):
        child = joint.find("child")
        if child is not None and child.attrib["link"] in MOUNT:
            joints.append(joint)
    links = [link for link in donor.findall("link") if link.attrib["name"] in MOUNT]
    for link in links:
        for visual in link.iterfind("visual"):
            for material in visual.findall("material"):
                visual.remove(material)  # the camera is white in the official images
    robot.extend([*links, *joints])


def _write(path: Path, content: bytes) -> None:
    if not path.exists():
        with write_atomically(path) as draft:  # several processes may write at once
            draft.write_bytes(content)


def coarsen(corners: np.ndarray, cell: float = CELL) -> np.ndarray:
    """Merge corners that lie in one cell of a grid into their mean.

    Args:
        corners: of each triangle, float [n, 3, 3], metres.
        cell: width of a cell, metres.

    Returns:
        Corners [m, 3, 3] float32, m <= n, of the triangles whose corners lie in three cells, each
        once and with its side kept, in an order that depends on nothing else.
    """
    points = corners.reshape(-1, 3)
    _, cells, counts = np.unique(
        np.floor(points / cell).astype(np.int64), axis=0, return_inverse=True, return_counts=True
    )
    cells = cells.reshape(-1)
    sums = [np.bincount(cells, points[:, axis]) for axis in range(3)]
    means = np.stack(sums, 1) / counts[:, None]
    triangles = cells.reshape(-1, 3)
    different = (triangles != np.roll(triangles, 1, axis=1)).all(axis=1)
    triangles = triangles[different]
    # Turned, so that a triangle begins with its lowest corner whichever it began with.
    rotation = (triangles.argmin(axis=1)[:, None] + np.arange(3)) % 3
    triangles = np.unique(np.take_along_axis(triangles, rotation, axis=1), axis=0)
    return means[triangles].astype(np.float32)


def read_stl(path: Path) -> np.ndarray:
    """Corners [n, 3, 3] float32 of the triangles of a binary STL file."""
    return np.frombuffer(path.read_bytes(), _TRIANGLE, offset=_HEADER_BYTES + 4)["corners"].copy()


def stl_bytes(corners: np.ndarray) -> bytes:
    """A binary STL file of triangles with corners [n, 3, 3], each with the normal of its side."""
    triangles = np.zeros(len(corners), _TRIANGLE)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    triangles["normal"] = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)
    triangles["corners"] = corners
    return bytes(_HEADER_BYTES) + len(corners).to_bytes(4, "little") + triangles.tobytes()
