"""Sizes as rows of a table: `pi05` is the real model, `tiny` a first-class citizen that trains on a laptop's CPU."""

from collections.abc import Mapping
from dataclasses import MISSING, dataclass, field, fields, is_dataclass
from typing import Any, Self

from mme_vla.errors import UserError, brief, did_you_mean


class Sizes:
    """Builds itself from a plain mapping and refuses keys it does not know."""

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> Self:
        known = {f.name: f for f in fields(cls)}  # type: ignore[arg-type]
        unknown = [key for key in values if key not in known]
        if unknown:
            raise UserError(f"{cls.__name__} has no key {brief(unknown[0])}. {did_you_mean(brief(unknown[0]), known)}")
        built: dict[str, Any] = {}
        for key, value in values.items():
            kind = known[key].type
            nested = isinstance(kind, type) and is_dataclass(kind)
            fits = isinstance(value, (Mapping, kind) if nested else kind)  # type: ignore[arg-type]
            if not fits or (isinstance(value, bool) and kind is not bool):
                names = {int: "a whole number", bool: "true or false"}
                wanted = "a section" if nested else names.get(kind, "text")  # type: ignore[call-overload]
                raise UserError(f"{cls.__name__}.{key} must be {wanted}, not {brief(value)}.")
            built[key] = kind.from_dict(value) if nested and isinstance(value, Mapping) else value  # type: ignore[union-attr]
        needed = [name for name, f in known.items() if f.default is MISSING and f.default_factory is MISSING]
        for name in needed:
            if name not in built:
                raise UserError(f"{cls.__name__} needs the key {name!r}.")
        return cls(**built)


LARGEST, DEEPEST = 2**24, 2**10
"""Bounds of every size and of layers: far above any network here, and a damaged file's number ends in words."""


def check_positive(config: Any, prefix: str) -> None:
    for name, value in vars(config).items():
        if isinstance(value, bool):
            continue
        if isinstance(value, int) and value < 1:
            raise UserError(f"{prefix}{name}={brief(value)} must be at least 1.")
        if isinstance(value, int) and value > (DEEPEST if name in ("depth", "horizon") else LARGEST):
            raise UserError(f"{prefix}{name}={brief(value)} is larger than any network can be.")


@dataclass(frozen=True)
class VisionConfig(Sizes):
    """SigLIP; its output width is the VLM's. `image_size` must be a multiple of `patch_size`."""

    image_size: int = 224
    patch_size: int = 14
    width: int = 1152
    depth: int = 27
    mlp_dim: int = 4304
    num_heads: int = 16

    def __post_init__(self) -> None:
        check_positive(self, "vision.")
        if self.image_size % self.patch_size:
            raise UserError(f"vision.image_size={self.image_size} must be a multiple of patch_size={self.patch_size}.")


@dataclass(frozen=True)
class ExpertConfig(Sizes):
    """One Gemma expert's own sizes; depth, heads and head width are shared by all (paper, section 4.1)."""

    width: int
    mlp_dim: int

    def __post_init__(self) -> None:
        check_positive(self, "an expert's ")


@dataclass(frozen=True)
class BackboneConfig(Sizes):
    """π0.5: a vision tower, a VLM expert and an action expert under joint attention."""

    vision: VisionConfig = field(default_factory=VisionConfig)
    vlm: ExpertConfig = field(default_factory=lambda: ExpertConfig(2048, 16384))
    action: ExpertConfig = field(default_factory=lambda: ExpertConfig(1024, 4096))
    depth: int = 18
    num_heads: int = 8
    num_kv_heads: int = 1
    head_dim: int = 256
    vocab_size: int = 257_152
    action_dim: int = 32
    horizon: int = 20
    time_distribution: str = "beta"  # `beta`: 0.001 + 0.999·Beta(1.5, 1), as released; `uniform`: the paper's text

    def __post_init__(self) -> None:
        check_positive(self, "backbone.")
        if self.num_heads % self.num_kv_heads:
            raise UserError(f"num_heads={self.num_heads} must be a multiple of num_kv_heads={self.num_kv_heads}.")
        if self.head_dim % 2:
            raise UserError(f"head_dim={self.head_dim} must be even: rotary embedding turns pairs.")
        if self.action.width % 2:
            raise UserError(f"action.width={self.action.width} must be even: the flow time is embedded in sin and cos.")
        if self.time_distribution not in ("beta", "uniform"):
            raise UserError(f"time_distribution={self.time_distribution!r}: choose 'beta' or 'uniform'.")
