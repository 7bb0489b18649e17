"""`python -m mme_vla.train model=tokendrop_expert`: train a policy (configs/train.yaml)."""

import json
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from mme_vla.config import cli


@cli("train")
def main(cfg: DictConfig) -> None:
    """Train from the beginning, or go on with a run that was interrupted.

    Raises:
        UserError: anything in the settings, the data or a checkpoint that cannot work, before training begins.
    """
    from hydra.core.hydra_config import HydraConfig

    begun = time.perf_counter()
    config = OmegaConf.to_container(cfg, resolve=True)
    assert isinstance(config, dict)
    fresh = Path(HydraConfig.get().runtime.output_dir if HydraConfig.initialized() else config["output"])
    train({str(key): value for key, value in config.items()}, cfg, fresh, begun)


def train(config: dict[str, Any], cfg: DictConfig, folder: Path, begun: float) -> Path:
    """Train as `config` (the plain form of `cfg`) says, in `folder` unless it resumes elsewhere.

    Returns:
        The last checkpoint.
    """
    from accelerate import Accelerator
    from accelerate.utils import broadcast_object_list

    from mme_vla.build import build_from_config
    from mme_vla.data.dataset import collate
    from mme_vla.pretrained import assign_tensors, load_tensors
    from mme_vla.training.checkpoint import check_disk
    from mme_vla.training.console import ProgressLine
    from mme_vla.training.data import check_frozen, prepare_data
    from mme_vla.training.logging import Loggers, open_loggers
    from mme_vla.training.loop import Trainer
    from mme_vla.training.runs import CONFIG, open_run
    from mme_vla.training.settings import TrainSettings
    from mme_vla.training.start import start_from
    from mme_vla.training.validation import Validation

    settings = TrainSettings.from_dict(config["train"], config["seed"])
    accelerator = Accelerator(cpu=settings.device == "cpu")
    chosen: list[Any] = [open_run(folder, config["resume"], config)]
    run = broadcast_object_list(chosen)[0]  # the clock is in the folder's name: the first process decides
    if run.folder != folder:
        with suppress(OSError):
            folder.rmdir()  # Hydra made it for a new run; it stays if it holds anything
    first = accelerator.is_main_process
    line = ProgressLine(settings.steps, run.step, shown=first)
    policy = build_from_config(cfg)
    check_frozen(policy, settings.freeze_vision)
    if run.checkpoint is not None:
        assign_tensors(policy, load_tensors(run.checkpoint), str(run.checkpoint))
        line.say(f"going on from {run.checkpoint}")
    elif config["init_from"]:
        line.say(start_from(policy, config["init_from"]))
    policy.to(accelerator.device)
    with accelerator.main_process_first():
        data = prepare_data(policy, config["data"], config["seed"], run.checkpoint, line.say)
    check_disk(run.folder, policy, settings.keep)
    validation = None
    if data.val is not None and settings.val_samples:
        batch_size = settings.batch_size // (settings.accumulate * accelerator.num_processes)
        validation = Validation(data.val, collate, settings.val_samples, max(batch_size, 1), settings.seed)
    loggers = open_loggers(run.folder, config, run.step) if first else Loggers([])
    trainer = Trainer(policy, data.train, collate, validation, settings, run, config, accelerator, loggers)
    OmegaConf.save(cfg, run.folder / CONFIG, resolve=True)
    line.say(_introduction(trainer, config))
    try:
        with line:
            finished = trainer.run(line)
        if finished and first:
            _finish(trainer, data, line, begun)
    finally:
        loggers.close()
    accelerator.end_training()
    assert trainer.last_checkpoint is not None
    return trainer.last_checkpoint


def _introduction(trainer: Any, config: dict[str, Any]) -> str:
    counts = [p.numel() for p in trainer.policy.parameters() if p.requires_grad]
    total = sum(p.numel() for p in trainer.policy.parameters())
    return (
        f"{config['name']}: {total / 1e6:.2f} M parameters, {sum(counts) / 1e6:.2f} M trained, on "
        f"{trainer.accelerator.device} × {trainer.accelerator.num_processes}; {trainer.run_info.folder}"
    )


def _finish(trainer: Any, data: Any, line: Any, begun: float) -> None:
    """The open-loop check, and a summary on screen and on disk."""
    from mme_vla.training.logging import read_metrics
    from mme_vla.training.open_loop import error_lines, open_loop, plot_open_loop
    from mme_vla.training.runs import SUMMARY
    from mme_vla.training.summary import loss_change

    folder, settings, policy = trainer.run_info.folder, trainer.settings, trainer.policy
    summary: dict[str, Any] = {"steps": settings.steps, **loss_change(read_metrics(folder))}
    line.say(f"loss {summary['first_loss']:.4f} → {summary['last_loss']:.4f}")
    if settings.open_loop_chunks:
        samples = data.train if data.val is None else data.val
        with trainer.ema.applied():
            policy.eval()
            result = open_loop(policy, samples, settings.open_loop_chunks, settings.seed, data.val is not None)
        plot_open_loop(result, folder / "open_loop.png", trainer.config["name"])
        trainer.loggers.picture(settings.steps, "open_loop", folder / "open_loop.png")
        summary["open_loop"] = result.summary()
        line.say("\n".join([f"open loop on {result.title}", *error_lines(summary["open_loop"])]))
        line.say(f"plot: {folder / 'open_loop.png'}")
    summary |= {"checkpoint": str(trainer.last_checkpoint), "seconds": round(time.perf_counter() - begun, 1)}
    (folder / SUMMARY).write_text(json.dumps(summary, indent=2) + "\n")
    line.say(f"{summary['seconds']} s in all; checkpoint: {trainer.last_checkpoint}")


if __name__ == "__main__":
    main()
