"""Sizes of Diffusion Policy's networks: `configs/backbone/dp*.yaml`, where each is explained."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Self

from mme_vla.backbone.base import VisionConfig
from mme_vla.config.sections import read_section
from mme_vla.errors import UserError, brief, require

NAME = "diffusion_policy"
LARGEST = 2**16


@dataclass(frozen=True)
class DiffusionSizes:
    """The keys of the section `backbone` of Diffusion Policy.

    picture: (height, width) before cropping.
    widths: of the U-Net's levels.
    window: frames an observation has.
    memory_tower, memory_width: what turns remembered frames into tokens, where there is a memory.
    """

    horizon: int
    action_dim: int
    window: int = 1
    picture: tuple[int, int] = (256, 256)
    crop: float = 0.9
    keypoints: int = 32
    text_dim: int = 512
    text_hidden: int = 64
    text_width: int = 64
    widths: tuple[int, ...] = (256, 512, 1024)
    kernel: int = 5
    groups: int = 8
    step_width: int = 128
    diffusion_steps: int = 100
    memory_tower: VisionConfig = field(default_factory=VisionConfig)
    memory_width: int = 2048

    @classmethod
    def from_dict(cls, section: Mapping[str, Any]) -> Self:
        """Read the section `backbone` of a configuration."""
        values = dict(section)
        if (name := values.pop("name", None)) != NAME:
            raise UserError(
                f"backbone.name={brief(name)} is no network of Diffusion Policy: choose"
                " backbone=dp, or dp_tiny to try things out."
            )
        return read_section(cls, values, "backbone")

    def __post_init__(self) -> None:
        for f in fields(self):
            value = getattr(self, f.name)
            members = value if isinstance(value, tuple) else (value,)
            allowed = [1 <= n <= LARGEST for n in members if isinstance(n, int)]
            if not members or not all(allowed):
                # The processor decides the window, and the backbone follows.
                where = "processor" if f.name == "window" else "backbone"
                raise UserError(
                    f"{where}.{f.name}={brief(value)} must be made of whole numbers from 1 to"
                    f" {LARGEST}."
                )
        require(
            0 < self.crop <= 1,
            f"backbone.crop={brief(self.crop)} must lie above 0 and at most at 1.",
        )
        halved = 2 ** (len(self.widths) - 1)
        require(
            self.horizon % halved == 0,
            f"embodiment.action.horizon={self.horizon} must be a multiple of {halved}: each of the"
            f" U-Net's {len(self.widths)} levels (backbone.widths) but the last halves the chunk.",
        )
        require(
            self.window <= self.horizon,
            f"processor.window={self.window} leaves no action of a chunk of {self.horizon}.",
        )
        even = self.step_width % 2 == 0 and self.step_width >= 4
        require(
            even,
            f"backbone.step_width={self.step_width} must be even and at least 4: sines and"
            " cosines.",
        )
        require(
            self.kernel % 2,
            f"backbone.kernel={self.kernel} must be odd, so that a chunk keeps its length.",
        )
        if bad := [width for width in self.widths if width % self.groups]:
            raise UserError(
                f"backbone.widths: {bad[0]} is no multiple of backbone.groups={self.groups}."
            )
        if self.widths[0] % 8:
            raise UserError(
                f"backbone.widths: the first, {self.widths[0]}, must be a multiple of 8."
            )

    @property
    def cropped(self) -> tuple[int, int]:
        """Height and width that the network sees."""
        height, width = self.picture
        return int(self.crop * height), int(self.crop * width)
