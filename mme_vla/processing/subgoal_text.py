"""Which subgoal text a training step is shown: planner or online label, and noise on its point (paper, section 4.4)."""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from mme_vla.config.sections import read_section
from mme_vla.errors import UserError, did_you_mean

KINDS = ("simple_subgoal", "grounded_subgoal")
POINT = re.compile(r"at <(-?\d+), (-?\d+)>")
STD_PER_LIMIT = 1 / 2.5  # the noise's standard deviation, as a share of where it is cut off


@dataclass(frozen=True)
class SubgoalText:
    """Chooses the text of one training step, as released.

    kind: `simple_subgoal` or `grounded_subgoal`.
    online_probability: how often the label is the one the simulator reports at test time, which switches a little
        earlier than the planner's.
    point_noise: pixels; a text with exactly one point `at <y, x>` gets Gaussian noise on both numbers, cut off here
        and rounded. 0 adds none. The result may leave the image, as released.
    """

    kind: str
    online_probability: float = 0.5
    point_noise: int = 8

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise UserError(f"subgoal_text.kind={self.kind!r}. {did_you_mean(str(self.kind), KINDS)}")
        if not 0 <= self.online_probability <= 1:
            raise UserError(f"subgoal_text.online_probability={self.online_probability} must lie between 0 and 1.")
        if self.point_noise < 0:
            raise UserError(f"subgoal_text.point_noise={self.point_noise} must be a number of pixels, 0 for none.")

    @classmethod
    def from_config(cls, config: Mapping[str, Any] | None) -> Self | None:
        """Build from the section `subgoal_text`, or return None where there is none."""
        return None if config is None else read_section(cls, config, "subgoal_text")

    @property
    def columns(self) -> tuple[str, str]:
        """The dataset columns it reads."""
        return self.kind, f"{self.kind}_online"

    def __call__(self, texts: Mapping[str, str], rng: np.random.Generator) -> str:
        """Choose among a step's `texts`, by column name, and perturb the point."""
        planner, online = self.columns
        text = texts[online if rng.random() < self.online_probability else planner]
        return perturb_point(text, self.point_noise, rng) if self.point_noise else text


def perturb_point(text: str, limit: int, rng: np.random.Generator) -> str:
    """Move the one point of a text by up to `limit` pixels; a text with no point or several stays as it is."""
    if len(POINT.findall(text)) != 1:
        return text
    shift = np.clip(rng.normal(0, limit * STD_PER_LIMIT, 2), -limit, limit).round().astype(int)

    def moved(match: re.Match[str]) -> str:
        y, x = (int(match[i + 1]) + int(shift[i]) for i in range(2))
        return f"at <{y}, {x}>"

    return POINT.sub(moved, text)


def subgoal_kind(policy: Any) -> str | None:
    """`simple_subgoal` or `grounded_subgoal`, as the policy was trained; None where it reads none.

    Args:
        policy: anything with a policy's processor and configuration.
    """
    if not policy.require_processor().reads_subgoal:
        return None
    kind = (policy.config.get("subgoal_text") or {}).get("kind")
    return None if kind is None else str(kind)
