"""The open-loop check: predicted against recorded chunks along held-out episodes, as numbers and as
an image.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mme_vla.data.dataset import TrainingDataset
from mme_vla.embodiment import ActionSpace
from mme_vla.policy.base import Policy
from mme_vla.training.order import generator_for
from mme_vla.types import stack_noise
from mme_vla.utils.style import EXECUTION, FAINT, look


@dataclass(frozen=True)
class OpenLoop:
    """Chunks of n steps along one episode.

    steps: [n] frames they start at. predicted, recorded: [n, h, w] absolute actions of the robot's
    `space`. valid: [n, h] False on actions beyond the episode's end. scale: [w] half the (q01, q99)
    range of each
        dimension; 1 where it never changes.
    still: [n, w] the state held, which a policy that does not move would answer; None where an
    action is not a state
        to come.
    """

    title: str
    steps: np.ndarray
    predicted: np.ndarray
    recorded: np.ndarray
    valid: np.ndarray
    scale: np.ndarray
    still: np.ndarray | None
    space: ActionSpace

    def error(self, predicted: np.ndarray) -> np.ndarray:
        """Mean absolute error [w] of chunks [n, h, w] in the units of the actions."""
        difference = np.abs(predicted - self.recorded)
        return (difference * self.valid[..., None]).sum((0, 1)) / self.valid.sum()

    def summary(self) -> dict[str, Any]:
        """The errors, plain: physical and normalised (1 = half the range of the training data's
        deltas).
        """
        physical = self.error(self.predicted)
        summary: dict[str, Any] = {
            "names": list(self.space.names),
            "mean_abs_error": physical.round(5).tolist(),
            "mean_abs_error_normalised": (physical / self.scale).round(5).tolist(),
            "chunks": len(self.steps),
        }
        if self.still is not None:
            still_error = self.error(np.broadcast_to(self.still[:, None], self.recorded.shape))
            summary["mean_abs_error_holding_still"] = still_error.round(5).tolist()
        return summary


@torch.compiler.set_stance("force_eager")  # a few chunks are not worth compiling for
def open_loop(
    policy: Policy, samples: TrainingDataset, chunks: int, seed: int, held_out: bool = True
) -> OpenLoop:
    """Predict chunks that tile the first of the samples' episodes, at most `chunks` of them.

    Args:
        policy: its averaged weights and mode are the caller's business.
        samples: the held-out steps; or the training steps, where there are none (`held_out` False
            says so).
    """
    processor = policy.require_processor()
    horizon = policy.horizon
    source, episode, _ = samples.locate(0)
    count = len(samples.decisions(source, episode))
    tiles = np.arange(0, count, horizon)
    places = np.linspace(0, len(tiles) - 1, min(chunks, len(tiles))).round().astype(int)
    starts = tiles[places].tolist()
    recorded = [samples.step(start) for start in starts]
    all_states = np.stack([step.state for step in recorded])
    predicted = []
    generator = generator_for(seed, "open loop")
    for first in range(0, len(starts), 8):
        group = starts[first : first + 8]
        batch = processor.collate([samples.observation(start) for start in group])
        draws = stack_noise([policy.sampling_noise(generator) for _ in group], policy.device)
        chunk = policy.sample_actions(batch.to(policy.device), draws).float().cpu()
        states = torch.from_numpy(all_states[first : first + 8])
        predicted.append(processor.absolute_actions(chunk, states))
    stats = processor.stats
    assert stats is not None
    half_range = (stats.actions.q99 - stats.actions.q01) / 2
    robot = processor.embodiment
    state_is_command = bool(robot.action.relative) and robot.action.width == robot.state.width
    kind = "held-out" if held_out else "training"
    data = samples.sources[source]
    return OpenLoop(
        title=f"{kind} episode {episode} of {data.name}: “{' → '.join(data.goals(episode))}”",
        steps=np.array([step.index for step in recorded]),
        predicted=torch.cat(predicted).numpy(),
        recorded=np.stack([step.actions for step in recorded]),
        valid=np.stack([step.recorded for step in recorded]),
        scale=np.where(half_range > 0, half_range, 1),
        still=all_states if state_is_command else None,
        space=data.robot.action,
    )


@look()
def plot_open_loop(result: OpenLoop, path: Path, name: str) -> None:
    """Draw the recorded actions as a line and each predicted chunk on top, one panel a number."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    rows = -(-result.space.width // 2)
    height = 2.4 * rows + 1.1
    figure = Figure(figsize=(13, height))
    FigureCanvasAgg(figure)
    # Margins in inches: laying them out by the texts' extents would draw everything twice.
    figure.subplots_adjust(0.06, 0.75 / height, 0.99, 1 - 0.7 / height, wspace=0.14, hspace=0.25)
    panels = figure.subplots(rows, 2, sharex=True, squeeze=False).flatten()
    errors = result.error(result.predicted)
    scaled = errors / result.scale
    time = result.steps[:, None] + np.arange(result.recorded.shape[1])
    for joint, panel in enumerate(panels[: result.space.width]):
        panel.plot(
            *_unbroken(time, result.recorded[..., joint], result.valid),
            color=FAINT,
            lw=2.2,
            label="recorded",
        )
        for i, valid in enumerate(result.valid):
            chunk = result.predicted[i, valid, joint]
            panel.plot(
                time[i, valid],
                chunk,
                color=EXECUTION,
                lw=1.5,
                label="predicted chunk" if i == 0 else None,
            )
            panel.plot(time[i, :1], chunk[:1], "o", color=EXECUTION, ms=4)
        panel.set_title(
            f"{result.space.names[joint]}: mean error {errors[joint]:.3f} ({scaled[joint]:.2f}"
            " normalised)",
            fontsize=10,
            loc="left",
        )
        panel.set_ylabel(result.space.units[joint], fontsize=9)
        panel.margins(x=0.01)
    for panel in panels[-2:]:
        panel.set_xlabel("step of the episode; a dot marks where a chunk was predicted", fontsize=9)
    figure.suptitle(
        f"{name}, open loop on {result.title}",
        x=0.01,
        y=1 - 0.1 / height,
        ha="left",
        va="top",
        fontsize=12,
    )
    figure.legend(*panels[0].get_legend_handles_labels(), loc="lower right", ncols=2, frameon=False)
    figure.savefig(path, dpi=110)


def _unbroken(
    time: np.ndarray, values: np.ndarray, valid: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Chunks [n, h] as one line that is cut only where no chunk tells what was recorded."""
    t, y = time[valid].astype(float), values[valid].astype(float)
    gaps = np.flatnonzero(np.diff(t) > 1) + 1
    return np.insert(t, gaps, np.nan), np.insert(y, gaps, np.nan)


def error_lines(summary: Mapping[str, Any]) -> Sequence[str]:
    """The errors as a small table for the console."""
    columns = {"error": "mean_abs_error", "normalised": "mean_abs_error_normalised"}
    if "mean_abs_error_holding_still" in summary:
        columns["holding still"] = "mean_abs_error_holding_still"
    width = max(map(len, [*summary["names"], " " * 8]))
    lines = ["  ".join([" " * width, *(f"{title:>13}" for title in columns)])]
    for i, name in enumerate(summary["names"]):
        lines.append(
            "  ".join(
                [f"{name:{width}}", *(f"{summary[key][i]:13.4f}" for key in columns.values())]
            )
        )
    return lines
