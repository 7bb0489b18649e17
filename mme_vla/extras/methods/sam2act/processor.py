"""What stands between raw data and SAM2Act+: shots become clouds, words tokens, motions targets."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from mme_vla.embodiment import Embodiment
from mme_vla.embodiment.robomme import embodiment_of
from mme_vla.errors import UserError, brief, check_integer, require
from mme_vla.extras.methods.goal_encoders import (
    HASHED,
    ClipEncoder,
    GoalEncoder,
    GoalProcessor,
    direction_of,
)
from mme_vla.extras.methods.sam2act.geometry import (
    EMPTY,
    VIEWS,
    Cube,
    constant_channels,
    unproject,
    virtual_images,
)
from mme_vla.processing.base import STATS_FILE, SampleSpec
from mme_vla.processing.normalise import NormStats
from mme_vla.registry import PROCESSORS
from mme_vla.types import TensorStruct

if TYPE_CHECKING:
    from mme_vla.extras.methods.sam2act.keyframes import KeyframeSample


@dataclass
class KeyframeBatch(TensorStruct):
    """Sequences of k keyframes; k is 1 where single transitions are learnt.

    points: [b, k, n, 3], metres in the world, bounds not applied yet.
    colours: [b, k, n, 3] uint8.
    state: [b, k, p].
    language: [b, l, w] the goal's tokens.
    target: [b, k, 3], metres.
    rotation: [b, k, 4], quaternions (x, y, z, w).
    gripper, collision: [b, k] int64.
    """

    points: Tensor
    colours: Tensor
    state: Tensor
    language: Tensor
    target: Tensor
    rotation: Tensor
    gripper: Tensor
    collision: Tensor


MILLIMETRES = 1000.0
CHANNELS = 10
"""Of a virtual image."""


@dataclass(frozen=True)
class Shot:
    """One camera at one moment.

    colours: [h, w, 3] uint8.
    depth: [h, w], millimetres.
    intrinsic: [3, 3].
    extrinsic: world to camera, [3, 4].
    """

    colours: np.ndarray
    depth: np.ndarray
    intrinsic: np.ndarray
    extrinsic: np.ndarray

    def shrunk(self, side: int) -> "Shot":
        """The same at another size: colours averaged over areas, depths interpolated, as the
        authors do.

        Depths across an edge become points in the air between the two surfaces; the released
        weights know them.
        """
        height, width = self.depth.shape
        if (height, width) == (side, side):
            return self
        colours = torch.from_numpy(self.colours).permute(2, 0, 1)[None].float()
        small = nn.functional.interpolate(colours, (side, side), mode="area")[0].permute(1, 2, 0)
        deep = torch.from_numpy(np.asarray(self.depth, np.float32))[None, None]
        depth = nn.functional.interpolate(deep, (side, side), mode="bilinear")[0, 0]
        intrinsic = np.asarray(self.intrinsic, np.float64).copy()
        intrinsic[0] *= side / width
        intrinsic[1] *= side / height
        return Shot(small.round().to(torch.uint8).numpy(), depth.numpy(), intrinsic, self.extrinsic)

    def points(self) -> tuple[np.ndarray, np.ndarray]:
        """World points [h·w, 3] float32 in metres, and their colours [h·w, 3] uint8."""
        world = unproject(
            np.asarray(self.depth, np.float64) / MILLIMETRES, self.intrinsic, self.extrinsic
        )
        return world.reshape(-1, 3).astype(np.float32), self.colours.reshape(-1, 3)


def cloud_of(shots: Sequence[Shot], side: int) -> tuple[np.ndarray, np.ndarray]:
    """Points [n, 3] float32 and colours [n, 3] uint8 of several cameras at `side` × `side` pixels
    each.
    """
    points, colours = zip(*(shot.shrunk(side).points() for shot in shots), strict=True)
    return np.concatenate(points), np.concatenate(colours)


def cloud_images(points: Tensor, colours: Tensor, cube: Cube, side: int) -> Tensor:
    """What the coarse look sees of clouds in the world: [b, 3, 10, side, side].

    Args:
        points: [b, n, 3] in metres; those outside of the cube are left out.
        colours: [b, n, 3] in [0, 1].
    """
    inside = cube.inside(points)
    return _render_images(cube.place(points), colours, inside, side)


def zoomed_images(
    points: Tensor, colours: Tensor, cube: Cube, centre: Tensor, zoom: float, side: int
) -> Tensor:
    """What the closer look sees: the same points, `zoom` times larger around centres [b, 3] in the
    cube.
    """
    inside = cube.inside(points)
    return _render_images(zoom * (cube.place(points) - centre[:, None]), colours, inside, side)


def _render_images(points: Tensor, colours: Tensor, inside: Tensor, side: int) -> Tensor:
    if points.is_meta:  # shapes alone: there is nothing to draw
        return points.new_empty(len(points), VIEWS, CHANNELS, side, side)
    blank = torch.zeros(VIEWS, 7, side, side, device=points.device)
    blank[:, 6] = EMPTY
    nothing = torch.cat([blank, constant_channels(side, points.device)], 1)
    images = []
    for cloud, paint, mask in zip(points, colours, inside, strict=True):
        views = nothing
        if mask.any():
            views = virtual_images(cloud[mask], paint[mask], side)
        images.append(views)
    return torch.stack(images)


class HashedTokens(GoalEncoder):
    """One fixed random vector [words, width] a word, zeros behind the last: equal words, equal
    vectors.
    """

    def __init__(self, width: int, words: int) -> None:
        super().__init__(width)
        self.words = words

    def encode(self, text: str) -> Tensor:
        tokens = torch.zeros(self.words, self.width)
        for place, word in enumerate(text.lower().split()[: self.words]):
            tokens[place] = direction_of(word, self.width)
        return tokens


class ClipTokens(ClipEncoder):
    """All states [words, width] of the text tower after its last norm.

    The released model reads OpenAI's RN50 text tower (width 512), which no repository of the hub
    holds in this form.
    """

    method, tower = "SAM2Act+", "CLIPTextModel"
    size, option = "hidden_size", "backbone.language"

    def __init__(self, width: int, words: int, folder: str) -> None:
        super().__init__(width, folder)
        self.words = words

    @torch.no_grad()
    def encode(self, text: str) -> Tensor:
        tokenizer, tower = self.parts
        read = tokenizer(
            [text],
            padding="max_length",
            truncation=True,
            max_length=self.words,
            return_tensors="pt",
        )
        # The released code fills with zeros, where transformers repeats the end-of-text token.
        ids = read["input_ids"] * read["attention_mask"]
        states: Tensor = tower(input_ids=ids).last_hidden_state
        return states[0]


NAME = "sam2act_plus"
FINGER_OPEN, FINGER_COUNTS_OPEN = 0.04, 0.035
"""Metres that a finger is out when open, and from which on it counts as open, as released."""
LARGEST = 4096


@PROCESSORS.register(NAME)
class SAM2ActProcessor(GoalProcessor):
    """Nothing here is normalised: points are metres, and the network's output is a waypoint in the
    world.
    """

    name = NAME
    samples = SampleSpec(kind="keyframes")
    text: HashedTokens | ClipTokens

    def __init__(
        self,
        embodiment: Embodiment,
        text: str = HASHED,
        language: int = 512,
        words: int = 77,
        side: int = 128,
        *,
        bounds: Sequence[float] = (-1, -1, -1, 1, 1, 1),
        trained_waypoints: int = 25,
        waypoints: int = 40,
        video_frames: int = 16,
        field_of_view: float = 90.0,
        stats: NormStats | None = None,
    ) -> None:
        """Put it together.

        Args:
            text: `hashed`, or the folder of a CLIP.
            language, words: width and number of its tokens.
            side: pixels that images are brought to before they become points.
            bounds: of the scene in metres, lowest corner first; what is outside is not seen.
            trained_waypoints, waypoints: keyframes that the clock counts to, in training and when
                acting.
            video_frames: frames of the conditioning video that are encoded, evenly spaced.
            field_of_view: of all cameras, in degrees; the benchmark's have 90.
        """
        sizes = {"language": language, "words": words, "side": side, "video_frames": video_frames}
        sizes |= {"trained_waypoints": trained_waypoints, "waypoints": waypoints}
        for name, value in sizes.items():
            check_integer(f"processor.{name}", value, LARGEST)
        numbers = list(bounds)
        finite = all(isinstance(n, int | float) and np.isfinite(n) for n in numbers)
        require(
            len(numbers) == 6 and finite and np.less(numbers[:3], numbers[3:]).all(),
            f"processor.bounds={brief(numbers)} must be x, y, z of the lowest corner, then the"
            " highest.",
        )
        require(
            not isinstance(field_of_view, bool)
            and isinstance(field_of_view, int | float)
            and 0 < field_of_view < 180,
            f"processor.field_of_view={brief(field_of_view)} must lie between 0 and 180 degrees.",
        )
        require(
            isinstance(text, str) and text,
            f"processor.text={brief(text)} must be hashed, or the folder of a CLIP.",
        )
        if blind := [camera.name for camera in embodiment.cameras if not camera.depth]:
            raise UserError(
                f"SAM2Act+ needs depth of every camera; the robot {embodiment.name!r} gives none of"
                f" {', '.join(blind)} (embodiment.cameras.<name>.depth). Set"
                " embodiment=robomme_keyframes."
            )
        self.embodiment, self.text_name = embodiment, text
        self.text = (
            HashedTokens(language, words) if text == HASHED else ClipTokens(language, words, text)
        )
        self.side, self.cube = side, Cube.of(numbers)
        self.trained_waypoints, self.waypoints = trained_waypoints, waypoints
        self.video_frames = video_frames
        self.field_of_view = float(field_of_view)
        self.stats = stats

    @classmethod
    def from_sections(cls, sections: Mapping[str, Any]) -> Self:
        backbone, settings = sections["backbone"], dict(sections["processor"])
        settings.pop("name", None)
        sizes = {"language": backbone["language"], "words": backbone["words"]}
        try:
            return cls(embodiment=embodiment_of(sections), **sizes, **settings)
        except TypeError as error:
            raise UserError(f"The section processor does not fit SAM2Act+: {error}.") from None

    def require_stats(self) -> NormStats:
        """Statistics that change nothing, where none were computed: this policy reads none."""
        robot = self.embodiment
        return self._stats or NormStats.unit(robot.state.width, robot.action.width)

    # Observations

    def images(self, views: Sequence[np.ndarray | Tensor]) -> Tensor:
        """Images of all cameras as they are, [v, 3, H, W] uint8, or [n, v, 3, H, W]; points are
        made of shots.
        """
        stacked = np.stack([np.asarray(view) for view in views], axis=-4)
        return torch.from_numpy(np.ascontiguousarray(np.moveaxis(stacked, -1, -3)))

    def shots(self, views: Mapping[str, np.ndarray], index: int) -> list[Shot]:
        """The cameras' shots of one of the frames that an environment delivers, at the size that
        points are made of.

        Args:
            views: of every camera its images [t, H, W, 3], depths [t, H, W, 1] in millimetres and
                poses [t, 3, 4].
        """
        shots = []
        for camera in self.embodiment.cameras:
            depth, pose = camera.readings
            colours = views[camera.name][index]
            height, width = colours.shape[:2]
            focal = width / 2 / math.tan(math.radians(self.field_of_view) / 2)
            intrinsic = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
            deep = np.asarray(views[depth][index]).reshape(height, width)
            shots.append(
                Shot(colours, deep, intrinsic, np.asarray(views[pose][index])).shrunk(self.side)
            )
        return shots

    def cloud(self, shots: Sequence[Shot]) -> tuple[Tensor, Tensor]:
        """Points [n, 3] in metres, and their colours [n, 3] in [0, 1]."""
        points, colours = cloud_of(shots, self.side)
        painted = torch.from_numpy(np.ascontiguousarray(colours)).float() / 255
        return torch.from_numpy(points), painted

    def clock(self, place: int, waypoints: int) -> float:
        """Time from 1 down to −1, of the `place`-th of `waypoints` keyframes; it stays at −1 past
        the last.
        """
        return 2 * (1 - min(place / max(waypoints - 1, 1), 1)) - 1

    def state(self, finger: float, place: int) -> Tensor:
        """The robot's state for the network [4] when acting: open, both fingers (alike), time."""
        opened = float(finger > FINGER_COUNTS_OPEN)
        return torch.tensor(
            [opened, finger, finger, self.clock(place, self.waypoints)], dtype=torch.float32
        )

    # Actions

    def actions(self, chunk: np.ndarray | Tensor, state: np.ndarray | Tensor) -> Tensor:
        """Recorded waypoints [h, w] as they are."""
        return torch.as_tensor(chunk, dtype=torch.float32)

    def absolute_actions(self, chunk: Tensor, state: Tensor) -> Tensor:
        """The waypoint, which is in the world already."""
        return chunk

    # Batches

    def item(self, sample: "KeyframeSample") -> dict[str, Any]:
        points, colours, states = [], [], []
        for shots, is_open, place in zip(sample.shots, sample.open, sample.places, strict=True):
            places, paint = cloud_of(shots, self.side)
            points.append(places)
            colours.append(paint)
            # As `state`, but for the fingers: in training they are synthetic from the command, as
            # released.
            finger = FINGER_OPEN if is_open else 0.0
            clock = self.clock(int(place), self.trained_waypoints)
            states.append([float(is_open), finger, finger, clock])
        targets = np.asarray(sample.targets, np.float32)
        rotation = Rotation.from_euler("xyz", targets[:, 3:6]).as_quat().astype(np.float32)
        return {
            "points": torch.from_numpy(np.stack(points)),
            "colours": torch.from_numpy(np.stack(colours)),
            "state": torch.tensor(states, dtype=torch.float32),
            "language": self.prompt(sample.goal),
            "target": torch.from_numpy(targets[:, :3]),
            "rotation": torch.from_numpy(rotation),
            "gripper": torch.from_numpy((targets[:, 6] > 0).astype(np.int64)),
            # The recorder's plans ignore collisions.
            "collision": torch.ones(len(targets), dtype=torch.int64),
        }

    def collate(self, items: Sequence[dict[str, Any]]) -> KeyframeBatch:
        stacked = {}
        for name in KeyframeBatch.__dataclass_fields__:
            stacked[name] = torch.stack([item[name] for item in items])
        return KeyframeBatch(**stacked)

    # Folders

    def to_config(self) -> dict[str, Any]:
        return {
            "name": NAME,
            "text": self.text_name,
            "language": self.text.width,
            "words": self.text.words,
            "side": self.side,
            "bounds": [*self.cube.low, *self.cube.high],
            "trained_waypoints": self.trained_waypoints,
            "waypoints": self.waypoints,
            "video_frames": self.video_frames,
            "field_of_view": self.field_of_view,
            "embodiment": self.embodiment.to_dict(),
            "stats": None if self.stats is None else STATS_FILE,
        }
