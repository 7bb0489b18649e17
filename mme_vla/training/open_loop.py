"""The open-loop check: predicted against recorded chunks along held-out episodes, as numbers and as a picture."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mme_vla.data.dataset import TrainingDataset, collate
from mme_vla.policy.mme import MMEPolicy
from mme_vla.training.order import generator_for

JOINTS = (*(f"joint {i}" for i in range(1, 8)), "gripper")


@dataclass(frozen=True)
class OpenLoop:
    """Chunks of n steps along one episode.

    steps: [n] frames they start at. predicted, recorded: [n, h, 8] absolute joint angles (rad) and gripper command.
    valid: [n, h] False on actions beyond the episode's end. scale: [8] half the (q01, q99) range of each dimension.
    still: [n, 8] the state held, which a policy that does not move would answer.
    """

    title: str
    steps: np.ndarray
    predicted: np.ndarray
    recorded: np.ndarray
    valid: np.ndarray
    scale: np.ndarray
    still: np.ndarray

    def error(self, predicted: np.ndarray | None = None) -> np.ndarray:
        """Mean absolute error [8] in physical units (radians; gripper −1 … 1)."""
        difference = np.abs((self.predicted if predicted is None else predicted) - self.recorded)
        return (difference * self.valid[..., None]).sum((0, 1)) / self.valid.sum()

    def summary(self) -> dict[str, Any]:
        """The errors, plain: physical and normalised (1 = half the range of the training data's deltas)."""
        physical = self.error()
        still = np.broadcast_to(self.still[:, None], self.recorded.shape)
        return {
            "joints": list(JOINTS),
            "mean_abs_error": physical.round(5).tolist(),
            "mean_abs_error_normalised": (physical / self.scale).round(5).tolist(),
            "mean_abs_error_holding_still": self.error(still).round(5).tolist(),
            "chunks": len(self.steps),
        }


def open_loop(policy: MMEPolicy, samples: TrainingDataset, chunks: int, seed: int, held_out: bool = True) -> OpenLoop:
    """Predict chunks that tile the first of the samples' episodes, at most `chunks` of them.

    Args:
        policy: its averaged weights and mode are the caller's business.
        samples: the held-out steps; or the training steps, where there are none (`held_out` False says so).
    """
    processor = policy.require_processor()
    horizon = policy.backbone.config.horizon
    source, episode, first = samples.locate(0)
    count = int(samples.sources[source].lengths[episode]) - first
    starts = np.arange(0, count, horizon)
    starts = starts[np.linspace(0, len(starts) - 1, min(chunks, len(starts))).round().astype(int)].tolist()
    predicted = []
    generator = generator_for(seed, "open loop")
    for place in (starts[i : i + 8] for i in range(0, len(starts), 8)):
        batch = collate([samples[i] for i in place])
        assert batch.state is not None
        noise = torch.randn(len(place), horizon, policy.backbone.config.action_dim, generator=generator)
        chunk = policy.sample_actions(batch.to(policy.device), noise.to(policy.device)).float().cpu()
        predicted.append(processor.absolute_actions(chunk, batch.state))
    recorded = [samples.step(i) for i in starts]
    stats = processor.stats
    assert stats is not None
    kind = "held-out" if held_out else "training"
    name = samples.sources[source]
    return OpenLoop(
        title=f"{kind} episode {episode} of {name.name}: “{name.goal(episode)}”",
        steps=np.array([step.index for step in recorded]),
        predicted=torch.cat(predicted).numpy(),
        recorded=np.stack([step.actions for step in recorded]),
        valid=np.stack([step.recorded for step in recorded]),
        scale=(stats.actions.q99 - stats.actions.q01) / 2,
        still=np.stack([step.state for step in recorded]),
    )


def plot_open_loop(result: OpenLoop, path: Path, name: str) -> None:
    """Draw the recorded actions as a line and each predicted chunk on top, one panel a joint."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 9.5), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(4, 2, sharex=True).flatten()
    errors, scaled = result.error(), result.error() / result.scale
    time = result.steps[:, None] + np.arange(result.recorded.shape[1])
    for joint, panel in enumerate(panels):
        panel.plot(*_unbroken(time, result.recorded[..., joint], result.valid), color="0.25", lw=2.2, label="recorded")
        for i, valid in enumerate(result.valid):
            chunk = result.predicted[i, valid, joint]
            panel.plot(time[i, valid], chunk, color="tab:orange", lw=1.5, label="predicted chunk" if i == 0 else None)
            panel.plot(time[i, :1], chunk[:1], "o", color="tab:orange", ms=4)
        unit = " rad" if joint < 7 else ""
        panel.set_title(
            f"{JOINTS[joint]}: mean error {errors[joint]:.3f}{unit} ({scaled[joint]:.2f} normalised)",
            fontsize=10, loc="left",
        )  # fmt: skip
        panel.set_ylabel("rad" if joint < 7 else "−1 closed · 1 open", fontsize=9)
        panel.grid(alpha=0.25)
        panel.margins(x=0.01)
    panels[-1].set_ylim(-1.4, 1.4)
    for panel in panels[-2:]:
        panel.set_xlabel("step of the episode; a dot marks where a chunk was predicted", fontsize=9)
    figure.suptitle(f"{name}, open loop on {result.title}", x=0.01, ha="left", fontsize=12)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside lower right", ncols=2, frameon=False)
    figure.savefig(path, dpi=110)


def _unbroken(time: np.ndarray, values: np.ndarray, valid: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Chunks [n, h] as one line that is cut only where no chunk tells what was recorded."""
    t, y = time[valid].astype(float), values[valid].astype(float)
    gaps = np.flatnonzero(np.diff(t) > 1) + 1
    return np.insert(t, gaps, np.nan), np.insert(y, gaps, np.nan)


def error_lines(summary: Mapping[str, Any]) -> Sequence[str]:
    """The errors as a small table for the console."""
    keys = ("joints", "mean_abs_error", "mean_abs_error_normalised", "mean_abs_error_holding_still")
    rows = zip(*(summary[key] for key in keys), strict=True)
    head = f"{'':8}  {'error':>8}  {'normalised':>10}  {'holding still':>13}"
    return [head, *(f"{name:8}  {error:8.4f}  {scaled:10.3f}  {still:13.4f}" for name, error, scaled, still in rows)]
