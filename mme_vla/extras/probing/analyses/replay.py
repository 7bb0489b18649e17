"""Recorded episodes run through a policy: its chunks, its recurrence, and what its
memory selects.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from PIL import Image

from mme_vla.data.episodes import EpisodeSource, check_episode
from mme_vla.data.memory_image import memory_sheet
from mme_vla.data.recording import action_offset_of
from mme_vla.data.statistics import compute_norm_stats, normalised_states
from mme_vla.errors import UserError, require
from mme_vla.extras.probing.recordings import Recording
from mme_vla.memory.base import Memory
from mme_vla.memory.history import OnlineHistory, TokenlessHistory
from mme_vla.memory.recurrent import RecurrentMemory
from mme_vla.policy.episode import Episode
from mme_vla.policy.mme import MMEPolicy
from mme_vla.policy.sections import PolicySections
from mme_vla.processing.prompt import SubgoalText
from mme_vla.types import FrameBatch
from mme_vla.utils.media import GROUND
from mme_vla.utils.style import COLOURS, FAINT, figure, svg

STRIDE = 16  # Steps between two chunks, as an evaluation executes them


def replay(
    policy: MMEPolicy,
    source: EpisodeSource,
    episode: int,
    stride: int = STRIDE,
    most: int | None = None,
) -> Iterator[tuple[int, Episode]]:
    """Show a recorded episode frame by frame and let the policy act at every `stride`-th execution
    step.

    A robot whose actions are motions acts wherever it decides.

    The recorded actions are executed, not the policy's. Subgoals, where the policy reads them,
    are the recorded ones.

    most: chunks at most, spread over the episode.

    Yields:
        The step a chunk was just chosen at, and the running episode.
    """
    check_episode(source, episode)
    processor = policy.require_processor()
    if processor.stats is None:  # a fresh policy has none: those of the data
        processor.stats = compute_norm_stats(
            [source], horizon=processor.embodiment.action.horizon, robot=processor.embodiment
        )
    recording = Recording(source, episode, action_offset_of(policy))
    n_observed = 0
    text = SubgoalText.from_config(PolicySections.of(policy.config).subgoal_text)
    running = policy.start_episode(recording.goal)
    for step in recording.decisions(stride, most):
        recording.show(running, n_observed, step + 1)
        n_observed = step + 1
        if text is not None:
            texts = source.subgoals(episode, step)
            require(
                text.kind in texts, f"{source.name} has no {text.kind}, which this policy reads."
            )
            running.subgoal = texts[text.kind]
        policy.act([running])
        yield step, running


def replay_all(
    policy: MMEPolicy,
    source: EpisodeSource,
    episodes: Sequence[int] | None,
    stride: int = STRIDE,
    most: int | None = None,
    after: Callable[[int, int], None] = lambda episode, step: None,
) -> int:
    """Replay several episodes (None: all); return how many chunks were chosen.

    after: called after every chunk, with its episode and step.
    """
    count = 0
    for episode in range(len(source)) if episodes is None else episodes:
        for step, _ in replay(policy, source, episode, stride, most):
            after(episode, step)
            count += 1
    return count


@dataclass(frozen=True)
class RecurrenceCurves:
    """One episode's recurrence: frames [t] it took, in order, and a number of each by name.

    TTT: `inner_loss_before` and `inner_loss_after` the update by this frame, `step_size`,
    `clipped_gradients`, `clipped_rates` (shares). RMT: `slot_change`, relative.
    """

    episode: int
    exec_start: int
    frames: np.ndarray
    curves: dict[str, np.ndarray]


@torch.no_grad()
def recurrence_curves(
    policy: MMEPolicy, source: EpisodeSource, episode: int, stride: int = STRIDE
) -> RecurrenceCurves:
    """Run the memory over the window it has at an episode's last chunk."""
    memory = policy.memory
    if not isinstance(memory, RecurrentMemory):
        raise UserError(
            "This policy has no recurrent memory: choose one such as ttt_modul or rmt_expert."
        )
    last = None
    for last in replay(policy, source, episode, stride):  # noqa: B007  (only the last is wanted)
        pass
    assert last is not None
    step, running = last
    history = running.required_history()
    window = running.gather_selection()
    with policy.autocast():
        mask = window.mask[None].to(policy.device)
        features = window.features[None].to(policy.device)
        x = memory.encoder(features, window.positions[None].to(policy.device), mask)
        patches = memory.storage.grid**2
        frames = x.unflatten(1, (-1, patches))
        valid = mask.unflatten(1, (-1, patches)).all(-1)
        _, numbers = memory.layer.advance(memory.init_state(1), frames, valid, statistics=True)
    real = valid[0].cpu().numpy()
    curves = {name: values[0].float().cpu().numpy()[real] for name, values in numbers.items()}
    return RecurrenceCurves(episode, history.exec_start, memory.frames(history, step), curves)


_PAIR = ("inner_loss_before", "inner_loss_after")


def recurrence_plot(episodes: Sequence[RecurrenceCurves], title: str) -> str:
    """One panel a number, one colour an episode, over the frames taken; a dotted line where its
    video ends.

    TTT's loss before and after a frame's update share a panel: dashed before, solid after.
    """
    names = list(episodes[0].curves)
    panels = ["inner loss" if name == _PAIR[0] else name for name in names if name != _PAIR[1]]
    with figure((7.5, 2.3 * len(panels) + 0.6), len(panels)) as (canvas, axes):
        for panel, name in zip(axes, panels, strict=True):
            for i, episode in enumerate(episodes):
                colour = COLOURS[i % len(COLOURS)]
                curve_styles = [(name, "-")]
                if name == "inner loss":
                    curve_styles = [(_PAIR[0], "--"), (_PAIR[1], "-")]
                for curve, style in curve_styles:
                    label = f"episode {episode.episode}" if style == "-" else None
                    panel.plot(
                        episode.frames,
                        episode.curves[curve],
                        style,
                        color=colour,
                        lw=1.4,
                        label=label,
                    )
                if episode.exec_start:
                    panel.axvline(episode.exec_start, color=colour, ls=":", lw=0.9)
            panel.set_title(name.replace("_", " "), loc="left", fontsize=10)
            panel.set_ylim(bottom=0)
        axes[-1].set_xlabel("frame of the episode")
        canvas.suptitle(title, x=0.02, ha="left", color=FAINT, fontsize=10)
        canvas.legend(
            *axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=9
        )
        return svg(canvas)


def selection_sheets(
    source: EpisodeSource, episode: int, memory: Memory, name: str, every: int = 8
) -> Iterator[tuple[int, Image.Image]]:
    """Draw what `memory` remembers at the first execution step and at every `every`-th after it.

    Selections need no weights: tokens are zeros, and reading them is an error.

    Yields:
        (step, image); images grow with what is remembered.
    """
    check_episode(source, episode)
    require(every >= 1, f"every={every} must be at least 1: the steps between two images.")
    start, length = int(source.exec_starts[episode]), int(source.lengths[episode])
    frames = source.frames(episode, np.arange(length))
    history = OnlineHistory(memory.storage, memory.make_scorer(), start)
    patches = memory.storage.grid**2
    motion = normalised_states(source.states(episode, 0, length))
    history.motion = motion.__getitem__
    history.state_width = motion.shape[1]
    n_observed = 0
    for step in range(start, length, every):
        part = frames[n_observed : step + 1]
        history.take(FrameBatch.of(part), lambda images: torch.zeros(len(images), patches, 1))
        n_observed = step + 1
        selected = memory.select(TokenlessHistory(history), step)
        title = (
            f"{name} at step {step}: {len(selected)} of {memory.capacity} tokens ·"
            f" {source.goal(episode, step)}"
        )
        yield (
            step,
            memory_sheet(frames[: step + 1], selected, memory.storage.grid, start, step, title),
        )


def of_one_size(images: Sequence[Image.Image]) -> Iterator[np.ndarray]:
    """Images of any sizes as frames of a video: each at the top left of the largest size."""
    width = max(image.width for image in images)
    height = max(image.height for image in images)
    width, height = width + width % 2, height + height % 2  # as the format wants them
    for image in images:
        canvas = Image.new("RGB", (width, height), GROUND)
        canvas.paste(image)
        yield np.asarray(canvas)
