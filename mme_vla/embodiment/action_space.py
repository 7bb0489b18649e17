"""`ActionSpace`: what the numbers of an action mean, as recorded, as predicted and as commanded."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from string import ascii_lowercase
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from mme_vla.config.sections import section_keys
from mme_vla.errors import UserError, brief, check_integer, require

if TYPE_CHECKING:
    from torch import Tensor


def columns(value: Any, where: str) -> tuple[str, ...]:
    """One column of a dataset or several to be joined; none where the usual names are meant."""
    names = [] if value is None else [value] if isinstance(value, str) else value
    require(
        isinstance(names, Sequence) and all(isinstance(name, str) and name for name in names),
        f"{where} must be a column of the dataset or a list of columns, got {brief(value)}.",
    )
    return tuple(names)


def column_indices(value: Any, where: str, width: int) -> tuple[int, ...]:
    """Places of numbers in a vector of `width`, each once, counted from 0."""
    numbers = [] if value is None else list(value) if isinstance(value, Sequence) else [value]
    require(
        all(isinstance(i, int) and not isinstance(i, bool) and 0 <= i < width for i in numbers),
        f"{where} must list numbers from 0 to {width - 1}, got {brief(value)}.",
    )
    require(len(set(numbers)) >= len(numbers), f"{where}={brief(value)} names a number twice.")
    return tuple(sorted(numbers))


def centres(value: Any, where: str, width: int) -> dict[int, float]:
    """A centre in radians for some numbers of a vector; keys may be texts, as JSON writes them."""
    mapping = {} if value is None else value
    try:
        read = {int(place): float(centre) for place, centre in mapping.items()}
        if not all(map(math.isfinite, read.values())):
            raise ValueError
    except (AttributeError, TypeError, ValueError, OverflowError):
        raise UserError(
            f"{where} must be a map such as {{3: 3.14}}, number to centre, got {brief(value)}."
        ) from None
    column_indices(list(read), where, width)
    return read


def words(value: Any, where: str, width: int, default: Sequence[str]) -> tuple[str, ...]:
    """One text for each of `width` numbers."""
    texts = list(default) if value is None else value
    require(
        not isinstance(texts, str) and isinstance(texts, Sequence) and len(texts) == width,
        f"{where} must hold {width} texts, one a number, got {brief(value)}.",
    )
    return tuple(map(str, texts))


Place = tuple[float, float]
MOST_WORDS = 400  # characters of an option
MIDDLE: Place = (0.5, 0.5)
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


def read_options(value: Any, letters: int) -> tuple[Option, ...]:
    """Options as the benchmark gives them: a list of `label`, `action` and `need_parameter`.

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
    options = []
    for option in value:
        right = isinstance(option, Mapping) and isinstance(option.get("action"), str)
        label = str(option.get("label")).strip().lower() if right else ""
        needs = option.get("need_parameter", False) if right else None
        wordy = right and len(option["action"]) > MOST_WORDS
        if not (len(label) == 1 and label in known and not wordy and isinstance(needs, bool)):
            raise UserError(f"The option {brief(option)} cannot be chosen; expected {expected}.")
        options.append(
            Option(
                label,
                " ".join(option["action"].split()),
                needs,
                option.get("possible", True) is True,
            )
        )
    require(
        len({option.label for option in options}) >= len(options),
        f"The options {brief(value)} have a letter twice.",
    )
    require(
        any(option.possible for option in options),
        f"None of the options {brief(value)} is possible.",
    )
    return tuple(options)


def in_words(options: Sequence[Option]) -> str:
    """The options as a prompt lists them: `a pick up the cube (point), b press the button`."""
    return ", ".join(f"{o.label} {o.action}{' (point)' * o.needs_point}" for o in options)


POSE_WIDTH = 6
"""Of a pose: position, then three angles."""
ANGLES = (3, 4, 5)
"""The angles' places in it."""
DELTA = "ee_delta"
_KEYS = (
    "key",
    "space",
    "width",
    "names",
    "units",
    "relative",
    "angles",
    "binary",
    "horizon",
    "execute",
    "frames",
    "choice",
    "point",
    "options_length",
    "of_pose",
    "pose_key",
)


@dataclass(frozen=True)
class ActionSpace:
    """The actions of a policy.

    width: w; numbers of an action. key: columns of the dataset that hold them, joined; empty for
    the usual names. space: the benchmark's action space that takes them; None for a robot that is
    not the benchmark's. names, units: of each number, for plots and reports. Without names a
    dataset's are taken (`with_names`). relative: numbers predicted relative to the state's number
    at the same place; the others are absolute. angles: number → centre in radians; what is
    predicted lies within π of the centre, so that it does not jump by 2π. binary: numbers that are
    commanded as −1 or 1 and nothing between. horizon: h; actions of a chunk. execute: how many of
    them are executed before the policy is asked again. frames: camera frames an action takes; None
    where an action is one planned motion of any length. choice: numbers of which one is 1 and the
    others 0, the letters a, b, … of the options that an episode offers; what
        is predicted are scores, and `decide` takes the best that is offered. Normalised as [0, 1],
        never by statistics.
    point: the two numbers of a point in the memory camera's image: y and x as shares of its height
    and width. of_pose: numbers that are differences to the tool's pose at their own step, i. e. to
    the pose's number at the same
        place, angles (from the fourth on) by the shorter way: recorded, predicted and sent as such.
            Who executes an
        action adds the pose of that moment (`beside_pose`). Past a recording's end they are 0.
    pose_key: columns of the dataset that hold that pose.
    options_length: tokens that the prompt has for the options, beside the processor's
    `prompt_length`.
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
    choice: tuple[int, ...] = ()
    point: tuple[int, ...] = ()
    options_length: int = 0
    of_pose: tuple[int, ...] = ()
    pose_key: tuple[str, ...] = ()

    @classmethod
    def from_dict(cls, section: Any, state_width: int) -> Self:
        """Read the section `embodiment.action`."""
        where = "embodiment.action"
        values = section_keys(section, where, _KEYS, required=("width",))
        width = check_integer(f"{where}.width", values["width"])
        horizon = check_integer(f"{where}.horizon", values.get("horizon", 20))
        execute = check_integer(f"{where}.execute", values.get("execute", min(16, horizon)))
        require(
            execute <= horizon,
            f"{where}.execute={execute}: a chunk has {horizon} actions (horizon); execute fewer.",
        )
        frames = values.get("frames", 1)
        require(
            frames in (1, None),
            f"{where}.frames={brief(frames)}: expected 1; null if an action is one planned motion.",
        )
        choice, point, length = _choices(values, where, width)
        return cls(
            width=width,
            key=columns(values.get("key"), f"{where}.key"),
            space=None if values.get("space") is None else str(values["space"]),
            names=words(values.get("names"), f"{where}.names", width, numbered(width)),
            units=words(values.get("units"), f"{where}.units", width, [""] * width),
            relative=column_indices(
                values.get("relative"), f"{where}.relative", min(width, state_width)
            ),
            angles=centres(values.get("angles"), f"{where}.angles", width),
            binary=column_indices(values.get("binary"), f"{where}.binary", width),
            horizon=horizon,
            execute=execute,
            frames=frames,
            choice=choice,
            point=point,
            options_length=length,
            of_pose=_of_pose(values, where, width),
            pose_key=columns(values.get("pose_key"), f"{where}.pose_key"),
        )

    def to_dict(self) -> dict[str, Any]:
        """The section that `from_dict` reads, fit for JSON."""
        listed = {
            name: list(getattr(self, name))
            for name in ("key", "names", "units", "relative", "binary")
        }
        scalars = {
            name: getattr(self, name) for name in ("space", "width", "horizon", "execute", "frames")
        }
        choices = {
            "choice": list(self.choice),
            "point": list(self.point),
            "options_length": self.options_length,
        }
        posed = {"of_pose": list(self.of_pose), "pose_key": list(self.pose_key)}
        return {
            **scalars,
            **listed,
            "angles": {str(place): centre for place, centre in self.angles.items()},
            **(choices if self.choice else {}),  # absent in files of earlier versions
            **(posed if self.of_pose else {}),  # likewise
        }

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
            actions: [..., h, w] as recorded. state: [..., s] when the chunk begins.

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
        """The goal as the policy reads it: where it chooses among options, they stand behind it."""
        if not self.choice:
            return goal
        _require(options)
        return f"{goal.rstrip(' .')}. Options: {in_words(options)}"

    def decide(self, actions: "Tensor", options: Sequence[Option]) -> "Tensor":
        """Turn the scores of letters into choices: the best of those offered is 1, all others are
        0.

        Args:
            actions: [..., w] absolute. options: what the episode offers.

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


def _require(options: Sequence[Option]) -> None:
    require(
        options,
        "This policy chooses among options, and the episode offers none: set episode.options. The "
        "benchmark's are info['available_multi_choices'] of the action space multi_choice.",
    )


def _of_pose(values: Mapping[str, Any], where: str, width: int) -> tuple[int, ...]:
    """`of_pose`, which needs poses to differ from, and steps that have one."""
    places = column_indices(values.get("of_pose"), f"{where}.of_pose", min(width, POSE_WIDTH))
    if places and (
        not values.get("pose_key") or values.get("frames", 1) is None or values.get("relative")
    ):
        raise UserError(
            f"{where}.of_pose={list(places)}: name the columns of the tool's pose (pose_key), one"
            " action a frame (frames=1), and nothing relative to the state besides (relative=[])."
        )
    return places


def _choices(
    values: Mapping[str, Any], where: str, width: int
) -> tuple[tuple[int, ...], tuple[int, ...], int]:
    """`choice`, `point` and `options_length`."""
    choice = column_indices(values.get("choice"), f"{where}.choice", width)
    point = column_indices(values.get("point"), f"{where}.point", width)
    if len(point) not in (0, 2) or set(point) & set(choice) or (point and not choice):
        raise UserError(
            f"{where}.point={brief(values.get('point'))}: expected the two numbers y, x beside the"
            " choice's."
        )
    require(
        len(choice) <= len(ascii_lowercase)
        and (not (choice and values.get("frames", 1) is not None)),
        f"{where}.choice: at most {len(ascii_lowercase)} letters, each a motion of any length:"
        " frames=null.",
    )
    length = values.get("options_length", 0)
    return choice, point, check_integer(f"{where}.options_length", length) if length else 0
