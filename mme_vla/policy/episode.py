"""One running episode: all streaming state is here, never on the policy."""

import copy
import operator
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import numpy as np
import torch
from torch import Tensor

from mme_vla.embodiment import Option
from mme_vla.errors import UserError, brief, require
from mme_vla.memory.history import History, LazyHistory, OnlineHistory
from mme_vla.processing.base import motion_rows
from mme_vla.processing.images import PastImages
from mme_vla.processing.normalise import QuantileStats, check_reach, finite_array
from mme_vla.processing.prompt import checked_goal, checked_text
from mme_vla.speed.rtc import overlap_weights
from mme_vla.types import FrameBatch, HistoryTokens, Overlap, PastViews

if TYPE_CHECKING:
    from mme_vla.policy.base import Policy
    from mme_vla.processing.base import PolicyProcessor


@dataclass(frozen=True)
class ActionPrefix:
    """Actions [n, w] float32 as the robot takes them, of which the first `delay` are executed
    before the next chunk.
    """

    actions: np.ndarray
    delay: int


@dataclass(frozen=True)
class Failure:
    """Why a policy cannot act in an episode any more.

    again: whether it may be able to when the episode is run again from its beginning.
    """

    reason: str
    again: bool


class Episode:
    """State of one episode: goal, current view and robot state, history of past frames, noise.

    policy: the one that started it, and acts in it. Copies of an episode share it.
    """

    def __init__(self, policy: "Policy", goal: str, seed: int = 0) -> None:
        self.policy = policy
        self._robot = policy.embodiment
        try:
            self._generator = torch.Generator().manual_seed(operator.index(seed))
        except (TypeError, ValueError):  # another type, or more than 64 bits
            raise UserError(f"seed={brief(seed)} must be a whole number of 64 bits.") from None
        self._recent: list[tuple[Tensor | None, Tensor]] = []
        """Images (None: not rendered) and states of the observation's window, the current frame
        last.
        """
        self._acted = False
        """Whether the policy acted at the newest of these."""
        self._video_over = False
        self.goal = checked_text(goal, "the goal")
        self.subgoal: str | None = None
        """The current language subgoal, for policies whose prompt has one; set it before `act`."""
        self.options: tuple[Option, ...] = ()
        """The options of policies that choose among some; set them before `act`."""
        self.history: OnlineHistory | None = None
        self.stream: Any = None
        """State of a streaming memory between two `act`s."""
        self.read: History | None = None
        """The history as the last `act` read it, conditioned on the prompt."""
        self._read_prompt: Tensor | None = None
        """Token ids of that prompt, where a backbone conditions on it."""
        self._past: PastImages | None = None
        self._motion_of_frames: list[Tensor] = []
        """Rows [w], one a frame, if the memory reads motion."""
        memory = policy.memory
        if memory is not None:
            scorer = memory.make_scorer()
            if memory.lazy:
                self.history = LazyHistory(memory.storage, policy.encode_frames, scorer)
            else:
                self.history = OnlineHistory(memory.storage, scorer)
            self.stream = memory.start_stream()
            if memory.uses_proprio:
                self.history.motion = self._motion_at
                self.history.state_width = policy.embodiment.state.width
            if memory.past_view_spec is not None:
                self._past = PastImages(memory.past_view_spec)
        self.n_observed_frames = 0
        self._chunk: np.ndarray | None = None
        self.action_prefix: ActionPrefix | None = None
        """See `set_action_prefix`."""
        self._executed = self._no_actions
        self._failure: Failure | None = None

    def renew_stream(self, prompt: Tensor) -> None:
        """Begin the stream anew where the prompt, token ids [l], is another than before: its state
        was made of tokens that the former one conditioned.
        """
        memory = self.policy.memory
        is_unchanged = self._read_prompt is None or prompt.equal(self._read_prompt)
        if memory is not None and not is_unchanged:
            self.stream = memory.start_stream()
        self._read_prompt = prompt

    def __deepcopy__(self, memo: dict[int, Any]) -> Self:
        # What holds policy and episode is copied with both: the policy comes first there.
        memo.setdefault(id(self.policy), self.policy)
        episode = object.__new__(type(self))
        memo[id(self)] = episode
        episode.__dict__.update(copy.deepcopy(self.__dict__, memo))
        return episode

    def __copy__(self) -> Self:
        return copy.deepcopy(self)  # two episodes share nothing but the policy

    def _motion_at(self, frames: Sequence[int] | np.ndarray) -> Tensor:
        return torch.stack([self._motion_of_frames[int(frame)] for frame in frames])

    def observe(
        self,
        frames: Mapping[str, np.ndarray],
        states: np.ndarray,
        is_demo: bool | np.ndarray = False,
        actions: np.ndarray | None = None,
        rendered: Mapping[str, np.ndarray] | None = None,
    ) -> None:
        """Take frames in order, each once, the current one last; the conditioning video comes
        first.

        Args:
            frames: of every camera by its name (`front` and `wrist`), each [t, H, W, 3] uint8.
            states: [t, s].
            is_demo: whether the frames belong to the conditioning video; one bool, or [t].
            actions: [t, w] absolute actions that led to these frames; by default the first t of the
                last chunk, one action a frame. If an action is a motion of many frames, any number
                of them: [n, w].
            rendered: by camera the indices, ascending, of the t frames that `frames` shows, if not
                all are rendered. `act` needs the last one of every camera, a memory those of its
                `frames_read`.

        Raises:
            UserError: a missing camera, a wrong dtype or shape, or a video frame after execution
                has begun.
        """
        # All checks come first: after an error the same frames can be observed again.
        views = {}
        states = finite_array(states, "states")
        demo = np.asarray(is_demo, bool)
        count = len(states) if states.ndim else 0
        width = self._robot.state.width
        is_even = True
        for name in self._robot.camera_names:
            images = self._checked_view(frames, name)
            indices = np.arange(count)
            if rendered is not None:
                indices = _checked_indices(rendered, name, count)
            if len(images) != len(indices):
                is_even = False
            views[name] = FrameBatch.of(images, indices, count)
        if states.shape != (count, width) or not is_even or demo.shape not in ((), (count,)):
            counts = ", ".join(f"{len(view.images)} {name}" for name, view in views.items())
            raise UserError(
                f"observe() needs as many {width}-number states and is_demo flags as images of"
                f" every camera: got {counts}, states of shape {states.shape} and is_demo of"
                f" {demo.shape}."
            )
        if count == 0:
            return
        processor = self.policy.require_processor()
        check_reach(states, self._state_stats(), "a state")
        demo, executed = self._checked_course(count, demo, actions)
        # Execution frames within the window; the current frame in any case.
        samples = processor.samples
        first = max(count - samples.window, 0) if samples.consecutive else count - 1
        new_frames = []
        for i in range(first, count):
            if i == count - 1 or not demo[i]:
                images_of_frame = self._prepared_images(views, i)
                new_frames.append((images_of_frame, torch.from_numpy(states[i].copy())))
        if not self._video_over and not demo[-1]:
            self._recent = []  # frames of the video are not in a window of the execution
        if not samples.consecutive and not self._acted:
            self._recent = self._recent[:-1]  # the end of a piece, at which nothing was decided
        self._take(views[self._robot.memory_camera], demo, executed, states)
        if self._past is not None:
            self._past.take(views, self.n_observed_frames - count, self.n_observed_frames)
        self._recent = [*self._recent, *new_frames][-samples.window :]
        self._acted = False

    def add_frames(
        self,
        frames: np.ndarray,
        is_demo: bool | np.ndarray = False,
        actions: np.ndarray | None = None,
        states: np.ndarray | None = None,
    ) -> None:
        """Add frames to memory alone, for a client that sends past frames and the current view
        apart.

        `add_frames`, then `set_view` at the last of them, is what `observe` does for a policy that
        reads one view.

        Args:
            frames: of the memory camera, [t, H, W, 3] uint8, in order, each once.
            is_demo, actions: as for `observe`.
            states: [t, s]; only a memory of the robot's own motion needs them.

        Raises:
            UserError: a wrong dtype or shape, a video frame after execution has begun, a memory
                that needs states, or one that reads past images of every camera.
        """
        self._require_single_view()
        camera = self._robot.memory_camera
        frames = self._checked_view({camera: frames}, camera)
        demo = np.asarray(is_demo, bool)
        if demo.shape not in ((), (len(frames),)):
            raise UserError(f"is_demo must be one flag or {len(frames)}; got {demo.shape}.")
        if states is not None and np.shape(states) != (len(frames), self._robot.state.width):
            raise UserError(
                f"states must be [{len(frames)}, {self._robot.state.width}]; got"
                f" {list(np.shape(states))}."
            )
        if not len(frames):
            return
        if states is not None:
            states = finite_array(states, "states")
            check_reach(states, self._state_stats(), "a state")
        demo, executed = self._checked_course(len(frames), demo, actions)
        self._take(FrameBatch.of(frames), demo, executed, states)

    def set_view(self, views: Mapping[str, np.ndarray], state: np.ndarray) -> None:
        """Set the current view and state, adding nothing to memory.

        Args:
            views: of every camera by its name, [H, W, 3] uint8.
            state: [s].

        Raises:
            UserError: images or a state of another form, or a memory that reads past images of
                every camera.
        """
        self._require_single_view()
        state = finite_array(state, "the state")
        width = self._robot.state.width
        names = self._robot.camera_names
        if state.shape != (width,):
            raise UserError(
                f"set_view() needs a state of {width} finite numbers, got shape {state.shape}."
            )
        missing = [name for name in names if name not in views]
        if missing:
            raise UserError(
                f"set_view() needs an image of {', '.join(missing)} too; got"
                f" {', '.join(views) or 'none'}."
            )
        processor = self.policy.require_processor()
        check_reach(state, self._state_stats(), "the state")
        images = processor.images([views[name] for name in names])
        newest = (images, torch.from_numpy(state.copy()))
        self._recent = [*self._recent, newest][-processor.samples.window :]
        self._acted = False

    def gather_selection(self) -> HistoryTokens:
        """The memory's selection at the current frame, unbatched."""
        history = self.required_history()
        return self.policy.require_memory().gather_selection(history, len(history) - 1)

    def required_history(self) -> OnlineHistory:
        """The history, once it has a frame.

        Raises:
            UserError: the policy has no memory, or no frame was observed.
        """
        if self.history is None:
            raise UserError(
                "This policy has no memory, so it stores no vision tokens of past frames."
            )
        self._require_observation()
        return self.history

    @property
    def images(self) -> Tensor:
        """The current views [v, 3, s, s] uint8.

        Raises:
            UserError: no frame was observed, or the current one was not rendered.
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
        """Views [t, v, 3, s, s] uint8 and states [t, s] of the observation's window, the current
        frame last.

        The oldest frame is repeated until the execution has as many.

        Raises:
            UserError: no frame was observed, or one of these was not rendered.
        """
        self._require_observation()
        missing = self.policy.require_processor().samples.window - len(self._recent)
        frames = [self._recent[0]] * missing + self._recent
        images = torch.stack([self._require_rendered(images) for images, _ in frames])
        return images, torch.stack([state for _, state in frames])

    @property
    def past(self) -> PastViews | None:
        """Past views that the memory gives with the current ones, unbatched.

        Raises:
            UserError: one of them was not rendered.
        """
        if self._past is None:
            return None
        return self._past.at(self.n_observed_frames - 1, self.policy.require_processor().images)

    @property
    def prompt(self) -> Any:
        """The processor's encoding of goal and subgoal."""
        processor = self.policy.require_processor()
        state = self._recent[-1][1] if self._recent else None
        goal = self._robot.action.worded(checked_goal(self.goal), self.options)
        return processor.prompt(
            goal, subgoal=self.subgoal, state=state, past_actions=self._executed
        )

    def set_action_prefix(self, actions: np.ndarray, delay: int = 0) -> None:
        """Make the next chunk, and it alone, continue actions that the robot executes meanwhile
        (real-time chunking).

        Args:
            actions: [n, w], as the embodiment executes them: the remaining ones of the chunk
                before, the current one first.
            delay: how many of them are executed before the next chunk is there; these count in
                full, the others less and less.

        Raises:
            UserError: actions of another form, more than a chunk, or a delay beyond them.
        """
        space = self._robot.action
        values = finite_array(actions, "the actions of the prefix")
        require(
            values.ndim == 2
            and values.shape[1] == space.width
            and 1 <= len(values) <= space.horizon,
            f"set_action_prefix() needs 1 to {space.horizon} actions of {space.width} numbers, got"
            f" shape {values.shape}.",
        )
        is_count = isinstance(delay, int | np.integer) and not isinstance(delay, bool)
        require(
            is_count and 0 <= delay <= len(values),
            f"set_action_prefix(): delay={delay!r} must be a whole number from 0 to {len(values)},"
            " the actions given.",
        )
        self.action_prefix = ActionPrefix(values.copy(), int(delay))

    def restart_clock(self) -> None:
        """Count the current frame as 0 again; what is remembered keeps its times.

        Raises:
            UserError: the policy has no memory that numbers frames.
        """
        if self.history is None:
            raise UserError(
                "The clock of this policy cannot restart: it has no memory that numbers frames."
            )
        self.history.restart_clock()

    def note_subtask_starts(self, frames: Sequence[int], exec_start: int) -> None:
        """Take the frames at which sub-tasks began so far, before each decision, where the
        environment reports them. Nothing by default: probes override it.
        """

    @property
    def failure(self) -> Failure | None:
        """Why the policy could not act at the last decision; None where it could."""
        return self._failure

    def close(self) -> None:
        """End the episode: free what it holds outside of this process."""

    def acted(self, chunk: np.ndarray) -> None:
        """Take the chunk [h, w] of the policy; the frames that follow show how much of it was
        executed.
        """
        self._chunk = chunk.copy()  # the caller may change its own
        self._acted = True
        self.action_prefix = None

    @property
    def noise_state(self) -> Tensor:
        """State of the noise generator; set it back to repeat a batch that failed."""
        return self._generator.get_state()

    @noise_state.setter
    def noise_state(self, state: Tensor) -> None:
        self._generator.set_state(state)

    def draw(self) -> dict[str, Tensor]:
        """Sample the next chunk's random numbers from this episode's own generator, independent of
        batching.
        """
        return self.policy.sampling_noise(self._generator)

    def _state_stats(self) -> QuantileStats | None:
        """Statistics of the state, once the processor has any."""
        stats = self.policy.require_processor().stats
        return None if stats is None else stats.state

    @property
    def _no_actions(self) -> np.ndarray:
        return np.zeros((0, self._robot.action.width), np.float32)

    def _require_single_view(self) -> None:
        if self._past is not None:
            raise UserError(
                "This policy's vision tower reads past images of every camera: use"
                " `Episode.observe`, not past frames of one camera and the current view apart."
            )

    def _checked_course(
        self, count: int, demo: np.ndarray, actions: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Flags [count] of the next frames and the actions that led to the execution frames among
        them, by default the next ones of the chunk.
        """
        demo = np.broadcast_to(demo, (count,))
        begins_again = (np.diff(demo.astype(int)) > 0).any()
        if demo.any() and (self._video_over or begins_again):
            raise UserError(
                "A conditioning-video frame came after the first execution frame; the video goes"
                " first."
            )
        n_executed = int((~demo).sum())
        space = self._robot.action
        if actions is None:
            if self._chunk is None or space.frames is None:
                return demo, self._no_actions
            return demo, self._chunk[:n_executed]
        values = finite_array(actions, "actions")
        if values.ndim:
            if space.frames is None:
                n_executed = len(values)
            values = values[max(len(values) - n_executed, 0) :]
        if values.shape != (n_executed, space.width):
            raise UserError(
                f"actions must be [{n_executed}, {space.width}], one for each execution frame; got"
                f" {values.shape}."
            )
        return demo, values

    def _take(
        self,
        frames: FrameBatch,
        demo: np.ndarray,
        executed: np.ndarray,
        states: np.ndarray | None = None,
    ) -> None:
        """Append checked frames of the memory camera to the history, and the actions that led to
        them.
        """
        processor = self.policy.require_processor()
        if self.history is not None:
            motion: list[Tensor] = []
            if self.policy.require_memory().uses_proprio:
                if states is None:
                    raise UserError(
                        "This policy's memory reads the robot's own states and actions: give past"
                        " frames with their states (`Episode.observe`), not as images alone."
                    )
                actions = np.zeros((len(demo), self._robot.action.width), np.float32)
                known = np.zeros(len(demo), bool)
                if self._robot.action.frames is not None:
                    rows = np.flatnonzero(~demo)[: len(executed)]
                    actions[rows] = executed[: len(rows)]
                    known[rows] = True
                motion += motion_rows(processor, states, actions, known)
            self.history.take(frames, self.policy.encode_frames)
            self._motion_of_frames += motion
            if not self._video_over:
                self.history.exec_start = self.n_observed_frames + int(demo.sum())
        longest = processor.prompt_spec.past_actions
        past = np.concatenate([self._executed, executed])
        self._executed = past[max(len(past) - longest, 0) :]
        if self._chunk is not None:
            self._chunk = self._chunk[int((~demo).sum()) :]
        if not demo[-1]:
            self._video_over = True
        self.n_observed_frames += len(demo)

    def _prepared_images(self, views: Mapping[str, FrameBatch], frame: int) -> Tensor | None:
        """The views of a frame as the network takes them; None unless all cameras rendered it."""
        images = [view.image(frame) for view in views.values()]
        rendered = [image for image in images if image is not None]
        if len(rendered) < len(images):
            return None
        return self.policy.require_processor().images(rendered)

    def _require_rendered(self, images: Tensor | None) -> Tensor:
        if images is None:
            raise UserError(
                "The current frame was not rendered: observe() an image of every camera before"
                " act()."
            )
        return images

    def _require_observation(self) -> None:
        if not self._recent:
            raise UserError(
                "No frame was observed yet: call observe() with the current frame before act()."
            )

    def _checked_view(self, frames: Mapping[str, np.ndarray], view: str) -> np.ndarray:
        if view not in frames:
            raise UserError(
                f"This policy needs images of the camera {view!r}; got {sorted(frames)}."
            )
        array = np.asarray(frames[view])
        if array.ndim != 4 or array.shape[-1] != 3 or array.dtype != np.uint8:
            raise UserError(
                f"Camera {view!r} must be uint8 [t, height, width, 3]; got {array.dtype}"
                f" {array.shape}."
            )
        return array


def _checked_indices(rendered: Mapping[str, np.ndarray], camera: str, count: int) -> np.ndarray:
    """Which of `count` frames a camera shows."""
    require(camera in rendered, f"rendered={sorted(rendered)} lacks the camera {camera!r}.")
    indices = np.asarray(rendered[camera])
    is_ascending = indices.ndim == 1 and (np.diff(indices) > 0).all()
    is_inside = bool(((indices >= 0) & (indices < count)).all())
    require(
        is_ascending and is_inside,
        f"rendered[{camera!r}]={brief(indices.tolist())} must be ascending numbers of frames from 0"
        f" to {count - 1}.",
    )
    return indices


def prefix_overlap(
    prefixes: Sequence[ActionPrefix | None],
    states: Tensor,
    processor: "PolicyProcessor",
    action_dim: int,
) -> Overlap | None:
    """The normalised prefixes of n episodes at raw states [n, s]; None if none has one."""
    if all(prefix is None for prefix in prefixes):
        return None
    horizon, width = processor.embodiment.action.horizon, processor.embodiment.action.width
    actions, weight = torch.zeros(2, len(prefixes), horizon, action_dim)
    for i, prefix in enumerate(prefixes):
        if prefix is None:
            continue
        count = len(prefix.actions)
        padded = np.concatenate([prefix.actions, prefix.actions[-1:].repeat(horizon - count, 0)])
        actions[i] = processor.actions(padded, states[i])
        weight[i, :, :width] = overlap_weights(prefix.delay, count, horizon)[:, None]
    return Overlap(actions, weight)


def executable_actions(policy: "Policy", chunk: Tensor, episodes: Sequence[Episode]) -> np.ndarray:
    """A normalised chunk [n, h, a] float32 as the embodiment executes it, float32 [n, h, w],
    without the steps of a chunk that lie in the past.
    """
    processor = policy.require_processor()
    absolute = processor.absolute_actions(chunk, torch.stack([e.state for e in episodes]))
    space = policy.embodiment.action
    decided = []
    for episode, rows in zip(episodes, absolute, strict=True):
        decided.append(space.decide(rows, episode.options))
    n_past = processor.samples.window - 1
    actions: np.ndarray = torch.stack(decided).numpy()[:, n_past:]
    return actions
