"""The episode of a probed policy: its frames pass through a `Feed` on their way to the policy's own."""

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import numpy as np
from torch import Tensor

from mme_vla.errors import UserError
from mme_vla.evaluation.probe.arms import Arm
from mme_vla.evaluation.probe.recordings import Recording, stored_frames
from mme_vla.policy.base import Policy
from mme_vla.policy.episode import Episode, Host


class Prober(Host, Protocol):
    """What such an episode asks of the policy that began it."""

    inner: Policy
    arm: Arm
    sessions: list[Recording]

    @property
    def before(self) -> int: ...


class ProbedEpisode(Episode):
    """Shows `inner`, the policy's own episode, what the arm makes of the frames.

    recording: what is shown, where it is a recorded episode. exec_start: its first execution frame, once it is there.
    boundaries: frames, as they are shown, at which sub-tasks began, where that is known.
    said: the subgoals that were set at each chunk so far.
    """

    def __init__(self, prober: Prober, goal: str, seed: int = 0) -> None:
        super().__init__(prober, goal, seed)
        self._prober, self.seed = prober, seed
        self.inner = prober.inner.start_episode(goal, seed)
        self.recording: Recording | None = None
        self.exec_start: int | None = None
        self.boundaries: Sequence[int] = ()
        self.said: list[str | None] = []

    def observe(
        self,
        frames: Mapping[str, np.ndarray],
        states: np.ndarray,
        is_demo: bool | np.ndarray = False,
        actions: np.ndarray | None = None,
        drawn: Mapping[str, np.ndarray] | None = None,
    ) -> None:
        """Take frames as `Episode.observe` does."""
        self.inner.goal = self.goal
        feed, count = self._prober.arm.feed, len(states)
        demo = np.broadcast_to(np.asarray(is_demo, bool), (count,))
        video = int(demo.sum())
        if not self.frames_seen:
            self._show_sessions()
        if self.exec_start is None and video < count:
            self.exec_start = self.frames_seen + video
        given = _Frames(frames, np.asarray(states), demo, actions, drawn, self._robot.action.frames is None)
        if feed.video:
            given.show(self.inner, 0, video)
        held = -1 if self.exec_start is None else self.exec_start + feed.at - self.frames_seen
        if feed.stills and video <= held < count:
            given.show(self.inner, video, held + 1)
            given.hold(self.inner, held, feed.stills)
            video = held + 1
        given.show(self.inner, video, count)
        self.frames_seen += count

    def _show_sessions(self) -> None:
        stored, before = stored_frames(self._prober.inner, self._prober.before), 0
        for recording in self._prober.sessions:
            here = None if stored is None else stored[stored >= before] - before
            recording.show(self.inner, 0, recording.length, here, video=True)
            before += recording.length

    def told(self, subgoal: str | None) -> None:
        """Tell the policy's own episode what the arm made of the subgoal."""
        self.inner.subgoal = subgoal

    def begun(self, frames: Sequence[int], exec_start: int) -> None:
        """Note where sub-tasks began, the execution among them, as the frames are shown."""
        told = np.array(sorted({0, exec_start, *frames}), np.int64)
        shown = self._prober.arm.feed.shown(told, exec_start, self._prober.before)
        self.boundaries = [int(frame) for frame in shown if frame >= 0]

    @property
    def state(self) -> Tensor:
        return self.inner.state

    def acted(self, chunk: np.ndarray) -> None:
        self.inner.acted(chunk)

    def remember(
        self,
        frames: np.ndarray,
        is_demo: bool | np.ndarray = False,
        actions: np.ndarray | None = None,
        states: np.ndarray | None = None,
    ) -> None:
        """Not offered: an arm decides on whole observations."""
        raise UserError("A probed episode takes whole observations: observe(), not remember() and look().")

    def look(self, pictures: Mapping[str, np.ndarray], state: np.ndarray) -> None:
        """Not offered: an arm decides on whole observations."""
        raise UserError("A probed episode takes whole observations: observe(), not remember() and look().")


class _Frames:
    """What one `observe` was given, shown part by part."""

    def __init__(
        self,
        frames: Mapping[str, np.ndarray],
        states: np.ndarray,
        demo: np.ndarray,
        actions: np.ndarray | None,
        drawn: Mapping[str, np.ndarray] | None,
        motions: bool,
    ) -> None:
        self._frames, self._states, self._demo = frames, states, demo
        self._actions, self._drawn, self._motions = actions, drawn, motions
        self._video, self._told = int(demo.sum()), False

    def show(self, episode: Episode, start: int, stop: int) -> None:
        """Let an episode observe frames start … stop − 1."""
        if stop <= start:
            return
        views, drawn = self._views(start, stop)
        led = self._actions
        if led is not None and start >= self._video:
            led = led[:0] if self._motions and self._told else led
            led = led if self._motions else led[start - self._video : stop - self._video]
            self._told = True
        elif start < self._video:
            led = None
        episode.observe(views, self._states[start:stop], self._demo[start:stop], led, **drawn)

    def hold(self, episode: Episode, at: int, count: int) -> None:
        """Let an episode observe one frame `count` times more, holding the action that led to it."""
        views, drawn = self._views(at, at + 1)
        views = {name: np.repeat(view, count, 0) for name, view in views.items()}
        if drawn:
            drawn = {
                "drawn": {n: np.arange(count) if len(views[n]) else places for n, places in drawn["drawn"].items()}
            }
        led = self._actions
        if led is not None:
            led = led[:0] if self._motions else np.repeat(led[at - self._video : at - self._video + 1], count, 0)
        episode.observe(views, np.repeat(self._states[at : at + 1], count, 0), False, led, **drawn)

    def _views(self, start: int, stop: int) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        if self._drawn is None:
            return {name: view[start:stop] for name, view in self._frames.items()}, {}
        places = {name: np.asarray(at, np.int64) for name, at in self._drawn.items()}
        inside = {name: (at >= start) & (at < stop) for name, at in places.items()}
        views = {
            name: view[inside[name]] if name in inside else view[start:stop] for name, view in self._frames.items()
        }
        return views, {"drawn": {name: places[name][inside[name]] - start for name in places}}
