"""The end of a run: the open-loop check, what became of the loss, and where everything is."""

import json
from collections.abc import Mapping, Sequence
from typing import Any

from mme_vla.data.dataset import TrainingDataset
from mme_vla.files import write_atomically
from mme_vla.training.console import ProgressLine
from mme_vla.training.data import SplitData
from mme_vla.training.logging import Loggers, read_metrics
from mme_vla.training.loop import Trainer
from mme_vla.training.open_loop import error_lines, open_loop, plot_open_loop
from mme_vla.training.parallel import gathered
from mme_vla.training.runs import PLOT, SUMMARY


def finish(trainer: Trainer, data: SplitData, seconds: float, line: ProgressLine, loggers: Loggers) -> dict[str, Any]:
    """Check the averaged weights open loop, and write `open_loop.png` and `summary.json` into the run folder.

    All processes call it, so that shared weights come together; the first does all else.

    Args:
        seconds: what the run took so far, for the summary.
    """
    folder, settings, policy = trainer.run_info.folder, trainer.settings, trainer.policy
    samples = data.train if data.val is None else data.val
    first, result = trainer.accelerator.is_main_process, None
    if settings.open_loop_chunks and not isinstance(samples, TrainingDataset):
        line.say("no open-loop check: it compares chunks step by step, and these samples are keyframes")
    elif isinstance(samples, TrainingDataset) and settings.open_loop_chunks and (first or trainer.sharded):
        with trainer.ema.applied(), gathered(policy):
            if first:
                policy.eval()
                result = open_loop(policy, samples, settings.open_loop_chunks, settings.seed, data.val is not None)
    if not first:
        return {}
    summary: dict[str, Any] = {"steps": settings.steps, **loss_change(read_metrics(folder))}
    if result is not None:
        plot_open_loop(result, folder / PLOT, trainer.config["name"])
        loggers.picture(settings.steps, "open_loop", folder / PLOT)
        summary["open_loop"] = result.summary()
        line.say("\n".join([f"open loop on {result.title}", *error_lines(summary["open_loop"])]))
        if verdict := worse_than_still(summary["open_loop"], settings.steps):
            line.say(verdict)
        line.say(f"plot: {folder / PLOT}")
    summary |= {"checkpoint": str(trainer.last_checkpoint), "seconds": round(seconds, 1)}
    with write_atomically(folder / SUMMARY) as draft:  # a run that has one is finished
        draft.write_text(json.dumps(summary, indent=2) + "\n")
    line.say(f"loss {summary['first_loss']:.4f} → {summary['last_loss']:.4f} (first and last twentieth of the run)")
    line.say(f"checkpoint: {trainer.last_checkpoint}")
    return summary


def worse_than_still(summary: Mapping[str, Any], steps: int) -> str:
    """A sentence on the numbers that holding still would predict better; empty where there are none.

    Args:
        summary: of the open-loop check; without `mean_abs_error_holding_still` where the state is no action.
        steps: updates of the run.
    """
    if "mean_abs_error_holding_still" not in summary:
        return ""
    pairs = zip(summary["mean_abs_error"], summary["mean_abs_error_holding_still"], strict=True)
    worse = sum(error > still for error, still in pairs)
    if not worse:
        return ""
    return (
        f"{worse} of {len(summary['names'])} numbers of the action are predicted worse than by holding still (the "
        f"robot moves little within a chunk): {steps:,} updates on this data are too few for a policy. They show that "
        "everything runs; raise train.steps, or train on more data, before evaluating."
    )


def loss_change(lines: Sequence[Mapping[str, Any]], share: float = 0.05) -> dict[str, float]:
    """The mean training loss over the first and over the last `share` of a run, and the last validation loss.

    Args:
        lines: of `metrics.jsonl`; each holds the mean since the line before it.
    """
    losses = [(line["step"], line["train/loss"]) for line in lines if "train/loss" in line]
    if not losses:
        return {}
    total = losses[-1][0]
    before = [0, *(step for step, _ in losses[:-1])]
    spans = [(begun, step, loss) for begun, (step, loss) in zip(before, losses, strict=True)]

    def mean(chosen: list[tuple[int, int, float]]) -> float:
        return sum((end - begun) * loss for begun, end, loss in chosen) / sum(end - begun for begun, end, _ in chosen)

    first = [span for span in spans if span[0] < max(share * total, 1)]
    last = [span for span in spans if span[1] > min((1 - share) * total, total - 1)]
    change = {"first_loss": mean(first), "last_loss": mean(last)}
    held_out = [line["val/loss"] for line in lines if "val/loss" in line]
    return {**change, "val_loss": held_out[-1]} if held_out else change
