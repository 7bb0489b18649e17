"""The training dataset: one item is one step of an execution phase."""

import logging
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset

from mme_vla.data.cache import VisionCache
from mme_vla.data.columns import label_column, text_column, weight_column, with_labels
from mme_vla.data.episodes import EpisodeSource
from mme_vla.errors import require
from mme_vla.memory.base import Memory
from mme_vla.memory.history import History
from mme_vla.memory.perturbation import Perturbation
from mme_vla.memory.transforms import FrameMap, TransformedHistory, map_frames
from mme_vla.processing.base import PolicyProcessor, Sample, motion_rows
from mme_vla.processing.base import collate as collate
from mme_vla.processing.images import past_views
from mme_vla.processing.prompt import SubgoalText
from mme_vla.types import labels_read

log = logging.getLogger(__name__)

TRANSFORMS = 1  # The stream of random numbers of an item that transforms read


@dataclass(frozen=True)
class Step:
    """What is recorded of one step, before any processing.

    source, episode, index: where it lies; index counts the episode's frames, video included.
    exec_start: the episode's first execution frame.
    goal: the task in words.
    subgoals: the texts of this step by name.
    state: [s] float32.
    actions: [h, w] float32, the chunk, its last recorded action repeated past the end.
    recorded: [h] bool, False on repeated actions.
    """

    source: int
    episode: int
    index: int
    exec_start: int
    goal: str
    subgoals: dict[str, str]
    state: np.ndarray
    actions: np.ndarray
    recorded: np.ndarray


@dataclass(frozen=True)
class ColumnNames:
    """Columns of a dataset that training reads beside a robot's own.

    labels: of the current frame, that the backbone reads; those of the memory follow from it.
    weights: the column of sample weights.
    """

    labels: Sequence[str] = ()
    weights: str | None = None


class TrainingDataset(Dataset[dict[str, Any]]):
    """Execution steps of several datasets, source by source, episode by episode, step by step.

    Items are dictionaries of tensors for the processor's `collate`, with the step's goal, subgoals
    and place beside them. They depend on (seed, epoch, index) alone, whatever worker makes them.
    Tables and token caches are memory-mapped, and an item decodes only the images of its window,
    most often the current ones.
    """

    def __init__(
        self,
        sources: Sequence[EpisodeSource],
        processor: PolicyProcessor,
        memory: Memory | None = None,
        caches: Sequence[VisionCache] | None = None,
        *,
        episodes: Sequence[np.ndarray] | None = None,
        action_offset: int = 0,
        mask_padding: bool = False,
        jitter: bool = False,
        subgoal: SubgoalText | None = None,
        columns: ColumnNames = ColumnNames(),
        seed: int = 42,
        transforms: Sequence[Perturbation] = (),
    ) -> None:
        """Arrange the samples; nothing is read yet.

        Args:
            sources: the datasets.
            processor: turns what is recorded into what the network reads; needs normalisation
                statistics.
            memory: chooses the history of a step; None for policies without memory.
            caches: the vision tokens of each source, needed with a memory.
            episodes: which of each source's episodes to use (one side of a `Split`); None uses all.
            action_offset: observation k is paired with actions k + offset, … 0 as released; 1
                leaves out action k, which the recorder had already executed when it took the
                observation.
            mask_padding: leave repeated actions past the end of an episode out of the loss
                (released: they count).
            jitter: hand the memory a random generator, for memories that vary their selection in
                training.
            subgoal: picks the prompt's subgoal out of a step's texts; None trains without subgoals.
            columns: labels and sample weights.
            seed: of all randomness.
            transforms: of the frames of an episode, before anything reads its past.
        """
        require(
            memory is None or (caches is not None and len(caches) == len(sources)),
            "A policy with memory trains on cached vision tokens, one cache a source: build them"
            " with `mme-vla cache model=<model> data=<data>` and pass `caches`.",
        )
        require(
            0 <= action_offset <= 1,
            f"action_offset={action_offset}: expected 0 (as released) or 1 (causally clean).",
        )
        require(
            not processor.prompt_spec.reads_subgoal or subgoal is not None,
            f"The prompt format {processor.prompt_spec.name!r} reads a subgoal: set"
            " subgoal_text.kind to simple_subgoal or grounded_subgoal, or choose"
            " processor.prompt=plain.",
        )
        if subgoal is not None:
            for source in sources:
                require(
                    subgoal.kind in source.subgoal_names,
                    f"{source.name} has no column {subgoal.kind}, which"
                    f" subgoal_text.kind={subgoal.kind} reads; its subgoal texts are:"
                    f" {', '.join(source.subgoal_names) or 'none'}.",
                )
                for name in source.subgoal_names:
                    if name.startswith(subgoal.kind):
                        text_column(source, name, f"subgoal_text.kind={subgoal.kind}")
                online = f"{subgoal.kind}_online"
                if subgoal.online_probability and online not in source.subgoal_names:
                    log.warning(
                        "%s has no column %s: all its subgoals are the planner's, and"
                        " subgoal_text.online_probability=%g has no effect.",
                        source.name,
                        online,
                        subgoal.online_probability,
                    )
        rate = processor.embodiment.fps
        if processor.samples.history is not None and rate is not None:
            for source in sources:
                require(
                    source.fps == rate,
                    f"{source.name} has {source.fps:g} frames per second and"
                    f" embodiment.fps={rate:g}: the video would be shown at another speed than it"
                    " is read at. Convert the data to that rate, or set embodiment.fps.",
                )
        self.sources = list(sources)
        self.processor = processor
        self.memory = memory
        self.caches = list(caches or ())
        self.action_offset = action_offset
        self.mask_padding = mask_padding
        self.jitter = jitter
        self.subgoal = subgoal
        self.seed = seed
        self.epoch = 0
        self.transforms = tuple(transforms)
        self._cameras = processor.samples.cameras or processor.embodiment.camera_names
        self._read_columns(columns)
        # Source and number of each episode, and where its items end.
        if episodes is None:
            episodes = [np.arange(len(source)) for source in sources]
        of_source: list[int] = []
        numbers: list[int] = []
        counts: list[int] = []
        for s, selected in enumerate(episodes):
            for episode in np.asarray(selected, np.int64).tolist():
                of_source.append(s)
                numbers.append(episode)
                counts.append(len(self.decisions(s, episode)))
        self._source = np.array(of_source, np.int64)
        self._episode = np.array(numbers, np.int64)
        self._ends = np.cumsum(counts, dtype=np.int64)
        # Those at which the robot decides: all of the execution, or those before a planned motion.
        self.steps = sum(counts)
        require(self.steps, "The data hold no execution step of this robot.")

    def _read_columns(self, columns: ColumnNames) -> None:
        """Read the labels and weights of every row of each source's tables."""
        self._labels = tuple(columns.labels)
        self._memory_labels = labels_read(self.memory)
        self._label_values: list[dict[str, np.ndarray]] = []
        self._weights: list[np.ndarray] = []
        for source in self.sources:
            values = {}
            for name in dict.fromkeys((*self._labels, *self._memory_labels)):
                values[name] = label_column(source, name, "The policy's labels")
            self._label_values.append(values)
            if columns.weights is not None:
                self._weights.append(weight_column(source, columns.weights))

    def __len__(self) -> int:
        return self.steps

    def decisions(self, source: int, episode: int) -> Any:
        """Frames of an episode at which the robot decides, without those that lack a full chunk
        where that counts.
        """
        opened = self.sources[source]
        decisions = opened.decisions(episode)
        if not self.processor.samples.full_chunks_only:
            return decisions
        horizon = self.processor.embodiment.action.horizon
        if opened.robot.action.frames is None:
            # Not every motion has a decision here: some may not have been rendered.
            frames = np.asarray(decisions, np.int64)
            return frames[opened.action_chunk(episode, frames, horizon)[1].all(-1)]
        last = int(opened.lengths[episode]) - horizon - self.action_offset
        return decisions[: bisect_right(decisions, last)]

    def set_epoch(self, epoch: int) -> None:
        """Choose the epoch, which the random part of items depends on."""
        self.epoch = epoch

    def locate(self, index: int) -> tuple[int, int, int]:
        if not 0 <= index < self.steps:
            raise IndexError(f"step {index} of {self.steps}")
        at = int(np.searchsorted(self._ends, index, side="right"))
        source, episode = int(self._source[at]), int(self._episode[at])
        decisions = self.decisions(source, episode)
        first = int(self._ends[at]) - len(decisions)
        return source, episode, int(decisions[index - first])

    def item_at(self, source: int, episode: int, frame: int) -> int:
        """The item of a frame; frames at which the robot does not decide share their episode's
        items evenly.

        Such are those of the conditioning video, for a sampler that draws from all frames alike.
        """
        at = np.flatnonzero((self._source == source) & (self._episode == episode))
        decisions = np.asarray(self.decisions(source, episode))
        require(
            len(at) and len(decisions),
            f"{self.sources[source].name}: no step of episode {episode} is among the chosen ones.",
        )
        place = int(np.searchsorted(decisions, frame))
        if place == len(decisions) or decisions[place] != frame:
            place = frame * len(decisions) // int(self.sources[source].lengths[episode])
        return int(self._ends[at[0]]) - len(decisions) + place

    def step(self, index: int) -> Step:
        """Return what is recorded of a step, unprocessed."""
        return self.step_at(*self.locate(index))

    def step_at(self, s: int, episode: int, frame: int) -> Step:
        """Return what is recorded of a frame of an episode of the s-th source, unprocessed."""
        source = self.sources[s]
        actions, recorded = source.action_chunk(
            episode, frame, self.processor.embodiment.action.horizon, self.action_offset
        )
        return Step(
            source=s,
            episode=episode,
            index=frame,
            exec_start=int(source.exec_starts[episode]),
            goal=source.goal(episode, frame),
            subgoals=source.subgoals(episode, frame),
            state=source.states(episode, frame, frame + 1)[0],
            actions=actions,
            recorded=recorded,
        )

    def past_actions(self, step: Step, frames: FrameMap) -> np.ndarray:
        """The robot's own actions right before the chunk, [n, w], as many as the prompt reads and
        there are.

        frames: how the step's episode is shown.
        """
        source = self.sources[step.source]
        most = self.processor.prompt_spec.past_actions
        # Transforms repeat and leave out frames; a motion of many frames stays one action.
        if source.robot.action.frames is None:
            return source.past_actions(step.episode, step.index, most, self.action_offset)
        now = int(frames.transformed(np.array(step.index)))
        # Each frame of the execution brings the action that led to it, also where it is repeated.
        executed = frames.real[frames.exec_start : now + 1]
        executed = executed[executed > step.exec_start]
        rows = executed[max(len(executed) - most, 0) :] - 1 + self.action_offset
        if not len(rows):
            return source.past_actions(step.episode, step.index, 0, self.action_offset)
        return source.actions(step.episode, int(rows[0]), int(rows[-1]) + 1)[rows - rows[0]]

    def observation(self, index: int) -> dict[str, Any]:
        """Return the item whose last step is `index`, as it would be met when acting: without
        transforms.
        """
        return self._item(index, ())

    def __getitem__(self, index: int) -> dict[str, Any]:
        return self._item(index, self.transforms)

    def _item(self, index: int, transforms: Sequence[Perturbation]) -> dict[str, Any]:
        step = self.step(index)
        rng = np.random.default_rng([self.seed, self.epoch, index])
        decision = np.array([step.index])
        frames = self._frame_map(step.source, step.episode, decision, index, transforms)
        return self.inputs_at(step, rng, frames) | {
            "goal": step.goal,
            "subgoals": step.subgoals,
            "place": (step.source, step.episode, step.index),
        }

    def _frame_map(
        self,
        source: int,
        episode: int,
        frames: np.ndarray,
        index: int,
        transforms: Sequence[Perturbation],
    ) -> FrameMap:
        """How transforms show an item's episode up to the last of its `frames`."""
        rng = np.random.default_rng([self.seed, self.epoch, index, TRANSFORMS])
        exec_start = int(self.sources[source].exec_starts[episode])
        return map_frames(transforms, int(frames[-1]) + 1, exec_start, rng, keep=frames)

    def inputs_at(self, step: Step, rng: np.random.Generator, frames: FrameMap) -> dict[str, Any]:
        """What the network reads and learns of a step, with what its memory selects: its `history`
        and `past`.

        frames: how the step's episode is shown; all that is read of the past goes through it.
        """
        now = int(frames.transformed(np.array(step.index)))
        subgoal = None if self.subgoal is None else self.subgoal(step.subgoals, rng)
        item = self.processor.item(self._sample(step, subgoal, now, frames))
        if self.mask_padding:
            item["action_mask"] = torch.from_numpy(step.recorded)
        labels = self._label_values[step.source]
        first = int(self.sources[step.source].starts[step.episode])  # of the episode's rows
        if self._labels:
            current = {name: labels[name][first + step.index] for name in self._labels}
            item["labels"] = {name: torch.as_tensor(value) for name, value in current.items()}
        if self._weights:
            item["weight"] = torch.as_tensor(self._weights[step.source][first + step.index])
        if self.memory is not None:
            history: History = self.caches[step.source].history(step.episode)
            if self.memory.uses_proprio:
                history.motion = partial(self._motion, step.source, step.episode)
                history.state_width = self.processor.embodiment.state.width
            if frames.transforms:
                history = TransformedHistory(history, frames)
            selection = self.memory.gather_selection(history, now, rng if self.jitter else None)
            of_episode = {name: labels[name][first:] for name in self._memory_labels}
            item["history"] = with_labels(selection, of_episode, frames.real)
            spec = self.memory.past_view_spec
            if spec is not None:
                read = partial(self._images, step.source, step.episode, frames)
                item["past"] = past_views(spec, now, read, self.processor.images)
        return item

    def _images(
        self, source: int, episode: int, shown: FrameMap, frames: np.ndarray
    ) -> list[np.ndarray]:
        recorded = shown.real[frames]
        return [self.sources[source].frames(episode, recorded, name) for name in self._cameras]

    def _motion(self, source: int, episode: int, frames: np.ndarray) -> Tensor:
        return motion_rows(
            self.processor, *self.sources[source].robot_motion(episode, frames, self.action_offset)
        )

    def _sample(self, step: Step, subgoal: str | None, now: int, frames: FrameMap) -> Sample:
        """A step with the frames of its window; before the first frame of the execution that one is
        repeated.
        """
        source = self.sources[step.source]
        samples = self.processor.samples
        # The recorded frames of the window, and of the history that the memory camera shows.
        shown = np.arange(now - samples.window + 1, now + 1).clip(min=min(frames.exec_start, now))
        window = frames.real[shown]
        past = None
        if samples.history is not None:
            past = frames.real[samples.history(now)]
        first = int(window[0])
        states = source.states(step.episode, first, step.index + 1)
        views = {}
        for name in self._cameras:
            read = window
            if past is not None and name == source.robot.memory_camera:
                read = past
            distinct, places = np.unique(read, return_inverse=True)
            views[name] = source.frames(step.episode, distinct, name)[places]
        return Sample(
            views=views,
            states=states[window - first],
            goal=source.robot.action.worded(step.goal, source.options(step.episode)),
            subgoal=subgoal,
            past_actions=self.past_actions(step, frames),
            actions=step.actions,
        )
