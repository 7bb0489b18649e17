"""`ActionSpace`: what the numbers of an action mean, as recorded, as predicted and as commanded."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Self

from mme_vla.config.sections import section_keys
from mme_vla.embodiment import fields
from mme_vla.errors import UserError, brief

if TYPE_CHECKING:
    from torch import Tensor  # `--help` reads robots without PyTorch

_KEYS = (
    "key", "space", "width", "names", "units", "relative", "angles", "binary", "horizon", "execute", "frames",
)  # fmt: skip


@dataclass(frozen=True)
class ActionSpace:
    """What a policy answers with.

    width: w; numbers of an action. key: columns of the dataset that hold them, joined; empty for the usual names.
    space: the benchmark's action space that takes them; None for a robot that is not the benchmark's.
    names, units: of each number, for plots and reports.
    relative: numbers predicted relative to the state's number at the same place; the others are absolute.
    angles: number → centre in radians; what is predicted lies within π of the centre, so that it does not jump by 2π.
    binary: numbers that are commanded as −1 or 1 and nothing between.
    horizon: h; actions of a chunk. execute: how many of them are executed before the policy is asked again.
    frames: camera frames an action takes; None where an action is one planned motion of any length.
    """

    width: int
    key: tuple[str, ...] = ()
    space: str | None = None
    names: tuple[str, ...] = ()
    units: tuple[str, ...] = ()
    relative: tuple[int, ...] = ()
    angles: Mapping[int, float] = field(default_factory=dict)
    binary: tuple[int, ...] = ()
    horizon: int = 20
    execute: int = 16
    frames: int | None = 1

    @classmethod
    def from_dict(cls, given: Any, state_width: int) -> Self:
        """Read the section `embodiment.action`.

        Raises:
            UserError: an unknown or missing key, or a value that cannot be.
        """
        where = "embodiment.action"
        found = section_keys(given, where, _KEYS, required=("width",))
        width = fields.whole(found["width"], f"{where}.width")
        horizon = fields.whole(found.get("horizon", 20), f"{where}.horizon")
        execute = fields.whole(found.get("execute", min(16, horizon)), f"{where}.execute")
        if execute > horizon:
            raise UserError(f"{where}.execute={execute}: a chunk has {horizon} actions (horizon); execute fewer.")
        frames = found.get("frames", 1)
        if frames not in (1, None):
            raise UserError(f"{where}.frames={brief(frames)}: expected 1; null if an action is one planned motion.")
        return cls(
            width=width,
            key=fields.columns(found.get("key"), f"{where}.key"),
            space=None if found.get("space") is None else str(found["space"]),
            names=fields.words(found.get("names"), f"{where}.names", width, [f"number {i + 1}" for i in range(width)]),
            units=fields.words(found.get("units"), f"{where}.units", width, [""] * width),
            relative=fields.places(found.get("relative"), f"{where}.relative", min(width, state_width)),
            angles=fields.centres(found.get("angles"), f"{where}.angles", width),
            binary=fields.places(found.get("binary"), f"{where}.binary", width),
            horizon=horizon,
            execute=execute,
            frames=frames,
        )

    def to_dict(self) -> dict[str, Any]:
        """The section that `from_dict` reads, fit for JSON."""
        listed = {name: list(getattr(self, name)) for name in ("key", "names", "units", "relative", "binary")}
        plain = {name: getattr(self, name) for name in ("space", "width", "horizon", "execute", "frames")}
        return {**plain, **listed, "angles": {str(place): centre for place, centre in self.angles.items()}}

    def to_relative(self, actions: "Tensor", state: "Tensor") -> "Tensor":
        """Express a chunk as it is predicted: relative to one state, the same reference for all its steps.

        Args:
            actions: [..., h, w] as recorded. state: [..., s] when the chunk begins.

        Returns:
            [..., h, w].
        """
        out = actions.clone()
        if self.relative:
            places = list(self.relative)
            out[..., places] -= state[..., None, places].to(actions)
        for place, centre in self.angles.items():
            out[..., place] = (out[..., place] - centre + math.pi).remainder(2 * math.pi) - math.pi + centre
        return out

    def to_absolute(self, predicted: "Tensor", state: "Tensor") -> "Tensor":
        """Turn what is predicted into commands: the inverse of `to_relative`, up to whole turns of angles."""
        out = predicted.clone()
        if self.relative:
            places = list(self.relative)
            out[..., places] += state[..., None, places].to(predicted)
        if self.binary:
            places = list(self.binary)
            out[..., places] = 1.0 - 2.0 * (out[..., places] < 0).to(out)
        return out
