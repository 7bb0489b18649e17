"""`mme-vla train model=tokendrop_expert`: train a policy (configs/train.yaml)."""

import shlex
import time
from contextlib import AbstractContextManager, ExitStack, closing, nullcontext, suppress
from pathlib import Path
from typing import Any

import torch
from accelerate import Accelerator
from accelerate.utils import DistributedDataParallelKwargs, broadcast_object_list
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from torch import distributed

from mme_vla.config.composition import command_trees
from mme_vla.config.devices import find_device
from mme_vla.errors import UserError, require
from mme_vla.policy.base import Policy
from mme_vla.policy.build import build_from_config, policy_config
from mme_vla.policy.finetune import (
    apply_finetuning,
    cast_frozen,
    copy_tower,
    warn_of_frozen_random_weights,
)
from mme_vla.policy.run_folders import training_name
from mme_vla.policy.tensor_files import take_memory
from mme_vla.policy.training_identity import KEY as TRAINING
from mme_vla.policy.training_identity import identify
from mme_vla.training.checkpoint import check_disk, read_state, restore_weights
from mme_vla.training.data import SplitData, check_frozen, prepare_data
from mme_vla.training.logging import Loggers, ProgressLine, check_logger, open_loggers
from mme_vla.training.loop import Trainer, finish
from mme_vla.training.order import Validation
from mme_vla.training.runs import (
    CONFIG,
    SUMMARY,
    Run,
    check_content,
    claim_run,
    open_run,
    open_trainings,
    start_from,
    weights_to_start_from,
)
from mme_vla.training.settings import TrainRun
from mme_vla.utils import started_processes, write_text


def main(cfg: DictConfig) -> None:
    """Train from the beginning, or continue with a run that was interrupted."""
    begun = time.perf_counter()
    run = TrainRun.from_config(policy_config(cfg))
    folder = Path(run.output).absolute()
    named = True
    if HydraConfig.initialized():
        named = any(word.startswith("output=") for word in HydraConfig.get().overrides.task)
        if not named:
            # a job of a sweep has a folder of its own
            folder = Path(HydraConfig.get().runtime.output_dir)
    try:
        if run.trainings == 1:
            train(run, folder, begun, named)
        else:
            train_several(run, folder, named)
    except UserError:
        with suppress(OSError):
            folder.rmdir()  # Hydra made it; it stays if it holds anything
        raise
    if distributed.is_available() and distributed.is_initialized():
        # all trainings share the group
        distributed.destroy_process_group()


def train_several(run: TrainRun, folder: Path, named: bool) -> None:
    """Train several policies by one recipe, with consecutive seeds, one after the other.

    Each has a numbered folder in `folder`. Finished ones are left as they are, and one that was
    interrupted resumes. All have the vision tower of the first, frozen or to begin with, and so one
    vision cache.

    Args:
        named: as for `train`.

    Raises:
        UserError: a training there by other settings, or a single run.
    """
    folder = open_trainings(folder, run.resume, run.trainings, named)
    for number in range(run.trainings):
        place = folder / training_name(number)
        own = {"seed": run.seed + number, "output": str(place), "resume": "auto"}
        one = TrainRun.from_config({**run.config, **own})
        existing = open_run(place, "auto", one.config, named=True)
        is_finished = (place / SUMMARY).is_file() and existing.step == one.train.steps
        line = f"training {number + 1} of {run.trainings}, seed {one.seed}, in {place}"
        if is_finished:
            print(f"{line}: finished")
            continue
        print(line)
        train(one, place, time.perf_counter(), tower_seed=run.seed)


def train(
    run: TrainRun,
    folder: Path,
    begun: float,
    named: bool = True,
    tower_seed: int | None = None,
) -> Path:
    """Train in `folder`, or where the run lies that is resumed.

    Args:
        run: what to train, and how.
        folder: of a new run.
        begun: when the command began, on the clock of `time.perf_counter`.
        named: whether the user chose the folder's name; another run may have begun in the same
            second.
        tower_seed: of the fresh vision tower, where it is not the training's own.

    Returns:
        The last checkpoint.

    Raises:
        SystemExit: a signal asked it to stop, which it did after saving; the code is 128 and the
            signal's number.
    """
    check_logger(run.logger)
    if run.train.device == "cuda":
        find_device("cuda")  # says so where there is none
    # Where processes have all weights each, gradients lie in what is sent instead of being copied
    # there.
    one_copy = DistributedDataParallelKwargs(gradient_as_bucket_view=True)
    # Accelerate joins processes on CPUs only where it is told that there is nothing else.
    without_gpu = run.train.device == "cpu" or not torch.accelerator.is_available()
    accelerator = Accelerator(cpu=without_gpu, kwargs_handlers=[one_copy])
    check_processes(accelerator.num_processes)
    claimed: list[Any] = [None]
    with ExitStack() as resources:
        if accelerator.is_main_process:
            # the clock is in the folder's name: the first process decides
            claimed[0], lock = claim_run(folder, named, run.resume, run.config)
            resources.push(lock)
        place: Run = broadcast_object_list(claimed)[0]
        if place.folder != folder:
            with suppress(OSError):
                folder.rmdir()  # Hydra made it for a new run; it stays if it holds anything
        trainer = _train(run, place, accelerator, begun, tower_seed)
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
    run: TrainRun, place: Run, accelerator: Accelerator, begun: float, tower_seed: int | None
) -> Trainer:
    """Build the policy, open its data, and train."""
    first = accelerator.is_main_process
    sharded = run.train.parallel.shards(accelerator.device)
    # Of processes that share the weights, one a machine holds them until they are shared: it may
    # have to build a cache.
    has_weights = accelerator.is_local_main_process or not sharded
    line = ProgressLine(run.train.steps, place.step, visible=first)
    policy = build_trainee(run, place, has_weights, line, tower_seed)
    data = open_data(policy, run, place, accelerator, has_weights, line)
    check_disk(place.folder, policy, run.train.keep, sharded)
    config = config_of(run, place)
    digests = {"content": data.content, "side_files": data.side_files}
    saved_config = {**config, "data": {**config["data"], **digests}}
    collate = policy.require_processor().collate
    validation = None
    if data.val is not None and run.train.val_samples:
        piece = run.train.batch_size // (run.train.accumulate * accelerator.num_processes)
        validation = Validation(
            data.val, collate, run.train.val_samples, max(piece, 1), run.train.seed
        )
    settings = config["train"].items()
    recipe = {key: value for key, value in settings if not isinstance(value, dict)}
    trainer = Trainer(
        policy,
        data.train,
        collate,
        validation,
        run.train,
        place,
        saved_config,
        accelerator,
        facts={
            "card": {"data": run.data.name, "recipe": recipe},
            TRAINING: identify(config, data.content),
            "data": {"action_offset": run.data.action_offset},
        },
        name=run.name,
    )
    line.say(trainer.describe())
    if run.train.warmup >= run.train.steps:
        line.say(
            f"train.warmup={run.train.warmup} does not end within train.steps={run.train.steps}:"
            f" no update has the full rate, train.lr={run.train.lr:g}"
        )
    loggers = Loggers()
    if first:
        loggers = open_loggers(place.folder, saved_config, place.step, run.logger)
        write_text(place.folder / CONFIG, OmegaConf.to_yaml(OmegaConf.create(config)))
    with closing(loggers):
        with line:
            finished = trainer.run(line, loggers)
        if finished:
            finish(trainer, data, time.perf_counter() - begun, line, loggers)
        else:
            folder = place.folder if run.trainings == 1 else place.folder.parent
            words = ["mme-vla", "train", *running_words("resume="), f"resume={folder}"]
            line.say(f"Continue by the same command with resume=:\n  {shlex.join(words)}")
    return trainer


def build_trainee(
    run: TrainRun, place: Run, has_weights: bool, line: ProgressLine, tower_seed: int | None
) -> Policy:
    """Build the policy with the weights that it begins or continues with, frozen where it does not
    learn.
    """
    cfg = OmegaConf.create(dict(run.config))
    init_from = None if place.checkpoint is not None else weights_to_start_from(run.init_from)
    # A backbone whose weights are about to be replaced is not initialised first.
    fresh = place.checkpoint is None and init_from is None
    # Without weights, modules are built on meta.
    place_of_modules: AbstractContextManager[object] = nullcontext()
    if not has_weights:
        place_of_modules = torch.device("meta")
    with place_of_modules:
        policy = build_from_config(cfg, fresh_backbone=fresh)
        if fresh and has_weights and tower_seed not in (None, run.seed):
            copy_tower(build_from_config(cfg, seed=tower_seed), policy)
    check_frozen(policy, run.finetune.freeze_vision)
    if init_from is not None and has_weights:
        line.say(start_from(policy, init_from))
    if fresh and line.visible:
        warn_of_frozen_random_weights(run.finetune.mode)
    with place_of_modules:
        apply_finetuning(policy, **vars(run.finetune), seed=run.seed)
    if place.checkpoint is not None:
        if has_weights:
            restore_weights(place.checkpoint, policy)
            cast_frozen(policy, run.finetune.frozen_dtype)
        line.say(f"continuing from {place.checkpoint}")
    return policy


def open_data(
    policy: Policy,
    run: TrainRun,
    place: Run,
    accelerator: Accelerator,
    has_weights: bool,
    line: ProgressLine,
) -> SplitData:
    """Open both sides of the split; the first process builds the vision caches.

    Raises:
        UserError: a run that is resumed began with other data.
    """
    if has_weights:
        take_memory(policy.to(accelerator.device))
    encoder: list[Any] = [None]
    if accelerator.is_main_process and policy.memory is not None:
        encoder[0] = policy.vision_fingerprint()
    encoder = broadcast_object_list(encoder)
    # The command that builds the vision cache of this run: the same words, but for those on
    # resuming and output.
    words = ["mme-vla", "cache", *running_words("resume=", "output=", "trainings=")]
    first_one = accelerator.main_process_first
    if run.data.cache.local:
        first_one = accelerator.local_main_process_first
    with first_one():
        data = prepare_data(
            policy, run.data, run.seed, place.checkpoint, shlex.join(words), line.say, encoder[0]
        )
    if place.checkpoint is not None:
        check_content(place.checkpoint, data.content, data.side_files)
    return data


def running_words(*left_out: str) -> list[str]:
    """The words of the running command, without overrides that begin with one of `left_out`."""
    if not HydraConfig.initialized():
        return ["model=<model>", "data=<data>"]
    words = []
    for tree in command_trees()[1:]:
        words += ["--config-dir", str(tree)]
    for word in HydraConfig.get().overrides.task:
        if not word.startswith(left_out):
            words.append(word)
    return words


def config_of(run: TrainRun, place: Run) -> dict[str, Any]:
    """The configuration that checkpoints keep.

    A resumed command may leave out what the run began with: later checkpoints keep it.
    """
    if place.checkpoint is None:
        return dict(run.config)
    began_with: dict[str, Any] = read_state(place.checkpoint)["config"]
    ranges = {"narrow_ranges": began_with["data"].get("narrow_ranges")}
    values = {"init_from": began_with.get("init_from"), "data": {**run.config["data"], **ranges}}
    return {**run.config, **values}
