"""The training loop: update, average, log, validate, save."""

import json
import signal
from collections.abc import Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from functools import partial
from typing import Any

import torch
from accelerate import Accelerator
from torch import Tensor
from torch.utils.data import DataLoader, Dataset

from mme_vla.data.dataset import TrainingDataset
from mme_vla.data.recording import Recording
from mme_vla.errors import UserError, require
from mme_vla.policy.base import Policy
from mme_vla.policy.saving import read_config
from mme_vla.policy.sections import PolicySections
from mme_vla.policy.self_check import SelfCheck, try_self_check
from mme_vla.speed import Recomputes
from mme_vla.speed.compiler import keep_compiled_code, missing_compiler
from mme_vla.training.checkpoint import (
    checkpoint_name,
    restore,
    save_checkpoint,
    save_shards,
    tidy,
    trainable,
)
from mme_vla.training.data import SplitData
from mme_vla.training.logging import Loggers, ProgressLine, Window, read_metrics, resident_gib
from mme_vla.training.open_loop import OpenLoop, error_lines, open_loop, plot_open_loop
from mme_vla.training.optim import (
    EMA,
    WeightUpdate,
    lr_factors,
    make_optimizer,
    scheduled_rate,
)
from mme_vla.training.order import (
    BatchOrder,
    Collate,
    Samples,
    Validation,
    generator_for,
    readers,
    seed_of,
    size_of,
)
from mme_vla.training.parallel import full_value, gathered, reshard, shard
from mme_vla.training.runs import PLOT, SUMMARY, Run
from mme_vla.training.settings import TrainSettings
from mme_vla.training.shards import ShardWriter
from mme_vla.training.stopping import leave_signals_alone, stop_requests
from mme_vla.types import send
from mme_vla.utils import write_text


class _InEpoch(Dataset[Any]):
    """The samples under keys (epoch, index): that is how workers learn the epoch, which random
    items depend on.
    """

    def __init__(self, samples: Samples) -> None:
        self._samples = samples

    def __getitem__(self, key: tuple[int, int]) -> Any:
        epoch, index = key
        if hasattr(self._samples, "set_epoch"):
            self._samples.set_epoch(epoch)
        return self._samples[index]


class Trainer:
    """One training run of one policy. Everything that can fail for the user's reasons fails while
    it is built.
    """

    def __init__(
        self,
        policy: Policy,
        samples: Samples,
        collate: Collate,
        validation: Validation | None,
        settings: TrainSettings,
        run: Run,
        config: Mapping[str, Any],
        accelerator: Accelerator,
        facts: Mapping[str, Any] | None = None,
        name: str = "policy",
    ) -> None:
        """Put the policy on its device, and back to where `run.checkpoint` left it.

        Args:
            policy: with the parameters frozen that shall not learn.
            samples: the training split.
            validation: held-out samples, if any.
            config: the plain configuration, saved with every checkpoint.
            facts: sections that join the policy's own configuration in checkpoints: its training
                and its card.
            name: of the policy, for messages.
        """
        self.settings = settings
        self.run_info = run
        self.config = config
        self.name = name
        self.accelerator = accelerator
        self.validation = validation
        self.facts = dict(facts or {})
        self.order = BatchOrder(
            len(samples),
            settings.batch_size,
            settings.seed,
            range(run.step, settings.steps),
            settings.accumulate,
            accelerator.process_index,
            accelerator.num_processes,
        )
        self.loader = self._loader(samples, collate)
        self.sharded = settings.parallel.shards(accelerator.device)
        if not self.sharded:
            policy.to(accelerator.device)
        self.policy = policy.train()
        _prepare(policy, settings, accelerator.device)
        if self.sharded:
            mesh = settings.parallel.mesh(accelerator.device.type)
            shard(policy, mesh, policy.compute_dtype, settings.compile)
        parameters = trainable(policy)
        factors = lr_factors(parameters, policy.finetune_spec, settings)
        self.optimizer = make_optimizer(parameters.values(), settings, factors)
        self.ema = EMA(parameters, settings.ema, settings.ema_warmup, partial(reshard, policy))
        if run.checkpoint is not None:
            restore(run.checkpoint, policy, self.ema, self.optimizer)
            # The card keeps the last validation's loss until the next one.
            earlier = PolicySections.of(read_config(run.checkpoint)).card
            self._add_results(earlier.get("results"))
        # What an update calls: sharded weights exchange gradients themselves, others through DDP.
        self._replicated = policy if self.sharded else accelerator.prepare_model(policy)
        # What a CPU takes for it was not measured.
        on_gpu = accelerator.device.type == "cuda"
        is_adamw = isinstance(self.optimizer, torch.optim.AdamW)
        one_pass = settings.compile and on_gpu and is_adamw and not self.sharded
        self.update_weights = WeightUpdate(
            parameters, self.optimizer, self.ema, settings.clip_norm, one_pass
        )
        self._shard_writer = ShardWriter() if self.sharded else None
        self.last_checkpoint = run.checkpoint
        self.unchecked: str | None = None
        """Why the last checkpoint has no self-check although it should."""
        self.stopped_by: int | None = None
        """The signal that ended `run` early."""

    def _loader(self, samples: Samples, collate: Collate) -> DataLoader[Any]:
        settings = self.settings
        workers = settings.workers
        ahead = None
        if workers:
            rows = self.order.rows(0)
            batch_bytes = size_of(samples[0]) * (rows.stop - rows.start)
            workers, ahead = readers(workers, batch_bytes, settings.prefetch_gb * 1e9)
        return DataLoader(
            _InEpoch(samples),
            batch_sampler=self.order,
            collate_fn=collate,
            num_workers=workers,
            prefetch_factor=ahead,
            pin_memory=self.accelerator.device.type == "cuda",
            worker_init_fn=leave_signals_alone,
            generator=generator_for(settings.seed, "workers"),
        )

    def describe(self) -> str:
        """What is trained, where, in one line."""
        total = sum(p.numel() for p in self.policy.parameters())
        trained = sum(p.numel() for p in trainable(self.policy).values())
        device = str(self.accelerator.device)
        if self.accelerator.num_processes > 1:
            device = f"{self.accelerator.num_processes} × {device}"
        return (
            f"{self.name}: {total / 1e6:.2f} M parameters,"
            f" {trained / 1e6:.2f} M trained, on {device}, in {self.run_info.folder}"
        )

    def run(self, line: ProgressLine, loggers: Loggers) -> bool:
        """Train to the last step.

        Returns:
            Whether it got there; False when the user or the cluster asked it to stop, which saves a
            checkpoint first.
        """
        settings = self.settings
        if self.run_info.step >= settings.steps:  # killed between its last step and its end
            if self.accelerator.is_main_process:
                tidy(self.run_info.checkpoints, settings.keep)
            return True
        # A finished run that trains on is unfinished until its new end: `resume=auto` finds it.
        (self.run_info.folder / SUMMARY).unlink(missing_ok=True)
        memory = self.policy.memory
        window = Window(settings.batch_size)
        batches = iter(self.loader)
        with stop_requests() as stop:
            for step in range(self.run_info.step, settings.steps):
                done = step + 1
                is_last = done == settings.steps
                saving = is_last or done % settings.save_every == 0
                # A window ends with every checkpoint, so that a resumed run has the same windows.
                logging = saving or done % settings.log_every == 0
                if memory is not None:
                    memory.reporting = logging
                window.add(self.update(step, batches, window))
                if memory is not None:
                    memory.reporting = False
                line.advance()
                stopping = stop() and not is_last
                if logging or stopping:
                    self._log(done, window, line, loggers)
                with window.pause():
                    if is_last or done % settings.val_every == 0:
                        self.validate(done, line, loggers)
                    if saving or stopping:
                        self.save(done, stopping)
                        if self.unchecked is not None:
                            line.say(f"no self-check in the checkpoint: {self.unchecked}")
                if stopping:
                    # Where another process was asked, as a cluster ends a job.
                    self.stopped_by = stop.signal or signal.SIGTERM
                    line.say(f"Stopped at step {done} as asked.")
                    break
        if self._shard_writer is not None:  # the last checkpoint may not be on disk yet
            self._shard_writer.close()
        return self.stopped_by is None

    def update(
        self, step: int, batches: Iterator[Any], window: Window
    ) -> dict[str, Tensor | float]:
        """One optimizer update from the next `accumulate` pieces of `batches`; its metrics,
        detached, unwaited for.
        """
        settings = self.settings
        device = self.accelerator.device
        rate = scheduled_rate(step, settings)
        for group in self.optimizer.param_groups:
            group["lr"] = rate * group.get("lr_factor", 1.0)
        draws = self.policy.training_noise(
            settings.batch_size, generator_for(settings.seed, "train", step)
        )
        # Of the whole update: the images of a sample depend neither on the number of processes nor
        # of pieces.
        generator = generator_for(settings.seed, "model", step, 0, 0)
        draws = {**draws, **self.policy.augmentation_params(settings.batch_size, generator)}
        sums: dict[str, Tensor] = {}
        for piece in range(settings.accumulate):
            with window.waiting():
                batch = next(batches).to(device, non_blocking=True)
            rows = self.order.rows(piece)
            # Whatever else draws (a memory's dropout) takes it from the default generator.
            torch.manual_seed(
                seed_of(settings.seed, "model", step, piece, self.accelerator.process_index)
            )
            piece_draws = {name: send(value[rows], device) for name, value in draws.items()}
            # Gradients add up here, until those of the last piece send them to other processes.
            is_last = piece == settings.accumulate - 1
            apart: AbstractContextManager[object] = nullcontext()
            if self.sharded:
                self.policy.set_requires_gradient_sync(is_last)  # type: ignore[operator]
            elif not is_last:
                apart = self.accelerator.no_sync(self._replicated)
            with apart:
                loss, metrics = self._replicated(batch, piece_draws)
                self.accelerator.backward(loss / settings.accumulate)
            for name, value in metrics.items():
                part = value.detach().float() / settings.accumulate
                sums[name] = sums[name] + part if name in sums else part
        return {**sums, "grad_norm": full_value(self.update_weights(step)), "lr": rate}

    def validate(self, step: int, line: ProgressLine, loggers: Loggers) -> None:
        """Log the loss of the averaged weights on held-out steps, of which every process takes its
        share.
        """
        if self.validation is None:
            return
        with self.ema.applied():
            loss = self.validation.loss(
                self.policy,
                self.accelerator.process_index,
                self.accelerator.num_processes,
                self.accelerator.reduce,
            )
        loggers.write(step, {"val/loss": loss})
        self._add_results({"validation loss": round(loss, 4), "at step": step})
        line.say(f"step {step}/{self.settings.steps} · validation loss {loss:.4f}")

    def _add_results(self, results: Mapping[str, Any] | None) -> None:
        """Put the results of a validation on the card of the next checkpoints."""
        if results is not None:
            self.facts["card"] = {**self.facts.get("card", {}), "results": results}

    def save(self, step: int, stopping: bool = False) -> None:
        """Write a checkpoint: the first process does, or all their parts, which training does not
        wait for.

        Args:
            stopping: the process may be killed before long: what resuming needs comes first.
        """
        check: SelfCheck | None = None
        self.unchecked = None
        # Shared weights come together only at the end of the run.
        if self.settings.self_check and (not self.sharded or step == self.settings.steps):
            with self.ema.applied(), gathered(self.policy):
                if self.accelerator.is_main_process:
                    check, self.unchecked = try_self_check(self.policy)
        folder, keep = self.run_info.checkpoints, self.settings.keep
        saved = (self.policy, self.ema, self.optimizer, self.config, keep, self.facts)
        if self._shard_writer is not None:
            save_shards(self._shard_writer, folder, step, *saved, hurry=stopping, self_check=check)
        else:
            if self.accelerator.is_main_process:
                save_checkpoint(folder, step, *saved, self_check=check)
            self.accelerator.wait_for_everyone()
        self.last_checkpoint = folder / checkpoint_name(step)

    def _log(self, step: int, window: Window, line: ProgressLine, loggers: Loggers) -> None:
        values = window.close(step, self.accelerator.reduce)
        device = self.accelerator.device
        if device.type == "cuda":
            values["memory/gib"] = torch.cuda.max_memory_allocated(device) / 2**30
        else:
            values["memory/gib"] = resident_gib()
        loggers.write(step, values)
        line.numbers(step, values)


def _prepare(policy: Policy, settings: TrainSettings, device: torch.device) -> None:
    """Set what the settings ask of a policy: auxiliary losses, recomputation, compilation.

    Raises:
        UserError: the policy, or this machine, has no such thing.
    """
    if settings.losses:
        require(
            policy.loss_weights is not None,
            f"train.losses: {type(policy).__name__} has no auxiliary losses. Leave it out.",
        )
        policy.loss_weights = dict(settings.losses)
    if settings.recomputation:
        if not isinstance(policy, Recomputes):
            raise UserError(
                f"train.gradient_checkpointing=true: {type(policy).__name__} cannot recompute"
                " activations; set it to false."
            )
        policy.recompute(settings.recomputation)
    if settings.compile:
        missing = missing_compiler(device)
        require(
            missing is None,
            f"train.compile=true needs {missing}: install it, or set train.compile=false.",
        )
        keep_compiled_code()
        policy.compile()


def finish(
    trainer: Trainer, data: SplitData, seconds: float, line: ProgressLine, loggers: Loggers
) -> None:
    """Check the averaged weights open loop, and write `open_loop.png` and `summary.json` into the
    run folder.

    All processes call it, so that shared weights come together; the first does all else.

    Args:
        seconds: what the run took so far, for the summary.
    """
    folder = trainer.run_info.folder
    settings = trainer.settings
    result = None
    if settings.open_loop_chunks:
        result = _check_open_loop(trainer, data, line)
    if not trainer.accelerator.is_main_process:
        return
    summary: dict[str, Any] = {"steps": settings.steps, **loss_change(read_metrics(folder))}
    if result is not None:
        plot_open_loop(result, folder / PLOT, trainer.name)
        loggers.log_image(settings.steps, "open_loop", folder / PLOT)
        errors = result.summary()
        summary["open_loop"] = errors
        line.say("\n".join([f"open loop on {result.title}", *error_lines(errors)]))
        advice = errors["verdict"]
        best = errors["baselines_normalised"][errors["best_baseline"]]
        is_better = sum(errors["mean_abs_error_normalised"]) < sum(best)
        if not is_better:
            advice += (
                f" {settings.steps:,} updates on this data are too few for a policy. They show that"
                " everything runs; raise train.steps, or train on more data, before evaluating."
            )
        line.say(advice)
        line.say(f"plot: {folder / PLOT}")
    summary |= {"checkpoint": str(trainer.last_checkpoint), "seconds": round(seconds, 1)}
    # a run that has one is finished
    write_text(folder / SUMMARY, json.dumps(summary, indent=2) + "\n")
    line.say(
        f"loss {summary['first_loss']:.4f} → {summary['last_loss']:.4f} (means of the updates that"
        " were logged first and last)"
    )
    line.say(f"checkpoint: {trainer.last_checkpoint}")


def _check_open_loop(trainer: Trainer, data: SplitData, line: ProgressLine) -> OpenLoop | None:
    """Compare chunks of the averaged weights with recorded ones, in the first process."""
    samples = data.train if data.val is None else data.val
    if not isinstance(samples, TrainingDataset):
        line.say(
            "no open-loop check: it compares chunks step by step, and these samples are keyframes"
        )
        return None
    settings = trainer.settings
    source, episode, _ = samples.locate(0)
    recording = Recording(samples.sources[source], episode, samples.action_offset)
    kind = "training" if data.val is None else "held-out"
    with trainer.ema.applied(), gathered(trainer.policy):
        if not trainer.accelerator.is_main_process:
            return None
        trainer.policy.eval()
        try:
            return open_loop(
                trainer.policy,
                recording,
                f"{kind} {recording.described}",
                settings.open_loop_chunks,
                settings.seed,
            )
        except UserError as error:
            # The run is finished: data that cannot be shown to the policy do not undo it.
            line.say(f"no open-loop check: {error}")
            return None


def loss_change(lines: Sequence[Mapping[str, Any]]) -> dict[str, float]:
    """The mean training loss over the first and over the last twentieth of a run, in whole lines,
    and the last validation loss.

    Args:
        lines: of `metrics.jsonl`; each holds the mean since the line before it.
    """
    spans: list[tuple[int, int, float]] = []  # from which step to which, and the mean loss
    total = 0
    for line in lines:
        if "train/loss" in line:
            spans.append((total, line["step"], line["train/loss"]))
            total = line["step"]
    if not spans:
        return {}

    def mean(entries: list[tuple[int, int, float]]) -> float:
        weighted = sum((end - begun) * loss for begun, end, loss in entries)
        return weighted / sum(end - begun for begun, end, _ in entries)

    first = [span for span in spans if span[0] < max(0.05 * total, 1)]
    last = [span for span in spans if span[1] > min(0.95 * total, total - 1)]
    change = {"first_loss": mean(first), "last_loss": mean(last)}
    held_out = [line["val/loss"] for line in lines if "val/loss" in line]
    if held_out:
        change["val_loss"] = held_out[-1]
    return change
