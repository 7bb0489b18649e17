"""What disturbs an episode: what is shown of it, what memory holds of it, what the robot executes.

Three options take perturbations, all by the same names and numbers (`pause:64`), and each calls the
hooks that it can serve:

- `data.history_transforms`: training, on recorded episodes (`repeats`, `perturb`);
- `event`: a rollout, in the simulation (`hold`, `act`, and `repeats` of the conditioning video);
- `with`: a probe, on what a policy observes, remembers and is told (`repeats`, `show`, `renews`,
  `n_sessions`, `shows_video`, `perturb`, `only`, `edit`, `say`, `instruct`).

One of your own is a class registered with `register("perturbation", name)` in a module that
`plugins` names.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, is_dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, NamedTuple

import numpy as np

from mme_vla.config.sections import NonNegative, NonNegativeInt, Range, read_section, without
from mme_vla.errors import check_choice, counted, require
from mme_vla.registry import PERTURBATIONS

if TYPE_CHECKING:
    from torch import Tensor

Share = Annotated[float, Range(0.0, 1.0)]


class Perturbation:
    """Changes nothing. A subclass overrides what it changes. It is a dataclass, so that its options
    are its fields.

    dial: the option that `name:value` sets.
    neutral: its value without effect, at which a curve has the plain run.
    drops: whether `repeats` may leave frames out.
    needs: what else a probe must have for it, such as `recordings`.
    shows_video: whether the conditioning video is shown.
    renews: whether the policy begins an episode anew at each decision, with what is shown of the
        frames so far.
    lag: frames before the shown ones that `show` needs too.
    """

    dial: ClassVar[str | None] = None
    neutral: ClassVar[float] = 0
    drops: ClassVar[bool] = False
    needs: ClassVar[frozenset[str]] = frozenset()
    shows_video: ClassVar[bool] = True
    renews: ClassVar[bool] = False

    @property
    def meaning(self) -> str:
        """What it does in a few plain words, as reports and progress show it: by default the first
        sentence of its class.
        """
        words = " ".join((type(self).__doc__ or "").split())
        return words.partition(". ")[0].rstrip(".")

    # What is shown

    @property
    def lag(self) -> int:
        return 0

    def show(self, frames: Any, moment: Any) -> Any:
        """Change the frames since the last decision as the policy observes them; with `renews`, all
        frames so far.

        Args:
            frames: what a probe collected, the current frame last.
            moment: what it knows of the current step.
        """
        return frames

    def repeats(
        self, length: int, exec_start: int, rng: np.random.Generator | None = None
    ) -> np.ndarray:
        """How often each of the first `length` frames is observed, int64 [length]; 0 leaves one
        out.

        Args:
            exec_start: the first execution frame, video included.
            rng: randomness for training; None for the reproducible choice of rollouts and probes,
                in which a frame's number depends on no later frame.
        """
        return np.ones(length, np.int64)

    @property
    def n_sessions(self) -> int:
        """How many unrelated recorded episodes are shown first."""
        return 0

    # What is executed

    @property
    def hold(self) -> int:
        """Control steps for which the robot holds its pose and the scene continues; the step limit
        grows by as many.
        """
        return 0

    @property
    def observed(self) -> int:
        """How many frames of `hold` the policy observes, the newest ones, at least one."""
        return self.hold

    def act(self, episode: Any) -> None:
        """Change the policy's running `Episode` where the event takes place."""

    def check(self, policy: Any) -> None:
        """Refuse a `Policy` to which this event cannot happen."""

    # What is remembered, and said

    def perturb(self, rows: "Tensor", rng: np.random.Generator | None = None) -> "Tensor":
        """Change tokens [n, d] of past frames, or their proprioception and actions, as they are
        read.
        """
        return rows

    def only(self, moment: Any) -> np.ndarray | None:
        """The stored frames that may be remembered, ascending, at least one; None for all.

        moment: what a probe knows of the current step.
        """
        return None

    def edit(self, store: Any, moment: Any) -> Any:
        """What is remembered instead of a store of entries, as a probe has them."""
        return store

    def say(self, subgoal: str | None, moment: Any) -> str | None:
        """The subgoal that the policy reads instead."""
        return subgoal

    def instruct(self, goal: str, moment: Any) -> str:
        """The goal that the policy reads instead."""
        return goal


TRAINING, ROLLOUT, PROBE = "data.history_transforms", "event", "with"  # options that take some
_HOOKS = {
    TRAINING: ("repeats", "perturb"),
    ROLLOUT: ("hold", "act", "repeats"),
    PROBE: (
        "repeats",
        "show",
        "renews",
        "n_sessions",
        "shows_video",
        "perturb",
        "only",
        "edit",
        "say",
        "instruct",
    ),
}


def overrides(kind: Any, *hooks: str) -> bool:
    """Whether a class of perturbations changes one of these hooks."""
    return any(getattr(kind, hook) is not getattr(Perturbation, hook) for hook in hooks)


# The perturbations of the core --------------------------------------------------------------------


@PERTURBATIONS.register("pause")
@PERTURBATIONS.register("repeat_frame")
@dataclass(frozen=True)
class Pause(Perturbation):
    """Time passes and nothing is decided.

    In a simulation the robot holds its pose for `frames` control steps, and the policy observes
    every frame of them. In a recording one frame is repeated `frames` times more.

    at: which frame, from the first execution frame on; None: any frame in training, the first of
        the execution in a probe.
    p: share of the training samples that have a pause; it has any length from one frame to
        `frames`.
    """

    frames: NonNegativeInt = 64
    at: NonNegativeInt | None = None
    p: Share = 1.0
    dial: ClassVar = "frames"

    @property
    def meaning(self) -> str:
        return f"time stands still for {counted(self.frames, 'frame')}"

    @property
    def hold(self) -> int:
        return self.frames

    def repeats(
        self, length: int, exec_start: int, rng: np.random.Generator | None = None
    ) -> np.ndarray:
        count = self.frames
        frame = exec_start + (self.at or 0)
        if rng is not None:
            has_pause = rng.random() < self.p
            if self.frames:
                count = int(rng.integers(1, self.frames + 1))
            if self.at is None:
                frame = int(rng.integers(length))
            if not has_pause:
                count = 0
        counts = np.ones(length, np.int64)
        if frame < length:
            counts[frame] += count
        return counts


@PERTURBATIONS.register("gap")
@dataclass(frozen=True)
class Gap(Perturbation):
    """The robot holds its pose, `frames` frames are not observed, and the policy decides at the
    next one.
    """

    frames: NonNegativeInt = 64
    dial: ClassVar = "frames"

    @property
    def meaning(self) -> str:
        return f"{self.frames} frames pass that the policy does not see"

    @property
    def hold(self) -> int:
        return self.frames + 1 if self.frames else 0

    @property
    def observed(self) -> int:
        return min(self.hold, 1)


@PERTURBATIONS.register("speed")
@dataclass(frozen=True)
class Speed(Perturbation):
    """The past seems to be `factor` times as fast; below 1 it is slower. In training by any factor
    between it and 1. As an event it changes the conditioning video alone.
    """

    factor: Annotated[float, Range(1 / 16, 16.0)] = 2.0
    dial: ClassVar = "factor"
    neutral: ClassVar = 1
    drops: ClassVar = True

    @property
    def meaning(self) -> str:
        return f"the past runs {self.factor:g} times as fast"

    def repeats(
        self, length: int, exec_start: int, rng: np.random.Generator | None = None
    ) -> np.ndarray:
        factor = self.factor if rng is None else self.factor ** rng.random()
        edges = np.floor(np.arange(length + 1) / factor).astype(np.int64)
        return np.diff(edges)


@PERTURBATIONS.register("drop_frames")
@dataclass(frozen=True)
class DropFrames(Perturbation):
    """A `share` of the frames is lost: at random in training, evenly spaced otherwise."""

    share: Share = 0.25
    dial: ClassVar = "share"
    drops: ClassVar = True

    @property
    def meaning(self) -> str:
        return f"{100 * self.share:g} % of the frames are lost"

    def repeats(
        self, length: int, exec_start: int, rng: np.random.Generator | None = None
    ) -> np.ndarray:
        if rng is not None:
            return (rng.random(length) >= self.share).astype(np.int64)
        n_dropped = np.floor(np.arange(length + 1) * self.share)  # of the frames before each
        return 1 - np.diff(n_dropped).astype(np.int64)


@PERTURBATIONS.register("noise")
@dataclass(frozen=True)
class Noise(Perturbation):
    """Gaussian noise on what is read of the past; `std` is in standard deviations of the numbers
    that are read.
    """

    std: NonNegative = 0.1
    dial: ClassVar = "std"

    @property
    def meaning(self) -> str:
        return f"noise of {self.std:g} standard deviations on what is remembered"

    def perturb(self, rows: "Tensor", rng: np.random.Generator | None = None) -> "Tensor":
        import torch  # results read the names of perturbations without it

        if rows.numel() < 2:
            return rows
        if rng is None:
            rng = np.random.default_rng(0)
        noise = torch.from_numpy(rng.standard_normal(tuple(rows.shape), np.float32)).to(rows.device)
        return (rows + self.std * rows.float().std() * noise).to(rows.dtype)


@PERTURBATIONS.register("restart")
@dataclass(frozen=True)
class Restart(Perturbation):
    """The frame index restarts at 0: what is remembered keeps its content and its times, the clock
    begins anew.
    """

    @property
    def meaning(self) -> str:
        return "the frame number begins at 0 again"

    def act(self, episode: Any) -> None:
        episode.restart_clock()

    def check(self, policy: Any) -> None:
        policy.start_episode("").restart_clock()


# The grammar --------------------------------------------------------------------------------------

_NUMBER = r"-?(?:\d{1,15}(?:\.\d{0,15})?|\.\d{1,15})"
_WORD = re.compile(rf"([A-Za-z]\w*)(?::({_NUMBER}|all))?(?:@(\w+):(-?\d{{1,15}}))?", re.ASCII)


class Word(NamedTuple):
    """The parts of `pause:100@subtask:2`; what is not written is None, and so is the number
    `all`.
    """

    name: str
    has_value: bool
    value: float | int | None
    unit: str | None
    number: int | None


def split_word(text: str) -> Word | None:
    """The parts of one perturbation's text, known or not; None where it has another form."""
    match = _WORD.fullmatch(text)
    if match is None:
        return None
    name, digits, unit, place = match.groups()
    value: float | int | None = None
    if digits is not None and digits != "all":
        value = float(digits) if "." in digits else int(digits)
    number = None if place is None else int(place)
    return Word(name, digits is not None, value, unit, number)


def build_perturbation(section: Mapping[str, Any], option: str, key: str) -> Perturbation:
    """Build a perturbation from a mapping with `name` and its options.

    option: `TRAINING`, `ROLLOUT` or `PROBE`.
    key: of the value, for messages.

    Raises:
        UserError: an unknown name or option, or a perturbation that this option has no hook for.
    """
    name = section["name"]
    check_choice(f"{key}: name", name, PERTURBATIONS)
    kind: Any = PERTURBATIONS[name]
    require(
        isinstance(kind, type) and issubclass(kind, Perturbation),
        f"{key}: {name} must be a class that derives from mme_vla.Perturbation, and is {kind!r}.",
    )
    serving = [f"{other}=…" for other, hooks in _HOOKS.items() if overrides(kind, *hooks)]
    require(
        f"{option}=…" in serving or not serving,
        f"{key}: {name} changes nothing here; it belongs in {' or '.join(serving)}.",
    )
    has_checked_options = is_dataclass(kind)
    if not has_checked_options:
        built: Perturbation = PERTURBATIONS.build(section)
        return built
    where = f"{key}: {name}" if "=" in key else f"{key}.{name}"
    read: Perturbation = read_section(kind, without(section, "name"), where)
    return read


def build_word(word: Word, option: str, key: str) -> Perturbation:
    """Build a perturbation from `name` or `name:value`; see `build_perturbation`."""
    section: dict[str, Any] = {"name": word.name}
    if word.has_value:
        check_choice(f"{key}: name", word.name, PERTURBATIONS)
        dial = getattr(PERTURBATIONS[word.name], "dial", None)
        require(dial is not None, f"{key}: {word.name} takes no number.")
        section[str(dial)] = word.value
    return build_perturbation(section, option, key)


def build_transforms(entries: Any) -> tuple[Perturbation, ...]:
    """The perturbations that `data.history_transforms` lists, in the order in which they act."""
    if entries is None:
        return ()
    message = (
        f"history_transforms={entries}: write a list of names or of mappings with a name, such as"
        " [repeat_frame] or [{name: speed, factor: 2}]."
    )
    require(isinstance(entries, Sequence) and not isinstance(entries, str), message)
    transforms = []
    for entry in entries:
        section = {"name": entry} if isinstance(entry, str) else entry
        require(isinstance(section, Mapping) and "name" in section, message)
        transforms.append(build_perturbation(section, TRAINING, "history_transforms"))
    return tuple(transforms)
