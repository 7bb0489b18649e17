"""The open-loop check: predicted against recorded chunks along an episode, beside baselines that
know nothing of it, as numbers, as an image and in one sentence.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mme_vla.data.recording import Recording
from mme_vla.errors import require
from mme_vla.policy.base import Policy
from mme_vla.processing.prompt import subgoal_kind
from mme_vla.training.order import seed_of
from mme_vla.utils.style import COLOURS, EXECUTION, FAINT, look

STILL = "holding still"
LAST = "last action"
MEAN = "mean action"
_PHRASES = {STILL: STILL, LAST: f"the {LAST}", MEAN: f"the {MEAN}"}
"""In a sentence."""
ALL = "all"
"""The row of a table that holds means over the numbers."""


@dataclass(frozen=True)
class OpenLoop:
    """Chunks of n steps along one episode.

    title: which episode of which data.
    steps: [n] frames they start at.
    predicted, recorded: [n, h, w] absolute actions of the robot.
    valid: [n, h] False on actions beyond the episode's end.
    scale: [w] half the (q01, q99) range of each number in the training data; 1 where it never
        changes.
    baselines: name → [n, w], the action repeated over a chunk.
    names, units: [w] texts.
    execute: actions of a chunk that are executed before the next one.
    """

    title: str
    steps: np.ndarray
    predicted: np.ndarray
    recorded: np.ndarray
    valid: np.ndarray
    scale: np.ndarray
    baselines: Mapping[str, np.ndarray]
    names: tuple[str, ...]
    units: tuple[str, ...]
    execute: int

    def error(self, predicted: np.ndarray, first: int | None = None) -> np.ndarray:
        """Mean absolute error [w] of chunks [n, h, w] in the units of the actions.

        Args:
            first: actions of each chunk that count; None for all.
        """
        difference = np.abs(predicted - self.recorded)[:, :first]
        valid = self.valid[:, :first]
        return (difference * valid[..., None]).sum((0, 1)) / valid.sum()

    def baseline_error(self, name: str) -> np.ndarray:
        """Mean absolute error [w] of a baseline in the units of the actions."""
        return self.error(np.broadcast_to(self.baselines[name][:, None], self.recorded.shape))

    @property
    def best_baseline(self) -> str:
        """The baseline of the least normalised error over all numbers."""
        means = {name: (self.baseline_error(name) / self.scale).mean() for name in self.baselines}
        return min(means, key=lambda name: means[name])

    def summary(self) -> dict[str, Any]:
        """The errors, plain: physical and normalised (1 = half the range of the training data)."""
        physical = self.error(self.predicted)
        executed = self.error(self.predicted, self.execute)
        baselines = {}
        for name in self.baselines:
            baselines[name] = (self.baseline_error(name) / self.scale).round(5).tolist()
        summary: dict[str, Any] = {
            "episode": self.title,
            "names": list(self.names),
            "mean_abs_error": physical.round(5).tolist(),
            "mean_abs_error_normalised": (physical / self.scale).round(5).tolist(),
            "executed_error_normalised": (executed / self.scale).round(5).tolist(),
            "baselines_normalised": baselines,
            "best_baseline": self.best_baseline,
            "chunks": len(self.steps),
            "execute": self.execute,
            "verdict": self.verdict(),
        }
        if STILL in self.baselines:
            still = self.baseline_error(STILL)
            summary["mean_abs_error_holding_still"] = still.round(5).tolist()
        return summary

    def verdict(self) -> str:
        """What the numbers say, in one sentence: the policy against the best baseline."""
        name = self.best_baseline
        errors = self.error(self.predicted) / self.scale
        best = self.baseline_error(name) / self.scale
        worse = [self.names[d] for d in np.flatnonzero(errors > best)]
        means = (
            f"mean normalised error {errors.mean():.3f}, against {best.mean():.3f} of"
            f" {_PHRASES[name]}"
        )
        if errors.mean() >= best.mean():
            return (
                f"No better than the best baseline: {means}. {len(worse)} of {len(errors)} numbers"
                " are predicted worse."
            )
        if worse:
            return (
                f"Better than every baseline on average: {means}. {len(worse)} of {len(errors)}"
                f" numbers are predicted worse: {', '.join(worse)}."
            )
        return f"Better than every baseline in all {len(errors)} numbers: {means}."


def decisions_of(recording: Recording, execute: int, most: int | None) -> list[int]:
    """The frames at which the policy acts in an open-loop check: every `execute`-th step, as in a
    real episode, spread evenly where they are more than `most`. Each has a recorded action.

    Raises:
        UserError: the episode has none.
    """
    source = recording.source
    episode = recording.episode
    steps = []
    for step in recording.decisions(execute, most):
        _, is_known = source.action_chunk(episode, step, 1, recording.action_offset)
        if is_known.any():
            steps.append(step)
    require(
        steps,
        f"Episode {episode} of {source.name} has no step at which this robot decides and an action"
        " is recorded: choose another episode.",
    )
    return steps


def open_loop(
    policy: Policy,
    recording: Recording,
    title: str,
    most: int | None = None,
    seed: int = 0,
    advance: Callable[[int], object] | None = None,
) -> OpenLoop:
    """Show a recorded episode to a policy as if it were running, and predict a chunk at each step
    at which the robot would ask for one.

    The policy sees what it sees when it acts: every frame once, in order, with states and recorded
    actions. Its memory is filled by the frames, never by its own actions.

    Args:
        policy: with statistics. Its averaged weights are the caller's business.
        recording: whose dataset was opened for the policy's robot.
        title: of the episode, for the reader.
        most: chunks at most; None for one every `execute` steps, as in a real episode. With fewer a
            memory that is written when chunks are chosen (MemoryVLA) is written less often.
        seed: of the noise.
        advance: called with 1 after each chunk.

    Raises:
        UserError: no step to decide at, subgoals that the policy reads and the data lack, or
            states far beyond the training data's.
    """
    space = recording.source.robot.action
    subgoal = subgoal_kind(policy)
    require(
        subgoal is None or subgoal in recording.source.subgoal_names,
        f"This policy reads {subgoal}, and {recording.source.name} has no such column: record its"
        " subgoals, or choose a policy without them.",
    )
    steps = decisions_of(recording, space.execute, most)
    required = policy.frames_read(np.array(steps), recording.exec_start)
    source, number = recording.source, recording.episode
    episode = policy.start_episode(source.goal(number, steps[0]), seed_of(seed, "open loop"))
    predicted: list[np.ndarray] = []
    recorded: list[np.ndarray] = []
    valid: list[np.ndarray] = []
    baselines: dict[str, list[np.ndarray]] = {}
    n_observed = 0
    # A few chunks are not worth compiling for.
    with torch.no_grad(), torch.compiler.set_stance("force_eager"):
        for step in steps:
            recording.show(episode, n_observed, step + 1, required)
            n_observed = step + 1
            # An episode may have several tasks, one after the other.
            episode.goal = source.goal(number, step)
            if subgoal is not None:
                episode.subgoal = source.subgoals(number, step)[subgoal]
            chunk = policy.act(episode)
            actions, is_known = source.action_chunk(
                number, step, len(chunk), recording.action_offset
            )
            predicted.append(chunk)
            recorded.append(actions)
            valid.append(is_known)
            for name, action in _baselines(policy, recording, step).items():
                baselines.setdefault(name, []).append(action)
            if advance is not None:
                advance(1)

    stats = policy.require_processor().require_stats()
    half_range = (stats.actions.q99 - stats.actions.q01) / 2
    return OpenLoop(
        title=title,
        steps=np.array(steps),
        predicted=np.stack(predicted),
        recorded=np.stack(recorded),
        valid=np.stack(valid),
        scale=np.where(half_range > 0, half_range, 1),
        baselines={name: np.stack(rows) for name, rows in baselines.items()},
        names=space.names,
        units=space.units,
        execute=min(space.execute, len(predicted[0])),
    )


def _baselines(policy: Policy, recording: Recording, step: int) -> dict[str, np.ndarray]:
    """What policies that know nothing would answer at a step, [w] each.

    Holding still exists where numbers are relative to the state, or differences to the tool's pose.
    Numbers that are neither (a gripper) keep their last action. Before the first action of an
    episode the last one is what holding still is, else the mean.
    """
    source, number = recording.source, recording.episode
    space = source.robot.action
    state = source.states(number, step, step + 1)[0]
    stats = policy.require_processor().require_stats()
    mean = torch.from_numpy(np.asarray(stats.actions.mean, np.float32))[None]
    expected = space.to_absolute(mean, torch.from_numpy(state))[0].numpy()

    before = source.past_actions(number, step, 1, recording.action_offset)
    last = expected.copy()
    if len(before):
        last = before[-1].copy()
    still = last.copy()
    if space.relative:
        places = list(space.relative)
        still[places] = state[places]
    if space.of_pose:
        still[list(space.of_pose)] = 0
    if not len(before):
        last = still
    if space.relative or space.of_pose:
        return {STILL: still, LAST: last, MEAN: expected}
    return {LAST: last, MEAN: expected}


@look()
def plot_open_loop(result: OpenLoop, path: Path, name: str) -> None:
    """Draw the recorded actions as a line, and each predicted chunk and the best baseline on top,
    one panel a number. What of a chunk is not executed is pale.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    width = len(result.names)
    rows = -(-width // 2)
    height = 2.4 * rows + 1.1
    figure = Figure(figsize=(13, height))
    FigureCanvasAgg(figure)
    # Margins in inches: laying them out by the texts' extents would draw everything twice.
    figure.subplots_adjust(0.06, 0.75 / height, 0.99, 1 - 0.7 / height, wspace=0.14, hspace=0.25)
    panels = figure.subplots(rows, 2, sharex=True, squeeze=False).flatten()
    best = result.best_baseline
    scaled = result.error(result.predicted) / result.scale
    scaled_best = result.baseline_error(best) / result.scale
    time = result.steps[:, None] + np.arange(result.recorded.shape[1])
    known_times, first = np.unique(time[result.valid], return_index=True)
    gaps = np.flatnonzero(np.diff(known_times) > 1) + 1
    labels: dict[str, Any] = {}
    for d, panel in enumerate(panels[:width]):
        # Chunks may overlap: one line, cut only where no chunk tells what was recorded.
        values = result.recorded[..., d][result.valid].astype(float)[first]
        (labels["recorded"],) = panel.plot(
            np.insert(known_times.astype(float), gaps, np.nan),
            np.insert(values, gaps, np.nan),
            color=FAINT,
            lw=2.2,
        )
        for i, valid in enumerate(result.valid):
            known = int(valid.sum())
            executed = min(result.execute, known)
            chunk = result.predicted[i, :known, d]
            # The remainder begins at the last executed action, so that the line is not broken.
            remainder = slice(max(executed - 1, 0), known)
            panel.plot(time[i, remainder], chunk[remainder], color=EXECUTION, lw=1.2, alpha=0.35)
            (labels[f"predicted, {result.execute} actions executed"],) = panel.plot(
                time[i, :executed], chunk[:executed], color=EXECUTION, lw=1.6
            )
            panel.plot(time[i, :1], chunk[:1], "o", color=EXECUTION, ms=4)
            baseline = np.full(executed, result.baselines[best][i, d])
            (labels[f"best baseline: {best}"],) = panel.plot(
                time[i, :executed], baseline, color=COLOURS[0], lw=1.8, ls=":", zorder=4
            )
        panel.set_title(
            f"{result.names[d]}: normalised error {scaled[d]:.2f}, {best} {scaled_best[d]:.2f}",
            fontsize=10,
            loc="left",
        )
        panel.set_ylabel(result.units[d], fontsize=9)
        panel.margins(x=0.01)
    for panel in panels[width:]:
        panel.set_axis_off()
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
    figure.legend(
        list(labels.values()), list(labels), loc="lower right", ncols=len(labels), frameon=False
    )
    figure.savefig(path, dpi=110)


NAME_WIDTH = 18
"""Of the first column of the table; a longer name is cut."""
_COLUMNS = {"normalised": 12, "executed": 10, STILL: 8, LAST: 8, MEAN: 8}
"""Widths of the columns of normalised errors."""
_TITLES = {STILL: "still", LAST: "last", MEAN: "mean"}


def error_lines(summary: Mapping[str, Any]) -> Sequence[str]:
    """The errors as a table of at most 80 columns for the console, one row a number.

    Args:
        summary: of `OpenLoop.summary`.
    """
    names = list(summary["names"])
    columns: dict[str, list[float]] = {
        "normalised": summary["mean_abs_error_normalised"],
        "executed": summary["executed_error_normalised"],
        **summary["baselines_normalised"],
    }
    width = min(max(map(len, [*names, ALL])), NAME_WIDTH)
    header = " " * width + f"{'error':>11}"
    means = f"{ALL:{width}}" + " " * 11
    for title, values in columns.items():
        header += f"{_TITLES.get(title, title):>{_COLUMNS[title]}}"
        means += f"{np.mean(values):{_COLUMNS[title]}.3f}"
    lines = [header]
    for d, name in enumerate(names):
        label = name
        if len(name) > width:
            label = f"{name[: width - 1]}…"
        row = f"{label:{width}}{summary['mean_abs_error'][d]:11.4f}"
        for title, values in columns.items():
            row += f"{values[d]:{_COLUMNS[title]}.3f}"
        lines.append(row)
    return [*lines, means]


LEGEND = (
    "error: in the action's unit, all others normalised (1 = half the range of the training data)."
    " executed: of the actions that are executed. still, last, mean: baselines that repeat the"
    " state, the last action, the mean action of the training data."
)
