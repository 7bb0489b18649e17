"""One policy of a nano run: built, trained on demonstrations, and evaluated in closed loop; each once."""

import hashlib
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import OmegaConf

from mme_vla.config.composition import compose, import_plugins, resolved
from mme_vla.config.plugins import plugins_of
from mme_vla.errors import UserError
from mme_vla.memory.transforms import build_transforms
from mme_vla.nano.demonstrations import Demonstration
from mme_vla.nano.learning import Decisions, position_error, statistics
from mme_vla.policy.build import build_from_config
from mme_vla.policy.finetune import apply_finetuning, copy_tower
from mme_vla.policy.mme import MMEPolicy, mme_of
from mme_vla.policy.run_folders import training_name
from mme_vla.policy.training_identity import KEY as TRAINING
from mme_vla.policy.training_identity import identify
from mme_vla.processing.normalise import NormStats
from mme_vla.processing.processor import STATS_FILE
from mme_vla.training.checkpoint import checkpoints_in
from mme_vla.training.logging import ProgressLine, open_loggers
from mme_vla.training.loop import Trainer
from mme_vla.training.order import Validation
from mme_vla.training.runs import claim_run
from mme_vla.training.settings import TrainSettings
from mme_vla.utils import read_lines, write_json

DONE = "trained.json"
HELD_OUT = 10  # One demonstration in so many only measures the loss


def compose_policy(
    model: str,
    memories: Mapping[str, Mapping[str, Any]],
    words: Sequence[str],
    extra_dirs: Sequence[Path] = (),
    plugins: Sequence[str] = (),
    budget: int | None = None,
) -> dict[str, Any]:
    """Compose one model at nano size, as plain values, and import its plugins.

    model: a file of configs/model. memories: settings of each memory by its name, used where the model has it. words:
    overrides that all models share, such as `embodiment=robomme_waypoint_front`. extra_dirs: further trees, as
    `--config-dir` adds them. plugins: modules that the model needs beside its own. budget: memory tokens, instead of
    those of `memories`.
    """
    base = compose("policy", [f"model={model}", *words], extra_dirs=extra_dirs)
    memory = None if base.memory is None else str(base.memory.name)
    settings = {**memories.get(memory or "", {}), **({} if budget is None or memory is None else {"budget": budget})}
    memory_words = [f"memory.{key}={value}" for key, value in settings.items()]
    composed = compose("policy", [f"model={model}", *words, *memory_words], extra_dirs=extra_dirs)
    composed.plugins = list(dict.fromkeys([*plugins, *plugins_of(composed, model)]))
    import_plugins(composed)
    return resolved(composed)


def build(config: Mapping[str, Any]) -> MMEPolicy:
    """A policy with fresh weights but for its tower, which does not learn."""
    policy = mme_of(build_from_config(OmegaConf.create(dict(config))), "nanoMME")
    if policy.augment:
        raise UserError("policy.augment=true changes images, and nano policies learn from tokens: set it to false.")
    apply_finetuning(policy, freeze_vision=True)
    return policy


def train_all(
    config: Mapping[str, Any],
    settings: Mapping[str, Any],
    folder: Path,
    files: Sequence[Path],
    learning: Mapping[str, Any],
    trainings: int = 1,
) -> list[Path]:
    """Train policies with consecutive seeds, or continue with them; the last checkpoints.

    One is trained in `folder`, several in numbered folders of it. They share the tokens. The others: see `train`.
    """
    if trainings == 1:
        return [train(config, settings, folder, files, learning)]
    seed = int(config["seed"])
    return [
        train({**config, "seed": seed + i}, settings, run, files, learning, tokens=folder, tower_seed=seed)
        for i, run in enumerate(training_folders(folder, trainings))
    ]


def training_folders(folder: Path, trainings: int) -> list[Path]:
    """The run folders of a row of the page."""
    return [folder] if trainings == 1 else [folder / training_name(number) for number in range(trainings)]


def train(
    config: Mapping[str, Any],
    settings: Mapping[str, Any],
    folder: Path,
    files: Sequence[Path],
    learning: Mapping[str, Any],
    *,
    tokens: Path | None = None,
    tower_seed: int | None = None,
) -> Path:
    """Train a policy in `folder`, or continue with it; the last checkpoint.

    config: as `compose_policy` gives it. settings, learning: the sections `train` and `learning`. files:
    demonstrations; one in `HELD_OUT` only measures the loss. tokens: folder of the decisions' tokens, by default
    `folder`. tower_seed: of the tower's weights where they are fresh, by default the training's.
    """
    from accelerate import Accelerator

    if (folder / DONE).is_file():
        return checkpoints_in(folder / "checkpoints")[-1]
    begun, cpu = time.perf_counter(), time.process_time()
    train_settings = TrainSettings.from_dict(settings, int(config["seed"]))
    full_config = {**config, "train": dict(settings), "learning": dict(learning)}
    resume = str(folder) if checkpoints_in(folder / "checkpoints") else None
    folder.mkdir(parents=True, exist_ok=True)
    run, lock = claim_run(folder, True, resume, full_config)
    with ExitStack() as resources:
        resources.push(lock)  # it is held already
        policy = build(config)
        if tower_seed not in (None, int(config["seed"])):
            copy_tower(build({**config, "seed": tower_seed}), policy)
        samples, val_set = prepared(policy, tokens or folder, files, learning, int(config["seed"]))
        policy.config[TRAINING] = identify(full_config, content_of(files))
        policy.config["card"] = {"data": f"{len(files)} demonstrations", "recipe": dict(settings)}
        validation = Validation(
            val_set, val_set.collate, train_settings.val_samples, train_settings.batch_size, train_settings.seed
        )
        trainer = Trainer(
            policy, samples, samples.collate, validation, train_settings, run, full_config, Accelerator(cpu=True)
        )
        line, loggers = ProgressLine(train_settings.steps, run.step), open_loggers(folder, {}, run.step)
        line.say(f"{trainer.describe()}; {len(samples)} decisions of {len(files)} demonstrations")
        try:
            with line:
                finished = trainer.run(line, loggers)
        finally:
            loggers.close()
    assert trainer.last_checkpoint is not None
    if not finished:
        raise SystemExit(128 + (trainer.stopped_by or 0))
    off = position_error(MMEPolicy.from_pretrained(str(trainer.last_checkpoint)).eval(), val_set)
    spent = {"minutes": (time.perf_counter() - begun) / 60, "cpu_minutes": (time.process_time() - cpu) / 60}
    write_json(
        folder / DONE, {"steps": train_settings.steps, "decisions": len(samples), "off_by_m": off.tolist(), **spent}
    )
    return trainer.last_checkpoint


def content_of(files: Sequence[Path]) -> list[str]:
    """Digests of demonstrations: of their states and motions, whichever frames are rendered."""
    digests = []
    for file in files:
        made = Demonstration.load(file, images=False)
        parts = (made.states, made.motions.decisions, made.motions.targets)
        digests.append(hashlib.sha256(b"".join(np.ascontiguousarray(part).tobytes() for part in parts)).hexdigest())
    return digests


def prepared(
    policy: MMEPolicy, folder: Path, files: Sequence[Path], learning: Mapping[str, Any], seed: int = 0
) -> tuple[Decisions, Decisions]:
    """Decisions to learn from, and to measure by; their tokens, and the statistics, are made once for a folder.

    With history transforms the tokens of all frames stay in memory, and are made anew for each training. seed: of these
    transforms, which do not change the decisions to measure by.
    """
    learnt_file, val_file, stats_file = (
        folder / name for name in ("learnt.safetensors", "held_out.safetensors", STATS_FILE)
    )
    options = {"oversample": learning["often"], "noise": learning["noise"], "token_noise": learning["blur"]}
    processor = policy.require_processor()
    transforms = build_transforms(learning.get("history_transforms"))
    if val_file.is_file() and not transforms:  # written last
        processor.stats = NormStats.load(stats_file)
        return Decisions.load(learnt_file, **options), Decisions.load(val_file)
    learnt = [file for number, file in enumerate(files, 1) if number % HELD_OUT] if len(files) > 1 else files
    processor.stats = statistics((Demonstration.load(file, images=False) for file in learnt), policy)
    processor.stats.save(stats_file)
    distance = learning["elsewhere"]
    samples = Decisions.of(
        policy, map(Demonstration.load, learnt), min_distance=distance, transforms=transforms, seed=seed, **options
    )
    held_out = files[HELD_OUT - 1 :: HELD_OUT] or files[-1:]
    val_set = Decisions.of(policy, map(Demonstration.load, held_out), min_distance=distance)
    if not transforms:
        samples.save(learnt_file)
        val_set.save(val_file)
    return samples, val_set


def learning_curve(folder: Path) -> list[dict[str, float]]:
    """What the run logged, a dictionary a line."""
    return read_lines(folder / "metrics.jsonl", dict, "the log of a run")
