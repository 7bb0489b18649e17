"""One running episode: all streaming state lives here, never on the policy."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, Self, runtime_checkable

import numpy as np
import torch
from torch import Tensor

from mme_vla.embodiment import Embodiment, Option
from mme_vla.errors import UserError
from mme_vla.memory.base import past_view_spec, start_history, start_stream, uses_proprio
from mme_vla.memory.history import History, OnlineHistory
from mme_vla.policy.promises import ActionPrefix, checked_prefix
from mme_vla.processing.images import PastImages
from mme_vla.processing.normalise import check_reach, finite_array
from mme_vla.processing.prompt import checked_text
from mme_vla.types import HistoryTokens, PastViews

if TYPE_CHECKING:
    from mme_vla.memory.base import Memory
    from mme_vla.processing.base import PolicyProcessor


@dataclass(frozen=True)
class MemoryEntries:
    """One store of what was written.

    entries: (time, content) in the order they are read. now: the current moment, on the clock of these times.
    """

    name: str
    entries: tuple[tuple[int, Tensor], ...]
    now: int


@runtime_checkable
class WritableMemory(Protocol):
    """What such an episode offers; a probe asks for no more."""

    @property
    def memory_clock(self) -> str | None:
        """What the times of entries count (`moments`); None where entries have an order alone."""
        ...

    def writable_memory(self) -> tuple[MemoryEntries, ...]:
        """All stores."""
        ...

    def with_entries(self, stores: Sequence[Sequence[tuple[int, Tensor]]]) -> Self:
        """This episode with other entries in its stores, for one chunk; it stays as it is itself."""
        ...

    def resume_from(self, twin: "Episode") -> None:
        """Go on from a chunk that was chosen for an episode of `as_if_written`, with one's own entries."""
        ...


class Host(Protocol):
    """What an episode asks of its policy."""

    @property
    def memory(self) -> "Memory | None": ...

    @property
    def embodiment(self) -> Embodiment: ...

    def require_memory(self) -> "Memory": ...

    def require_processor(self) -> "PolicyProcessor": ...

    def encode_frames(self, frames: np.ndarray) -> Tensor: ...

    def sampling_noise(self, generator: torch.Generator) -> dict[str, Tensor]: ...


class Episode:
    """What the policy knows of one episode: goal, current view and state, and the history of past frames."""

    def __init__(self, policy: Host, goal: str, seed: int = 0) -> None:
        self._policy = policy
        self._generator = torch.Generator().manual_seed(seed)
        self._recent: list[tuple[Tensor | None, Tensor]] = []  # None: that frame was not drawn
        """Images and states of the frames that the policy sees at once, the current one last."""
        self._video_over = False
        self.goal = checked_text(goal, "the goal")
        self.subgoal: str | None = None
        """The current language subgoal, for policies whose prompt has one; set it before `act`."""
        self.options: tuple[Option, ...] = ()
        """What can be chosen, for policies that choose; set it before `act`."""
        memory = policy.memory
        self.history = None if memory is None else start_history(memory, policy.encode_frames)
        if self.history is not None and uses_proprio(memory):
            self.history.motion = lambda frames: torch.stack([self._motion_of_frames[int(frame)] for frame in frames])
            self.history.state_width = policy.embodiment.state.width
        self.stream = start_stream(memory)
        """What the memory carries from one `act` to the next, where it has something to carry."""
        self.read: History | None = None
        """The history as the last `act` read it, where a backbone marks what is stored."""
        spec = past_view_spec(memory)
        self._past = None if spec is None else PastImages(spec)
        self.n_observed_frames = 0
        self._motion_of_frames: list[Tensor] = []  # rows [w] of motion, one a frame, where the memory reads them
        self._chunk: np.ndarray | None = None
        self.action_prefix: ActionPrefix | None = None
        """What the next chunk is to agree with; see `promise`."""
        self._robot = policy.embodiment
        self._executed = self._no_actions

    def observe(
        self,
        frames: Mapping[str, np.ndarray],
        states: np.ndarray,
        is_demo: bool | np.ndarray = False,
        actions: np.ndarray | None = None,
        rendered: Mapping[str, np.ndarray] | None = None,
    ) -> None:
        """Take frames in order, each once, the current one last; the conditioning video comes first.

        Args:
            frames: of every camera by its name (`front` and `wrist`), each [t, H, W, 3] uint8.
            rendered: of every camera the places, ascending, among the t frames that `frames` shows, where not all were
                drawn. `act` needs the last one of every camera; of the others a memory needs what its `frames_read`
                names.
            states: [t, s].
            is_demo: whether the frames belong to the conditioning video; one bool, or [t].
            actions: [t, w] absolute actions that led to these frames. By default they are the first t of the last
                chunk, one action a frame; give them where something else was executed. Where an action is a motion of
                many frames, however many it were: [n, w].

        Raises:
            UserError: a missing camera, a wrong dtype or shape, or a video frame after execution has begun.
        """
        # Everything is checked before anything is remembered: after an error the same frames can be given again.
        views = {name: self._checked_view(frames, name) for name in self._robot.camera_names}
        states = finite_array(states, "states")
        demo = np.asarray(is_demo, bool)
        count, width = len(states) if states.ndim else 0, self._robot.state.width
        even = all(len(view) == (count if rendered is None else len(rendered[name])) for name, view in views.items())
        if states.shape != (count, width) or not even or demo.shape not in ((), (count,)):
            counts = ", ".join(f"{len(view)} {name}" for name, view in views.items())
            raise UserError(
                f"observe() needs as many {width}-number states and is_demo flags as images of every camera: got "
                f"{counts}, states of shape {states.shape} and is_demo of {demo.shape}."
            )
        if count == 0:
            return
        processor = self._policy.require_processor()
        check_reach(states, None if processor.stats is None else processor.stats.state, "a state")
        demo, executed = self._checked_course(count, demo, actions)
        # Of the frames that the window has room for, those of the execution; the current one in any case.
        recent = range(max(count - processor.window, 0) if processor.consecutive else count - 1, count)
        new_frames = [
            (self._prepared_images(views, rendered, i), torch.from_numpy(states[i].copy()))
            for i in recent
            if i == count - 1 or not demo[i]
        ]
        camera = self._robot.memory_camera
        rendered_at = None if rendered is None else np.asarray(rendered[camera], np.int64)
        self._take(views[camera], demo, executed, rendered_at, states)
        if self._past is not None:
            self._past.take(views, count, rendered)
        self._see(new_frames)

    def remember(
        self,
        frames: np.ndarray,
        is_demo: bool | np.ndarray = False,
        actions: np.ndarray | None = None,
        states: np.ndarray | None = None,
    ) -> None:
        """Take frames into memory alone, for a client that sends past frames and the current view apart.

        Followed by `look` at the last of them it is what `observe` does.

        Args:
            frames: of the memory camera, [t, H, W, 3] uint8, in order, each once.
            is_demo, actions: as for `observe`. states: [t, s]; only a memory of the robot's own motion needs them.

        Raises:
            UserError: a wrong dtype or shape, a video frame after execution has begun, a memory that needs states, or
                one that looks back at images of every camera.
        """
        self._check_apart()
        camera = self._robot.memory_camera
        frames = self._checked_view({camera: frames}, camera)
        demo = np.asarray(is_demo, bool)
        if demo.shape not in ((), (len(frames),)):
            raise UserError(f"is_demo must be one flag or {len(frames)}, one a frame; got {demo.shape}.")
        if states is not None and np.shape(states) != (len(frames), self._robot.state.width):
            raise UserError(f"states must be [{len(frames)}, {self._robot.state.width}]; got {list(np.shape(states))}.")
        if len(frames):
            proprio = None if states is None else finite_array(states, "states")
            self._take(frames, *self._checked_course(len(frames), demo, actions), states=proprio)

    def look(self, views: Mapping[str, np.ndarray], state: np.ndarray) -> None:
        """Set the current view and state, adding nothing to memory.

        Args:
            views: of every camera by its name, [H, W, 3] uint8.
            state: [s].

        Raises:
            UserError: images or a state of another form, or a memory that looks back at images of every camera.
        """
        self._check_apart()
        state = finite_array(state, "the state")
        width, names = self._robot.state.width, self._robot.camera_names
        if state.shape != (width,):
            raise UserError(f"look() needs a state of {width} finite numbers, got shape {state.shape}.")
        if lacking := [name for name in names if name not in views]:
            raise UserError(f"look() needs an image of {', '.join(lacking)} too; got {', '.join(views) or 'none'}.")
        processor = self._policy.require_processor()
        check_reach(state, None if processor.stats is None else processor.stats.state, "the state")
        images = processor.images([views[name] for name in names])
        self._see([(images, torch.from_numpy(state.copy()))])

    def _check_apart(self) -> None:
        if self._past is not None:
            raise UserError(
                "This policy's vision tower looks back at past images of every camera: give whole observations "
                "(`Episode.observe`), not past frames of one camera and the current view apart."
            )

    def _checked_course(
        self, count: int, demo: np.ndarray, actions: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Flags [count] of the next frames and the actions that led to the execution frames among them."""
        demo = np.broadcast_to(demo, (count,))
        if demo.any() and (self._video_over or (np.diff(demo.astype(int)) > 0).any()):
            raise UserError("A conditioning-video frame came after the first execution frame; the video goes first.")
        return demo, self._executed_now(int((~demo).sum()), actions)

    def _take(
        self,
        frames: np.ndarray,
        demo: np.ndarray,
        executed: np.ndarray,
        rendered: np.ndarray | None = None,
        states: np.ndarray | None = None,
    ) -> None:
        """Append checked frames to the history, and note what was executed."""
        if self.history is not None:
            motion = self._motion(demo, executed, states)
            self.history.take(frames, self._policy.encode_frames, rendered, len(demo))
            self._motion_of_frames += motion
            if not self._video_over:
                self.history.exec_start = self.n_observed_frames + int(demo.sum())
        longest = self._policy.require_processor().past_actions
        past = np.concatenate([self._executed, executed])
        self._executed = past[max(len(past) - longest, 0) :]
        self._chunk = None if self._chunk is None else self._chunk[int((~demo).sum()) :]
        self._video_over = self._video_over or not bool(demo[-1])
        self.n_observed_frames += len(demo)

    def _motion(self, demo: np.ndarray, executed: np.ndarray, states: np.ndarray | None) -> list[Tensor]:
        """Rows of motion of the next frames, for a memory that reads them.

        Raises:
            UserError: it does, and there are no states, or no statistics.
        """
        if not uses_proprio(self._policy.require_memory()):
            return []
        if states is None:
            raise UserError(
                "This policy's memory reads the robot's own states and actions: give past frames with their states "
                "(`Episode.observe`), not as images alone."
            )
        actions, known = np.zeros((len(demo), self._robot.action.width), np.float32), np.zeros(len(demo), bool)
        if self._robot.action.frames is not None:
            places = np.flatnonzero(~demo)[: len(executed)]
            actions[places], known[places] = executed[: len(places)], True
        return list(self._policy.require_processor().motion(states, actions, known))

    def gather_selection(self) -> HistoryTokens:
        """The memory's selection at the current frame, unbatched."""
        history = self.required_history()
        return self._policy.require_memory().gather_selection(history, len(history) - 1)

    def required_history(self) -> OnlineHistory:
        """The history, once there is something in it.

        Raises:
            UserError: the policy has no memory, or the episode has seen no frame.
        """
        self._policy.require_memory()
        self._require_observation()
        assert self.history is not None
        return self.history

    @property
    def images(self) -> Tensor:
        """The current views [v, 3, s, s] uint8.

        Raises:
            UserError: no frame was seen yet, or the current one was not drawn.
        """
        self._require_observation()
        return self._require_rendered(self._recent[-1][0])

    @property
    def state(self) -> Tensor:
        """The current state [s]."""
        self._require_observation()
        return self._recent[-1][1]

    @property
    def window(self) -> tuple[Tensor, Tensor]:
        """Views [t, v, 3, s, s] uint8 and states [t, s] of the frames that the policy sees at once, the current last.

        Where fewer frames of the execution have been seen, the oldest means those before it.

        Raises:
            UserError: no frame was seen yet, or one of these was not drawn.
        """
        self._require_observation()
        missing = self._policy.require_processor().window - len(self._recent)
        frames = [self._recent[0]] * missing + self._recent
        return torch.stack([self._require_rendered(images) for images, _ in frames]), torch.stack(
            [state for _, state in frames]
        )

    @property
    def past(self) -> PastViews | None:
        """Views of earlier frames that the policy's memory gives along with the current ones, unbatched.

        Raises:
            UserError: one of them was not drawn.
        """
        if self._past is None:
            return None
        return self._past.at(self.n_observed_frames - 1, self._policy.require_processor().images)

    @property
    def prompt(self) -> Any:
        """What the policy reads of the goal, and of the subgoal where it reads one."""
        processor, state = self._policy.require_processor(), self._recent[-1][1] if self._recent else None
        goal = self._robot.action.worded(self.goal, self.options)
        return processor.prompt(goal, subgoal=self.subgoal, state=state, past_actions=self._executed)

    def set_action_prefix(self, actions: np.ndarray, delay: int = 0) -> None:
        """Let the next chunk, and it alone, agree with actions that the robot executes while it is chosen.

        Args:
            actions: [n, w], as the embodiment executes them: those of the chunk before that are still to come, the
                first one now. delay: how many of them will be executed before the next chunk is there; these count in
                full, the others less and less.

        Raises:
            UserError: actions of another form, more than a chunk, or a delay that they do not cover.
        """
        space = self._robot.action
        self.action_prefix = checked_prefix(actions, delay, space.horizon, space.width)

    def begun(self, frames: Sequence[int], exec_start: int) -> None:
        """Hear at which frames sub-tasks began, where an environment tells; only what probes a policy listens."""

    def acted(self, chunk: np.ndarray) -> None:
        """Note the chunk [h, w] the policy chose; the frames that follow say how much of it was executed."""
        self._chunk, self.action_prefix = chunk, None

    def _executed_now(self, count: int, actions: np.ndarray | None) -> np.ndarray:
        """The actions that led to the last `count` frames: those given, else the next ones of the chunk."""
        space = self._robot.action
        if actions is None:
            return self._no_actions if self._chunk is None or space.frames is None else self._chunk[:count]
        values = finite_array(actions, "actions")
        if space.frames is None and values.ndim:
            count = len(values)
        executed = values[max(len(values) - count, 0) :] if values.ndim else values
        if executed.shape != (count, space.width):
            raise UserError(
                f"actions must be [{count}, {space.width}], one for each execution frame; got {executed.shape}."
            )
        return executed

    @property
    def _no_actions(self) -> np.ndarray:
        return np.zeros((0, self._robot.action.width), np.float32)

    @property
    def noise_state(self) -> Tensor:
        """Where the noise stands. Set back, it draws the same again: for a batch that failed and is repeated."""
        return self._generator.get_state()

    @noise_state.setter
    def noise_state(self, state: Tensor) -> None:
        self._generator.set_state(state)

    def draw(self) -> dict[str, Tensor]:
        """The next chunk's random numbers, from this episode's own generator: batching cannot change them."""
        return self._policy.sampling_noise(self._generator)

    def _prepared_images(
        self, views: Mapping[str, np.ndarray], rendered: Mapping[str, np.ndarray] | None, frame: int
    ) -> Tensor | None:
        """One of the frames given as the network takes it; None where a camera did not show it."""
        if rendered is None:
            images = [view[frame] for view in views.values()]
        elif all(frame in rendered[name] for name in views):
            images = [view[int(np.searchsorted(rendered[name], frame))] for name, view in views.items()]
        else:
            return None
        return self._policy.require_processor().images(images)

    def _require_rendered(self, images: Tensor | None) -> Tensor:
        if images is None:
            raise UserError("The current frame was not drawn: observe() an image of every camera before act().")
        return images

    def _see(self, frames: Sequence[tuple[Tensor | None, Tensor]]) -> None:
        """Take what is new into the window."""
        self._recent = [*self._recent, *frames][-self._policy.require_processor().window :]

    def _require_observation(self) -> None:
        if not self._recent:
            raise UserError("The episode has seen no frame yet: call observe() with the current frame before act().")

    def _checked_view(self, frames: Mapping[str, np.ndarray], view: str) -> np.ndarray:
        if view not in frames:
            raise UserError(f"observe() needs the camera {view!r}; got {sorted(frames)}.")
        array = np.asarray(frames[view])
        if array.ndim != 4 or array.shape[-1] != 3 or array.dtype != np.uint8:
            raise UserError(f"Camera {view!r} must be uint8 [t, height, width, 3]; got {array.dtype} {array.shape}.")
        return array
