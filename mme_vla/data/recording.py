"""A recorded episode that a policy observes as it would a running one."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from mme_vla.data.episodes import EpisodeSource
from mme_vla.errors import brief, require
from mme_vla.policy.base import Policy
from mme_vla.policy.sections import PolicySections


@dataclass(frozen=True)
class Recording:
    """One episode of a dataset.

    action_offset: actions between a frame and the first one that is decided there
        (`data.action_offset`).
    """

    source: EpisodeSource
    episode: int
    action_offset: int = 0

    @property
    def length(self) -> int:
        return int(self.source.lengths[self.episode])

    @property
    def exec_start(self) -> int:
        """The first execution frame."""
        return int(self.source.exec_starts[self.episode])

    @property
    def name(self) -> str:
        return f"{self.source.name}/{self.episode}"

    @property
    def described(self) -> str:
        """Which episode of which dataset, and its goal."""
        goals = " → ".join(self.source.goals(self.episode))
        return f"episode {self.episode} of {self.source.name}: “{goals}”"

    def decisions(self, stride: int, most: int | None) -> list[int]:
        """Steps at which chunks are chosen: every `stride`-th at which the robot decides, `most` of
        them at most.
        """
        every = 1 if self.source.robot.action.frames is None else stride
        steps = np.asarray(self.source.decisions(self.episode))[::every]
        if most is not None and len(steps) > most:
            steps = steps[np.linspace(0, len(steps) - 1, most).round().astype(int)]
        return [int(step) for step in steps]

    def views(
        self, start: int, stop: int, required: np.ndarray | None, every_camera: bool = False
    ) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray] | None]:
        """Images of frames start … stop − 1 and where they stand, as `Episode.observe` takes them.

        required: frames that the memory camera shows beside the last, which all cameras do; None
            for every frame.
        every_camera: all cameras show the required frames.

        Raises:
            UserError: the robot reads depth, which a dataset has no columns for.
        """
        robot = self.source.robot
        require(
            not robot.readings,
            f"The robot {robot.name!r} reads {', '.join(robot.readings)}, and {self.name} holds"
            " images alone: a recorded episode cannot be shown to it.",
        )
        views, rendered = {}, {}
        for name in robot.camera_names:
            frames: np.ndarray = np.arange(start, stop)
            if required is not None:
                frames = np.array([stop - 1])
                if every_camera or name == robot.memory_camera:
                    inside = (required >= start) & (required < stop)
                    frames = np.union1d(required[inside], frames)
            views[name] = self.source.frames(self.episode, frames, name)
            rendered[name] = frames - start
        return views, None if required is None else rendered

    def show(
        self,
        running: Any,
        start: int,
        stop: int,
        required: np.ndarray | None = None,
        video: bool = False,
    ) -> None:
        """Observe frames start … stop − 1 in a running episode, which then offers the options that
        were recorded.

        required: as for `views`.
        video: all of it as if it were a conditioning video of that episode.
        """
        if stop <= start:
            return
        has_one_a_frame = self.source.robot.action.frames is not None
        begun = self.exec_start + 1
        if has_one_a_frame and not video and start < begun < stop:
            # No action of the robot led to the first frame of the execution, as after a reset.
            self.show(running, start, begun, required)
            self.show(running, begun, stop, required)
            return
        if not video:
            running.options = self.source.options(self.episode)
        frames = np.arange(start, stop)
        demo = np.ones(len(frames), bool) if video else frames < self.exec_start
        actions = None
        if not video and not has_one_a_frame:
            done = self.source.past_actions(self.episode, start - 1, self.length)
            actions = self.source.past_actions(self.episode, stop - 1, self.length)[len(done) :]
        elif not video and start >= begun:
            actions = self.source.actions(self.episode)[frames - 1 + self.action_offset]
        states = self.source.states(self.episode, start, stop)
        memory = running.policy.memory
        every_camera = memory is not None and memory.past_view_spec is not None
        views, rendered = self.views(start, stop, required, every_camera)
        running.observe(views, states, demo, actions, rendered=rendered)


def action_offset_of(policy: Policy) -> int:
    """The `data.action_offset` of a policy's training; 0 where its configuration has none."""
    offset = PolicySections.of(policy.config).data.get("action_offset", 0)
    require(
        type(offset) is int and 0 <= offset <= 1,
        f"The policy's configuration has data.action_offset={brief(offset)}; expected 0 or 1.",
    )
    return int(offset)
