"""Interventions on what a policy is sent: frames, states, goal, and whether its episode continues.

They need no way into its memory, so they reach a policy behind a server as well.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from mme_vla.config.sections import PositiveInt
from mme_vla.errors import counted
from mme_vla.extras.probing.interventions import Moment
from mme_vla.memory.perturbation import Perturbation
from mme_vla.policy.episode import Episode
from mme_vla.registry import PERTURBATIONS


@dataclass(frozen=True)
class Shown:
    """Frames as a policy observes them, the current one last.

    views: by camera, [t, H, W, 3] uint8.
    states: [t, s].
    demo: whether a frame is of the conditioning video, bool [t].
    numbers: which frame of the episode it is, int64 [t].
    actions: [t, w], each the one that led to its frame.
    led: bool [t], False where none did.
    motions: [n, w], actions that are motions of any length, in place of these.
    ends: int64 [n], the number of the last frame that came with each.
    before: by camera the images of the execution right before these, as many as the arm's `lag`,
        fewer at the beginning.
    start: the state [s] at the first execution frame, once it was observed.
    """

    views: Mapping[str, np.ndarray]
    states: np.ndarray
    demo: np.ndarray
    numbers: np.ndarray
    actions: np.ndarray
    led: np.ndarray
    motions: np.ndarray
    ends: np.ndarray
    before: Mapping[str, np.ndarray]
    start: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.states)

    def take(self, order: np.ndarray) -> "Shown":
        """These frames in another order: repeated, left out, exchanged. A motion stays with the
        frame at its end.
        """
        has_end = np.isin(self.ends, self.numbers[order])
        return replace(
            self,
            views={name: view[order] for name, view in self.views.items()},
            states=self.states[order],
            demo=self.demo[order],
            numbers=self.numbers[order],
            actions=self.actions[order],
            led=self.led[order],
            motions=self.motions[has_end],
            ends=self.ends[has_end],
        )

    def join(self, after: "Shown") -> "Shown":
        """These frames, then those."""
        views = {}
        for name, view in self.views.items():
            views[name] = np.concatenate([view, after.views[name]])
        return replace(
            self,
            views=views,
            states=np.concatenate([self.states, after.states]),
            demo=np.concatenate([self.demo, after.demo]),
            numbers=np.concatenate([self.numbers, after.numbers]),
            actions=np.concatenate([self.actions, after.actions]),
            led=np.concatenate([self.led, after.led]),
            motions=np.concatenate([self.motions, after.motions]),
            ends=np.concatenate([self.ends, after.ends]),
            start=after.start,
        )

    def observe_in(self, episode: Episode) -> None:
        """Show these frames in an episode of a policy."""
        # Frames that no action led to, then those that one did.
        first_led = len(self) - int(np.cumprod(self.led[::-1]).sum())
        for part, has_actions in ((slice(0, first_led), False), (slice(first_led, None), True)):
            states = self.states[part]
            if not len(states):
                continue
            actions = None
            if has_actions:
                actions = self.actions[part]
            elif len(self.motions):
                actions = self.motions
            views = {name: view[part] for name, view in self.views.items()}
            episode.observe(views, states, self.demo[part], actions)


@PERTURBATIONS.register("forget")
@dataclass(frozen=True)
class Forget(Perturbation):
    """The episode begins anew at each decision, with the current frame alone: nothing before it can
    be remembered.
    """

    renews: ClassVar = True
    needs: ClassVar = frozenset({"stream"})

    def show(self, frames: Shown, moment: Moment) -> Shown:
        executed = np.flatnonzero(~frames.demo)
        return replace(
            frames.take(executed[-1:]),
            # As after a reset, no action led to it.
            led=np.zeros(1, bool),
            motions=frames.motions[:0],
            ends=frames.ends[:0],
            before={name: view[executed[:-1]] for name, view in frames.views.items()},
        )


@PERTURBATIONS.register("replay")
@dataclass(frozen=True)
class Replay(Perturbation):
    """The episode begins anew at each decision, and all frames so far are shown again: what the
    policy kept of its own chunks is gone.
    """

    renews: ClassVar = True
    needs: ClassVar = frozenset({"stream"})


@PERTURBATIONS.register("shuffle_frames")
@dataclass(frozen=True)
class ShuffleFrames(Perturbation):
    """The images of past frames change places: those of the video, and those between two decisions.
    The current frame stays.
    """

    needs: ClassVar = frozenset({"stream"})

    def show(self, frames: Shown, moment: Moment) -> Shown:
        order = np.arange(len(frames))
        past = order[:-1]
        for places in (past[frames.demo[:-1]], past[~frames.demo[:-1]]):
            order[places] = moment.rng.permutation(places)
        views = {name: view[order] for name, view in frames.views.items()}
        return replace(frames, views=views)


@PERTURBATIONS.register("swap_frames")
@dataclass(frozen=True)
class SwapFrames(Perturbation):
    """The images of past frames are those of another recorded episode that is as far along; their
    number and times stay, and so does the current frame.
    """

    needs: ClassVar = frozenset({"stream", "recordings"})

    def show(self, frames: Shown, moment: Moment) -> Shown:
        donor = moment.donor_recording
        if donor is None or len(frames) < 2:
            return frames
        past = frames.numbers[:-1]
        n_video = moment.exec_start
        # Of the video the frame at the same share of its length, then as many steps in.
        of_video = past * donor.exec_start // max(n_video, 1)
        of_execution = np.minimum(donor.exec_start + past - n_video, donor.length - 1)
        numbers = np.where(past < n_video, of_video, of_execution)
        unique, places = np.unique(numbers, return_inverse=True)
        views = {}
        for name, view in frames.views.items():
            images = donor.source.frames(donor.episode, unique, name)[places]
            views[name] = np.concatenate([images, view[-1:]])
        return replace(frames, views=views)


@PERTURBATIONS.register("linger")
@dataclass(frozen=True)
class Linger(Perturbation):
    """The frame at which the policy decides is repeated `frames` times more: what only the last
    frames showed is no longer among them.
    """

    frames: PositiveInt = 16
    dial: ClassVar = "frames"
    needs: ClassVar = frozenset({"stream", "pauses"})

    @property
    def meaning(self) -> str:
        return f"the frame of the decision is repeated {counted(self.frames, 'more time')}"

    def show(self, frames: Shown, moment: Moment) -> Shown:
        last = len(frames) - 1
        return frames.take(np.append(np.arange(len(frames)), np.full(self.frames, last)))


@PERTURBATIONS.register("late")
@dataclass(frozen=True)
class Late(Perturbation):
    """The images of the execution arrive `frames` frames late, the current one too; states are on
    time.
    """

    frames: PositiveInt = 8
    dial: ClassVar = "frames"
    needs: ClassVar = frozenset({"stream"})

    @property
    def meaning(self) -> str:
        return f"the images of the execution arrive {counted(self.frames, 'frame')} late"

    @property
    def lag(self) -> int:
        return self.frames

    def show(self, frames: Shown, moment: Moment) -> Shown:
        views = {}
        for name, view in frames.views.items():
            known = np.concatenate([frames.before[name], view])
            now = np.arange(len(frames.before[name]), len(known))
            # Not before the first execution frame: the video is over by then.
            shown = np.maximum(now - self.frames, frames.demo.sum())
            shown = np.where(frames.demo, now, shown)
            views[name] = known[shown]
        return replace(frames, views=views)


@PERTURBATIONS.register("freeze_state")
@dataclass(frozen=True)
class FreezeState(Perturbation):
    """The robot's state stays what it was at the first execution frame."""

    needs: ClassVar = frozenset({"stream"})

    def show(self, frames: Shown, moment: Moment) -> Shown:
        if frames.start is None:
            return frames
        states = np.where(frames.demo[:, None], frames.states, frames.start)
        return replace(frames, states=states.astype(np.float32))


@PERTURBATIONS.register("goal_swap")
@dataclass(frozen=True)
class GoalSwap(Perturbation):
    """The goal is that of another recorded episode, one that reads alike and differs."""

    needs: ClassVar = frozenset({"goals"})

    def instruct(self, goal: str, moment: Moment) -> str:
        return goal if moment.donor_goal is None else moment.donor_goal
