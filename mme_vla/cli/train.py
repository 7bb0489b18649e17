"""`python -m mme_vla.train model=tokendrop_expert`: train a policy (configs/train.yaml)."""

import shlex
import time
from contextlib import ExitStack, nullcontext, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from omegaconf import DictConfig, OmegaConf

from mme_vla.cli.command import cli
from mme_vla.config.composition import resolved
from mme_vla.config.devices import find_device
from mme_vla.errors import UserError, require
from mme_vla.utils import remove_drafts, started_processes, write_atomically

if TYPE_CHECKING:
    from mme_vla.training.loop import Trainer
    from mme_vla.training.runs import Run
    from mme_vla.training.settings import TrainSettings


@cli("train")
def main(cfg: DictConfig) -> None:
    """Train from the beginning, or continue with a run that was interrupted."""
    from hydra.core.hydra_config import HydraConfig

    begun, named = time.perf_counter(), True
    config = resolved(cfg)
    fresh = Path(config["output"])
    if HydraConfig.initialized():
        fresh = Path(HydraConfig.get().runtime.output_dir)
        named = any(word.startswith("output=") for word in HydraConfig.get().overrides.task)
    try:
        if config["trainings"] == 1:
            train(cfg, config, fresh, begun, named)
        else:
            train_several(cfg, fresh, config["trainings"])
        from torch import distributed

        if distributed.is_available() and distributed.is_initialized():
            # all trainings share the group
            distributed.destroy_process_group()
    except UserError:
        with suppress(OSError):
            fresh.rmdir()  # Hydra made it; it stays if it holds anything
        raise


def train_several(cfg: DictConfig, folder: Path, count: Any) -> list[Path]:
    """Train several policies by one recipe, with consecutive seeds, one after the other; their last
    checkpoints.

    Each has a numbered folder in `folder`. Finished ones are left as they are, and one that was
    interrupted resumes. All have the vision tower of the first, frozen or to begin with, and so one
    vision cache.

    Raises:
        UserError: a count below 1, or a training there by other settings.
    """
    from mme_vla.policy.run_folders import training_name
    from mme_vla.training.runs import SUMMARY, open_run, unfinished_trainings

    require(
        isinstance(count, int) and count >= 1,
        f"trainings={count!r}: must be a whole number from 1 on.",
    )
    if cfg.resume is not None:
        folder = (
            unfinished_trainings(folder, count) if cfg.resume == "auto" else Path(str(cfg.resume))
        )
    checkpoints = []
    for number in range(count):
        one, place = cfg.copy(), folder / training_name(number)
        one.seed, one.output, one.resume = int(cfg.seed) + number, str(place), "auto"
        config = resolved(one)
        run = open_run(place, "auto", config)
        if (
            (place / SUMMARY).is_file()
            and run.checkpoint is not None
            and run.step == config["train"]["steps"]
        ):
            checkpoints.append(run.checkpoint)
            continue
        print(f"training {number + 1} of {count}, seed {one.seed}, in {place}")
        checkpoints.append(train(one, config, place, time.perf_counter(), tower_seed=int(cfg.seed)))
    return checkpoints


def train(
    cfg: DictConfig,
    config: dict[str, Any],
    folder: Path,
    begun: float,
    named: bool = True,
    tower_seed: int | None = None,
) -> Path:
    """Train as `cfg` says (`config` is its plain form), in `folder` unless it resumes a run
    elsewhere.

    named: whether the user chose the folder's name; another run may have begun in the same second.
    tower_seed: of the fresh vision tower, where it is not the training's own.

    Returns:
        The last checkpoint.

    Raises:
        SystemExit: a signal asked it to stop, which it did after saving; the code is 128 and the
            signal's number.
    """
    import torch
    from accelerate import Accelerator
    from accelerate.utils import DistributedDataParallelKwargs, broadcast_object_list

    from mme_vla.training.logging import check_logger
    from mme_vla.training.runs import claim_run
    from mme_vla.training.settings import TrainSettings

    settings = TrainSettings.from_dict(config["train"], config["seed"])
    check_logger(config)
    if settings.device == "cuda":
        find_device("cuda")  # says so where there is none
    # Where processes have all weights each, gradients lie in what is sent instead of being copied
    # there.
    one_copy = DistributedDataParallelKwargs(gradient_as_bucket_view=True)
    # Accelerate joins processes on CPUs only where it is told that there is nothing else.
    without_gpu = settings.device == "cpu" or not torch.accelerator.is_available()
    accelerator = Accelerator(cpu=without_gpu, kwargs_handlers=[one_copy])
    check_processes(accelerator.num_processes)
    selection: list[Any] = [None]
    with ExitStack() as resources:
        if accelerator.is_main_process:
            # the clock is in the folder's name: the first process decides
            selection[0], lock = claim_run(folder, named, config["resume"], config)
            resources.push(lock)
        run = broadcast_object_list(selection)[0]
        if run.folder != folder:
            with suppress(OSError):
                folder.rmdir()  # Hydra made it for a new run; it stays if it holds anything
        trainer = _train(cfg, config, run, settings, accelerator, begun, tower_seed)
    if trainer.stopped_by is not None:
        raise SystemExit(128 + trainer.stopped_by)
    assert trainer.last_checkpoint is not None
    return trainer.last_checkpoint


def check_processes(joined: int) -> None:
    """Make sure that the processes that a launcher started train one policy together.

    Args:
        joined: processes that Accelerate counts.

    Raises:
        UserError: they are fewer than the launcher started, so that each would train a policy of
            its own.
    """
    started = started_processes()
    require(
        joined >= started,
        f"A launcher started {started} processes (WORLD_SIZE), and each counts {joined}: they would"
        " train as many policies. Use train.device=auto, or start a single process.",
    )


def _train(
    cfg: DictConfig,
    config: dict[str, Any],
    run: "Run",
    settings: "TrainSettings",
    accelerator: Any,
    begun: float,
    tower_seed: int | None,
) -> "Trainer":
    import torch
    from accelerate.utils import broadcast_object_list

    from mme_vla.policy.build import build_from_config
    from mme_vla.policy.capabilities import with_vision_memory
    from mme_vla.policy.finetune import (
        apply_finetuning,
        cast_frozen,
        copy_tower,
        warn_of_frozen_random_weights,
    )
    from mme_vla.policy.tensor_files import take_memory
    from mme_vla.policy.training_identity import KEY as TRAINING
    from mme_vla.policy.training_identity import identify
    from mme_vla.training.checkpoint import check_disk, load_policy, read_state
    from mme_vla.training.data import check_frozen, prepare_data
    from mme_vla.training.logging import Loggers, ProgressLine, open_loggers
    from mme_vla.training.loop import Trainer, finish
    from mme_vla.training.order import Validation
    from mme_vla.training.runs import CONFIG, check_content, start_from, weights_to_start_from

    first = accelerator.is_main_process
    # Of processes that share the weights, one a machine holds them until they are shared: it may
    # have to build a cache.
    sharded = settings.parallel.shards(accelerator.device)
    holds = accelerator.is_local_main_process or not sharded
    line = ProgressLine(settings.steps, run.step, visible=first)
    # A backbone whose weights are about to be replaced is not initialised first.
    init_from = None if run.checkpoint is not None else weights_to_start_from(config["init_from"])
    with nullcontext() if holds else torch.device("meta"):
        policy = build_from_config(cfg, fresh_backbone=run.checkpoint is None and init_from is None)
        if (
            run.checkpoint is None
            and init_from is None
            and tower_seed not in (None, config["seed"])
            and holds
        ):
            copy_tower(build_from_config(cfg, seed=tower_seed), policy)
    check_frozen(policy, config["finetune"]["freeze_vision"])
    if init_from is not None and holds:
        line.say(start_from(policy, init_from))
    if first and init_from is None and run.checkpoint is None:
        warn_of_frozen_random_weights(config["finetune"]["mode"])
    with nullcontext() if holds else torch.device("meta"):
        apply_finetuning(policy, **config["finetune"], seed=config["seed"])
    if run.checkpoint is not None:
        if holds:
            load_policy(run.checkpoint, policy)
            cast_frozen(policy, config["finetune"].get("frozen_dtype"))
        line.say(f"continuing from {run.checkpoint}")
    recipe = {key: value for key, value in config["train"].items() if not isinstance(value, dict)}
    policy.config["card"] = {"data": config["data"]["name"], "recipe": recipe}
    if holds:
        take_memory(policy.to(accelerator.device))
    encoder = broadcast_object_list(
        [with_vision_memory(policy).vision_fingerprint() if first and policy.memory else None]
    )
    local = config["data"]["cache"].get("local", False)
    with accelerator.local_main_process_first() if local else accelerator.main_process_first():
        of_run = (config["data"], config["seed"], run.checkpoint, cache_command(), line.say)
        data = prepare_data(policy, *of_run, encoder[0])
    if run.checkpoint is not None:
        check_content(run.checkpoint, data.content)
        # A resumed command may leave it out. Later checkpoints keep what the run began with.
        then = read_state(run.checkpoint)["config"]
        cfg["init_from"] = config["init_from"] = then.get("init_from")
        if "narrow_ranges" in config["data"]:
            cfg["data"]["narrow_ranges"] = config["data"]["narrow_ranges"] = then["data"].get(
                "narrow_ranges"
            )
    config["data"]["content"] = data.content
    policy.config[TRAINING] = identify(config, data.content)
    check_disk(run.folder, policy, settings.keep, sharded)
    validation, collate = None, policy.require_processor().collate
    if data.val is not None and settings.val_samples:
        batch_size = settings.batch_size // (settings.accumulate * accelerator.num_processes)
        validation = Validation(
            data.val, collate, settings.val_samples, max(batch_size, 1), settings.seed
        )
    trainer = Trainer(policy, data.train, collate, validation, settings, run, config, accelerator)
    line.say(trainer.describe())
    loggers = open_loggers(run.folder, config, run.step) if first else Loggers()
    if first:
        remove_drafts(run.folder)
        with write_atomically(run.folder / CONFIG) as draft:
            OmegaConf.save(cfg, draft, resolve=True)
    try:
        with line:
            finished = trainer.run(line, loggers)
            trainer.close()
        if finished:
            finish(trainer, data, time.perf_counter() - begun, line, loggers)
    finally:
        loggers.close()
    return trainer


def cache_command() -> str:
    """The command that builds the vision cache of this run: the same words, but for those on
    resuming and output.
    """
    from hydra.core.hydra_config import HydraConfig

    from mme_vla.config.composition import command_trees

    running = HydraConfig.initialized()
    overrides = HydraConfig.get().overrides.task if running else ["model=<model>", "data=<data>"]
    words = [
        word for word in overrides if not word.startswith(("resume=", "output=", "trainings="))
    ]
    trees = (
        [part for tree in command_trees()[1:] for part in ("--config-dir", str(tree))]
        if running
        else []
    )
    return shlex.join(["mme-vla", "cache", *trees, *words])
