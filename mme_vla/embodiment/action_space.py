"""`ActionSpace`: what the numbers of an action mean, as recorded, as predicted and as commanded."""

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from string import ascii_lowercase
from typing import TYPE_CHECKING, Annotated, Any, Self

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    StrictBool,
)
from pydantic.dataclasses import dataclass as checked_dataclass
from pydantic_core import PydanticUseDefault

from mme_vla.errors import LARGEST, UserError, brief, listed, require
from mme_vla.utils.validation import validated

if TYPE_CHECKING:
    from torch import Tensor

log = logging.getLogger(__name__)


def _as_list(value: Any) -> Any:
    """Take one entry without a list around it, and null for none."""
    if value is None:
        return ()
    return (value,) if isinstance(value, str | int | float) else value


def _use_default(value: Any) -> Any:
    if value is None:
        raise PydanticUseDefault
    return value


Size = Annotated[int, Field(strict=True, ge=1, le=LARGEST)]
"""Of a robot's vectors and chunks."""
Columns = Annotated[tuple[Annotated[str, Field(min_length=1)], ...], BeforeValidator(_as_list)]
"""One column of a dataset or several to be joined; none where the usual names are meant."""
Places = Annotated[
    tuple[Annotated[int, Field(strict=True)], ...],
    BeforeValidator(_as_list),
    AfterValidator(sorted),
    AfterValidator(tuple),
]
"""Places of numbers in a vector, each once, counted from 0, ascending."""
NullIsDefault = BeforeValidator(_use_default)
Point = tuple[float, float]
MOST_WORDS = 400  # characters of an option
MIDDLE: Point = (0.5, 0.5)
"""The point of a choice that needs none, as shares of the image's height and width."""


@dataclass(frozen=True)
class Option:
    """What can be chosen: its letter (`a`, `b`, …), what it does in words, and whether it needs a
    point.

    possible: whether the environment offers it now; it is listed in any case.
    """

    label: str
    action: str
    needs_point: bool = False
    possible: bool = True

    @property
    def number(self) -> int:
        """Which letter of the alphabet it has, from 0."""
        return ascii_lowercase.index(self.label)

    def to_dict(self) -> dict[str, Any]:
        """As the benchmark writes it in `available_multi_choices`."""
        return {"label": self.label, "action": self.action, "need_parameter": self.needs_point}


class _OptionRow(BaseModel):
    """An option as the benchmark writes it; other keys are ignored."""

    label: Annotated[str, BeforeValidator(lambda label: str(label).strip().lower())]
    action: Annotated[str, Field(max_length=MOST_WORDS)]
    need_parameter: StrictBool = False
    possible: Any = True


def read_options(value: Any, letters: int) -> tuple[Option, ...]:
    """Read options as the benchmark gives them: a list of `label`, `action`, `need_parameter`.

    Args:
        letters: how many there can be.
    """
    known = ascii_lowercase[:letters]
    expected = (
        f'a list of {{"label": "a", "action": "…", "need_parameter": false}}, labels {known[0]} to'
        f" {known[-1]}"
    )
    require(
        isinstance(value, Sequence) and not isinstance(value, str) and 1 <= len(value) <= letters,
        f"The options to choose from are {brief(value)}; expected {expected}.",
    )
    options: dict[str, Option] = {}
    for entry in value:
        try:
            row = validated(_OptionRow, entry, "The option")
            require(row.label in list(known), f"The label is {brief(row.label)}.")
        except UserError as error:
            raise UserError(
                f"The option {brief(entry)} cannot be chosen; expected {expected}. {error}"
            ) from None
        require(row.label not in options, f"The options {brief(value)} have a letter twice.")
        action = " ".join(row.action.split())
        options[row.label] = Option(row.label, action, row.need_parameter, row.possible is True)
    require(
        any(option.possible for option in options.values()),
        f"None of the options {brief(value)} is possible.",
    )
    return tuple(options.values())


POSE_WIDTH = 6
"""Of a pose: position, then three angles."""
ANGLES = (3, 4, 5)
"""The angles' places in it."""
DELTA = "ee_delta"


@checked_dataclass(frozen=True, config=ConfigDict(extra="forbid"))
class ActionSpace:
    """The actions of a policy.

    width: w; numbers of an action.
    key: columns of the dataset that hold them, joined; empty for the usual names.
    space: the benchmark's action space that takes them; None for a robot that is not the
        benchmark's.
    names, units: of each number, for plots and reports. Without names a dataset's are taken
        (`with_names`).
    relative: numbers predicted relative to the state's number at the same place; the others are
        absolute.
    angles: number → centre in radians. What is predicted lies within π of the centre, so that it
        does not jump by 2π.
    binary: numbers that are commanded as −1 or 1 and nothing between.
    horizon: h; actions of a chunk.
    execute: how many of them are executed before the policy is asked again.
    frames: camera frames an action takes; None where an action is one planned motion of any length.
    choice: numbers of which one is 1 and the others 0, the letters a, b, … of the options that an
        episode offers. Scores are predicted, and `decide` takes the best that is offered.
        Normalised as [0, 1], never by statistics.
    point: the two numbers of a point in the memory camera's image: y and x as shares of its height
        and width.
    options_length: tokens that the prompt has for the options, beside the processor's
        `prompt_length`.
    pose_key: columns of the dataset that hold the tool's pose.
    of_pose: numbers that are differences to the tool's pose at their own step, i. e. to the pose's
        number at the same place, angles (from the fourth on) by the shorter way: recorded,
        predicted and sent as such. Who executes an action adds the pose of that moment
        (`beside_pose`). Past a recording's end they are 0.
    """

    width: Size
    key: Columns = ()
    space: str | None = None
    names: Annotated[tuple[str, ...], NullIsDefault] = Field(
        default_factory=lambda fields: numbered(fields["width"])
    )
    units: Annotated[tuple[str, ...], NullIsDefault] = Field(
        default_factory=lambda fields: ("",) * fields["width"]
    )
    relative: Places = ()
    angles: Annotated[dict[int, Annotated[float, Field(allow_inf_nan=False)]], NullIsDefault] = (
        Field(default_factory=dict)
    )
    binary: Places = ()
    horizon: Size = 20
    execute: Annotated[Size, NullIsDefault] = Field(
        default_factory=lambda fields: min(16, fields["horizon"])
    )
    frames: int | None = 1
    choice: Places = ()
    point: Places = ()
    options_length: Annotated[int, Field(strict=True, ge=0, le=LARGEST), NullIsDefault] = 0
    of_pose: Places = ()
    pose_key: Columns = ()

    @classmethod
    def from_dict(cls, section: Any, state_width: int) -> Self:
        """Read the section `embodiment.action`.

        Raises:
            UserError: a value that cannot be, by its key.
        """
        where = "embodiment.action"
        space = validated(cls, section, where, where)
        limits = dict.fromkeys(("angles", "binary", "choice", "point"), space.width)
        limits["relative"] = min(space.width, state_width)
        limits["of_pose"] = min(space.width, POSE_WIDTH)
        for key, limit in limits.items():
            places = list(getattr(space, key))
            require(
                all(0 <= place < limit for place in places),
                f"{where}.{key} must list numbers from 0 to {limit - 1}, got {brief(places)}.",
            )
            require(
                len(set(places)) == len(places),
                f"{where}.{key}={brief(places)} names a number twice.",
            )
        for key in ("names", "units"):
            texts = list(getattr(space, key))
            require(
                len(texts) == space.width,
                f"{where}.{key} must hold {space.width} texts, one a number, got {brief(texts)}.",
            )
        require(
            space.execute <= space.horizon,
            f"{where}.execute={space.execute}: a chunk has {space.horizon} actions (horizon);"
            " execute fewer.",
        )
        require(
            space.frames in (1, None),
            f"{where}.frames={space.frames}: expected 1; null if an action is one planned motion.",
        )
        letters = len(ascii_lowercase)
        require(
            not space.choice or (len(space.choice) <= letters and space.frames is None),
            f"{where}.choice: at most {letters} letters, each a motion of any length: frames=null.",
        )
        is_point = len(space.point) == 2 and bool(space.choice)
        require(
            not space.point or (is_point and not set(space.point) & set(space.choice)),
            f"{where}.point={list(space.point)}: expected the two numbers y, x beside the"
            " choice's.",
        )
        has_poses = bool(space.pose_key) and space.frames == 1 and not space.relative
        require(
            not space.of_pose or has_poses,
            f"{where}.of_pose={list(space.of_pose)}: name the columns of the tool's pose"
            " (pose_key), one action a frame (frames=1), and nothing relative to the state besides"
            " (relative=[]).",
        )
        return space

    def to_dict(self) -> dict[str, Any]:
        """Return the section that `from_dict` reads, fit for JSON."""
        section: dict[str, Any] = {
            "space": self.space,
            "width": self.width,
            "horizon": self.horizon,
            "execute": self.execute,
            "frames": self.frames,
            "key": list(self.key),
            "names": list(self.names),
            "units": list(self.units),
            "relative": list(self.relative),
            "binary": list(self.binary),
            "angles": {str(place): centre for place, centre in self.angles.items()},
        }
        # Keys that a robot does not need are absent.
        if self.choice:
            section |= {
                "choice": list(self.choice),
                "point": list(self.point),
                "options_length": self.options_length,
            }
        if self.of_pose:
            section |= {"of_pose": list(self.of_pose), "pose_key": list(self.pose_key)}
        return section

    def with_names(self, names: Sequence[str]) -> Self:
        """The same space with a dataset's names of the numbers, where it has none of its own."""
        if len(names) != self.width or self.names != numbered(self.width):
            return self
        return replace(self, names=tuple(names))

    @property
    def answers(self) -> str | None:
        """What clients call this action space: the benchmark's name, or `ee_delta` for differences
        to poses.
        """
        return DELTA if self.of_pose else self.space

    def from_poses(self, actions: np.ndarray, poses: np.ndarray) -> np.ndarray:
        """Recorded actions [t, w] as differences to the poses [t, 6] of their own steps, where they
        are such.
        """
        out = np.array(actions, np.float64)
        for place in self.of_pose:
            out[:, place] -= poses[:, place]
            if place in ANGLES:
                out[:, place] = math.pi - (math.pi - out[:, place]) % (2 * math.pi)  # into (−π, π]
        return out.astype(np.float32)

    def beside_pose(self, action: np.ndarray, pose: np.ndarray) -> np.ndarray:
        """The command [w] that an action [w] is where the tool stands at a pose [6] now."""
        out = np.array(action, np.float64)
        out[list(self.of_pose)] += np.asarray(pose, np.float64)[list(self.of_pose)]
        return out

    def to_relative(self, actions: "Tensor", state: "Tensor") -> "Tensor":
        """Express a chunk as it is predicted: relative to one state, the same reference for all its
        steps.

        Args:
            actions: [..., h, w] as recorded.
            state: [..., s] when the chunk begins.

        Returns:
            [..., h, w].
        """
        out = actions.clone()
        if self.relative:
            places = list(self.relative)
            out[..., places] -= state[..., None, places].to(actions)
        for place, centre in self.angles.items():
            out[..., place] = (
                (out[..., place] - centre + math.pi).remainder(2 * math.pi) - math.pi + centre
            )
        return out

    def to_absolute(self, predicted: "Tensor", state: "Tensor") -> "Tensor":
        """Turn what is predicted into commands: the inverse of `to_relative`, up to whole turns of
        angles.
        """
        out = predicted.clone()
        if self.relative:
            places = list(self.relative)
            out[..., places] += state[..., None, places].to(predicted)
        if self.binary:
            places = list(self.binary)
            out[..., places] = 1.0 - 2.0 * (out[..., places] < 0).to(out)
        return out

    def worded(self, goal: str, options: Sequence[Option]) -> str:
        """The goal as the policy reads it. Where it chooses among options, they stand behind it:
        `Options: a pick up the cube (point), b press the button`.
        """
        if not self.choice:
            return goal
        _require(options)
        texts = []
        for option in options:
            text = f"{option.label} {option.action}"
            if option.needs_point:
                text += " (point)"
            texts.append(text)
        return f"{goal.rstrip(' .')}. Options: {', '.join(texts)}"

    def decide(self, actions: "Tensor", options: Sequence[Option]) -> "Tensor":
        """Turn the scores of letters into choices: the best of those offered is 1, all others are
        0.

        Args:
            actions: [..., w] absolute.
            options: what the episode offers.

        Returns:
            [..., w], the point within the image; `actions` themselves where nothing is chosen.
        """
        if not self.choice:
            return actions
        _require(options)
        out = actions.clone()
        offered = [self.choice[option.number] for option in options if option.possible]
        best = actions[..., offered].argmax(-1, keepdim=True)
        out[..., list(self.choice)] = 0
        out[..., offered] = out[..., offered].scatter(-1, best, 1)
        out[..., list(self.point)] = out[..., list(self.point)].clamp(0, 1)
        return out


def numbered(width: int) -> tuple[str, ...]:
    """Names for numbers that have none."""
    return tuple(f"number {i + 1}" for i in range(width))


def named_alike(name: str) -> str:
    """A number's name as names are compared: `Joint_1` is `joint 1`."""
    return "".join(letter for letter in name.casefold() if letter.isalnum())


def compare_names(
    first: Sequence[str],
    second: Sequence[str],
    what: str,
    of_first: str,
    of_second: str,
    same_place: str,
) -> None:
    """Compare the names of the same numbers in two places; empty or `numbered` where one has none.

    Raises:
        UserError: the same names in another order: numbers would be exchanged.
    """
    unnamed = ((), numbered(len(first)))
    if tuple(first) in unnamed or tuple(second) in unnamed:
        return
    compared_first = [named_alike(name) for name in first]
    compared_second = [named_alike(name) for name in second]
    if compared_first == compared_second:
        return
    both = f"{of_first}: {listed(first, 24)}; {of_second}: {listed(second, 24)}"
    if sorted(compared_first) == sorted(compared_second):
        raise UserError(
            f"The numbers of the {what} have the same names in another order. {both}. {same_place}"
        )
    log.warning("The numbers of the %s have different names. %s.", what, both)


def _require(options: Sequence[Option]) -> None:
    require(
        options,
        "This policy chooses among options, and the episode offers none: set episode.options. The "
        "benchmark's are info['available_multi_choices'] of the action space multi_choice.",
    )
