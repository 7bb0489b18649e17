"""A running episode of SAM2Act+: a bank of keyframes, and the cloud that is seen now."""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

import numpy as np
import torch
from torch import Tensor

from mme_vla.errors import UserError, require
from mme_vla.extras.methods.sam2act.geometry import (
    ZOOM,
    Cube,
    PointFinder,
    angles_of_bins,
)
from mme_vla.extras.methods.sam2act.model import SAM2ActNetwork
from mme_vla.extras.methods.sam2act.processor import (
    Shot,
    cloud_images,
    zoomed_images,
)
from mme_vla.extras.methods.sam2act.sam2 import BankState
from mme_vla.extras.methods.writable_memory import MemoryEntries
from mme_vla.policy.episode import Episode

if TYPE_CHECKING:
    from mme_vla.extras.methods.sam2act.policy import SAM2ActPolicy


@dataclass(frozen=True)
class SceneInputs:
    """What an episode shows the network at one keyframe.

    points: [n, 3], metres.
    colours: [n, 3] in [0, 1].
    state: [p]: gripper open, two fingers, time.
    language: [l, w].
    """

    points: Tensor
    colours: Tensor
    state: Tensor
    language: Tensor

    def to(self, device: torch.device) -> "SceneInputs":
        return SceneInputs(
            points=self.points.to(device),
            colours=self.colours.to(device),
            state=self.state.to(device),
            language=self.language.to(device),
        )


@torch.no_grad()
def decide(
    network: SAM2ActNetwork,
    scene: SceneInputs,
    remembered: BankState,
    cube: Cube,
    finder: PointFinder,
) -> tuple[Tensor, BankState]:
    """The next waypoint of one episode, and what it remembers after this keyframe.

    Returns:
        The benchmark's waypoint [7]: position in metres, extrinsic roll-pitch-yaw in radians,
        gripper −1 (closed) or 1. Whether the way there may touch things, which the network tells
        too, the benchmark's planner does not ask.
    """
    points, colours = scene.points[None], scene.colours[None]
    state, language = scene.state[None], scene.language[None]
    side = network.sizes.side
    views = network.encode_views(cloud_images(points, colours, cube, side), state, language)
    logits, remembered = network.coarse_step(views, remembered)
    first = finder.find(logits)
    near = zoomed_images(points, colours, cube, first, ZOOM, side)
    logits, tokens = network.fine_step(network.encode_views(near, state, language))
    point = finder.find(logits)
    outputs = network.heads(tokens, point)
    bins = torch.stack([outputs[axis].argmax(-1) for axis in "xyz"], -1)
    angles = torch.deg2rad(angles_of_bins(bins, network.sizes.rotation_bins)).float()
    grip = 2.0 * outputs["gripper"].argmax(-1, keepdim=True) - 1
    position = cube.back(point / ZOOM + first)  # in the coordinates of the first look
    waypoint = torch.cat([position, angles, grip], -1)[0].float()
    return waypoint, remembered


@torch.no_grad()
def watch(
    network: SAM2ActNetwork, scene: SceneInputs, remembered: BankState, cube: Cube
) -> BankState:
    """What an episode remembers after a frame at which nothing is decided, such as one of the
    conditioning video.
    """
    images = cloud_images(scene.points[None], scene.colours[None], cube, network.sizes.side)
    views = network.encode_views(images, scene.state[None], scene.language[None])
    return network.coarse_step(views, remembered)[1]


class KeyframeEpisode(Episode):
    """Goal, bank and current shots of one episode.

    A keyframe is a frame at which a waypoint is predicted: the last one of those that arrive
    together. Of the conditioning video some frames, evenly spread, are taken into the bank once the
    first execution frame is there.
    """

    policy: "SAM2ActPolicy"

    def __init__(self, policy: "SAM2ActPolicy", goal: str, seed: int = 0) -> None:
        super().__init__(policy, goal, seed)
        self.remembered = BankState()
        """What was kept of all keyframes before the current one."""
        self.waypoints = 0
        """Waypoints that were executed."""
        self._after: BankState | None = None
        self._now: tuple[list[Shot], float] | None = None
        self._video: list[tuple[list[Shot], float]] = []

    def observe(
        self,
        frames: Mapping[str, np.ndarray],
        states: np.ndarray,
        is_demo: bool | np.ndarray = False,
        actions: np.ndarray | None = None,
        rendered: Mapping[str, np.ndarray] | None = None,
    ) -> None:
        """Take frames in order, with what the cameras read beside their images; see
        `Episode.observe`.

        Args:
            frames: of every camera also `<name>_depth` [t, H, W, 1] in millimetres and
                `<name>_camera_extrinsic` [t, 3, 4], from the world to the camera.
            rendered: the same frames for every camera; depth and poses are given for these alone.
        """
        self._check_readings(frames)
        by_camera = [] if rendered is None else list(rendered.values())
        require(
            all(np.array_equal(by_camera[0], places) for places in by_camera),
            "This policy sees through all of its cameras at once: draw the same frames of each.",
        )
        super().observe(frames, states, is_demo, actions, rendered)
        demo = np.broadcast_to(np.asarray(is_demo, bool), (len(states),))
        places = range(len(demo)) if rendered is None else next(iter(rendered.values())).tolist()
        processor = self.policy.require_processor()
        fingers = np.asarray(states, np.float32)[:, -1]
        for i, at in enumerate(places):
            if demo[at]:
                self._video.append((processor.shots(frames, i), float(fingers[at])))
        if len(demo) and not demo[-1]:
            # The video is over: some of its moments, spread evenly, are remembered.
            count = min(len(self._video), processor.video_frames)
            indices = np.linspace(0, len(self._video) - 1, count).round().astype(int)
            for place, index in enumerate(indices):
                shots, finger = self._video[index]
                scene = self._scene_inputs(shots, finger, place)
                self.remembered = self.policy.watch(scene, self.remembered)
            self._video = []
            if self._after is not None:
                self.remembered, self._after = self._after, None
                self.waypoints += 1
            self._now = None
            if len(places) and places[-1] == len(demo) - 1:
                self._now = (processor.shots(frames, len(places) - 1), float(fingers[-1]))

    def scene_inputs(self) -> SceneInputs:
        """What the network is shown now."""
        if self._now is None:
            raise UserError(
                "The episode has seen no execution frame yet: call observe() with the current one"
                " first."
            )
        shots, finger = self._now
        return self._scene_inputs(shots, finger, self.waypoints)

    def decided(self, remembered: BankState) -> None:
        """Note what is remembered once the frame that was decided at lies behind: when the next
        ones are observed.
        """
        self._after = remembered

    @property
    def awaiting(self) -> BankState | None:
        """What `decided` noted last, until the next frames are observed."""
        return self._after

    # Writable memory (`methods/writable_memory.py`)

    memory_clock = None

    def writable_memory(self) -> tuple[MemoryEntries, ...]:
        """The maps of the latest keyframes; their times are their order."""
        maps = self.remembered.maps
        return (MemoryEntries("memory", tuple(enumerate(maps)), len(maps)),)

    def with_entries(self, stores: Sequence[Sequence[tuple[int, Tensor]]]) -> Self:
        twin = copy.copy(self)
        twin.remembered = BankState(tuple(content for _, content in stores[0]))
        return twin

    def resume_from(self, twin: Episode) -> None:
        assert isinstance(twin, KeyframeEpisode) and twin.awaiting is not None
        newest = twin.awaiting.maps[-1]  # the others are not what this episode saw
        maps = (*self.remembered.maps, newest)
        self.decided(BankState(maps[-self.policy.backbone.sizes.remembered :]))

    def _scene_inputs(self, shots: list[Shot], finger: float, place: int) -> SceneInputs:
        processor = self.policy.require_processor()
        points, colours = processor.cloud(shots)
        return SceneInputs(
            points, colours, processor.state(finger, place), processor.prompt(self.goal)
        )

    def _check_readings(self, frames: Mapping[str, np.ndarray]) -> None:
        for camera in self._robot.cameras:
            if camera.name not in frames:
                continue  # which `Episode.observe` tells
            images = np.asarray(frames[camera.name])
            depth, pose = camera.readings
            for name, shape in ((depth, (*images.shape[:3], 1)), (pose, (len(images), 3, 4))):
                require(
                    name in frames,
                    f"observe() needs {name!r} beside the camera {camera.name!r}; got"
                    f" {sorted(frames)}.",
                )
                readings = np.asarray(frames[name])
                require(
                    readings.shape in (shape, shape[:3]) and readings.dtype.kind in "fiu",
                    f"{name} must be {list(shape)} numbers; got {readings.dtype}"
                    f" {list(readings.shape)}.",
                )
