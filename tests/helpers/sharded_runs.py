"""What the processes of test_sharded_training.py do: `python sharded_runs.py <folder>` runs all,
one after the other.

They are forks of one that has imported and composed what they need, which takes longer than what
they do.
"""

import copy
import importlib
import json
import multiprocessing
import os
import signal
import socket
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from accelerate import Accelerator
from torch import Tensor, distributed
from torch.distributed.fsdp import FSDPModule

from helpers.trainings import RECIPE, Samples, collate, policy
from mme_vla.policy.base import Policy
from mme_vla.policy.build import build_policy
from mme_vla.policy.finetune import apply_finetuning
from mme_vla.policy.run_folders import resolve_checkpoint
from mme_vla.testing.small import open_gates
from mme_vla.training.checkpoint import trainable
from mme_vla.training.logging import Loggers, ProgressLine, open_loggers
from mme_vla.training.loop import Trainer
from mme_vla.training.optim import clip_gradients, make_optimizer
from mme_vla.training.order import Validation
from mme_vla.training.parallel import full_value, gathered, shard
from mme_vla.training.runs import Run
from mme_vla.training.settings import ParallelSettings, TrainSettings
from mme_vla.training.shards import shard_files

RUNS = [(2, "train,stop,policies,die"), (1, "go_on"), (3, "resume"), (1, "whole")]
"""How many processes do what one after the other; starting them takes longer than what they do, so
few do much.
"""
MODELS = (
    "tokendrop_expert",
    "diffusion_policy",
    "openvla_oft_tokendrop_context",
    "memoryvla",
    "sam2act_plus",
    "simplememvla",
)
SHARDED = {"parallel": {"strategy": "fsdp"}}
BATCH = 6  # of two and of three processes


def trainer(folder: Path, steps: int, resumed: bool = False, **changes: Any) -> Trainer:
    built = policy("tokendrop_expert", policy={"augment": False})
    run = Run(folder)
    if resumed:
        checkpoint = resolve_checkpoint(folder)
        run = Run(folder, checkpoint, int(checkpoint.name.removeprefix("step_")))
    recipe = {**RECIPE, "batch_size": BATCH, "steps": steps, "save_every": 2, **changes}
    validation = Validation(Samples(built, 5), collate, 5, 2, seed=1)
    settings = TrainSettings.from_dict(recipe, seed=1)
    config = {"train": recipe, "seed": 1}
    return Trainer(
        built, Samples(built), collate, validation, settings, run, config, Accelerator(cpu=True)
    )


def finish_run(job: Trainer, line: ProgressLine | None = None) -> bool:
    first, run = job.accelerator.is_main_process, job.run_info
    loggers = open_loggers(run.folder, {}, run.step) if first else Loggers()
    with line or ProgressLine(job.settings.steps, 0, visible=False) as progress:
        return job.run(progress, loggers)


def validation_losses(job: Trainer) -> dict[str, float]:
    """With the weights themselves, and with their averages."""
    share = (job.accelerator.process_index, job.accelerator.num_processes, job.accelerator.reduce)
    assert job.validation is not None
    raw = job.validation.loss(job.policy, *share)
    with job.ema.applied():
        return {"raw": raw, "average": job.validation.loss(job.policy, *share)}


def train(folder: Path) -> dict[str, Any]:
    """Train sharded to step 4, with a checkpoint at 2 and 4 that is written while it continues."""
    job = trainer(folder / "run", 4, **SHARDED)
    assert finish_run(job) and isinstance(job.policy, FSDPModule)
    n_local = sum(p.to_local().numel() for p in trainable(job.policy).values())
    n_total = sum(p.numel() for p in trainable(job.policy).values())
    return {"held": n_local / n_total, **validation_losses(job)}


class Interrupted(ProgressLine):
    """One of the processes is asked to stop after its first update."""

    def advance(self) -> None:
        if distributed.get_rank() == 1:
            os.kill(os.getpid(), signal.SIGTERM)


def stop(folder: Path) -> dict[str, Any]:
    job = trainer(folder / "stopped", 4, **SHARDED)
    finished = finish_run(job, Interrupted(4, 0, visible=False))
    return {"finished": finished, "signal": job.stopped_by}


class Killed(ProgressLine):
    def advance(self) -> None:
        if distributed.get_rank() == 1:
            os.kill(os.getpid(), signal.SIGKILL)


def die(folder: Path) -> None:
    finish_run(trainer(folder / "killed", 4, **SHARDED), Killed(4, 0, visible=False))


def update_of(model: Policy, batch: Any, draws: dict[str, Tensor]) -> tuple[float, float, float]:
    """The loss of an update, its gradients' norm, and the loss after it."""
    settings = TrainSettings.from_dict({**RECIPE, "lr": 1e-3})
    optimizer = make_optimizer(trainable(model).values(), settings)
    torch.manual_seed(3)
    loss, numbers = model(batch, draws)
    loss.backward()
    gradients = [p.grad for p in trainable(model).values() if p.grad is not None]
    norm = full_value(clip_gradients(gradients, 1.0))
    optimizer.step()
    optimizer.zero_grad()
    torch.manual_seed(3)
    with torch.no_grad():
        after, _ = model(batch, draws)
    return float(numbers["loss"]), float(norm), float(after)


def compare(name: str, dtype: str) -> dict[str, Any]:
    """One update of a model alone and sharded, and a chunk that it then returns."""
    alone = build_policy(name, policy={"compute_dtype": dtype, "augment": False})
    if hasattr(alone, "backbone") and hasattr(alone, "integration"):
        open_gates(alone)  # type: ignore[arg-type]
    apply_finetuning(alone)
    alone.recompute(True)
    alone.train()
    shared = copy.deepcopy(alone)
    shard(shared, ParallelSettings("fsdp").mesh("cpu"), shared.compute_dtype)
    batch = alone.full_batch()
    draws = alone.training_noise(1, torch.Generator().manual_seed(1))
    start = alone.sampling_noise(torch.Generator().manual_seed(2))
    draws_ = {key: value[None] for key, value in start.items()}
    results: dict[str, Any] = {}
    for which, model in (("alone", alone), ("shared", shared)):
        if model is alone and distributed.get_rank():
            continue  # the first process's is enough
        results[which] = update_of(model, batch, draws)
        with gathered(model.eval()):
            chunk = model.sample_actions(batch, draws_, steps=2)
        results[f"{which} chunk"] = chunk.float().abs().mean().item()
    with torch.no_grad():  # sampling left it as it was
        torch.manual_seed(3)
        loss, _ = shared.train()(batch, draws)
    return {**results, "again": float(loss)}


def policies(folder: Path) -> dict[str, Any]:
    low = compare("framesamp_modul", "bfloat16")
    return {**{name: compare(name, "float32") for name in MODELS}, "framesamp_modul bfloat16": low}


def go_on(folder: Path) -> dict[str, Any]:
    """One process continues, from the parts of two."""
    parts = len(shard_files(resolve_checkpoint(folder / "run")))
    return {"parts": parts, "finished": finish_run(trainer(folder / "run", 6, resumed=True))}


def whole(folder: Path) -> dict[str, Any]:
    job = trainer(folder / "whole", 8)
    assert finish_run(job)
    return validation_losses(job)


def resume(folder: Path) -> dict[str, Any]:
    # gradients travel with the last piece
    job = trainer(folder / "run", 8, resumed=True, accumulate=2, **SHARDED)
    assert finish_run(job)
    return validation_losses(job)


DONE: dict[str, Callable[[Path], Any]] = {
    "train": train,
    "stop": stop,
    "die": die,
    "policies": policies,
    "go_on": go_on,
    "resume": resume,
    "whole": whole,
}


def rank(number: int, processes: int, port: int, what: str, folder: Path) -> None:
    """One of the processes, as torchrun starts them, without its half a minute of patience."""
    if processes > 1:
        shared = {
            "MASTER_ADDR": "127.0.0.1",
            "MASTER_PORT": port,
            "WORLD_SIZE": processes,
            "RANK": number,
        }
        shared |= {"LOCAL_WORLD_SIZE": processes, "LOCAL_RANK": number}
        os.environ.update({key: str(value) for key, value in shared.items()})
        Accelerator(cpu=True)  # joins the others
    for name in what.split(","):
        result = DONE[name](folder)
        if number == 0:
            (folder / f"{name}.json").write_text(json.dumps(result))
    if processes > 1:
        distributed.destroy_process_group()


def prepare() -> None:
    """Import and compose what the processes would each for themselves."""
    for module in (
        "diffusers",
        "torchvision",
        "timm",
        "transformers.models.llama.modeling_llama",
        "transformers.models.qwen3_5.modeling_qwen3_5",
    ):
        importlib.import_module(module)
    for name in (*MODELS, "framesamp_modul"):
        build_policy(name, device="meta", policy={"compute_dtype": "float32", "augment": False})


def main(folder: Path) -> None:
    torch.set_num_threads(1)
    prepare()
    fork = multiprocessing.get_context("fork")
    ended = {}
    for count, what in RUNS:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            port = free.getsockname()[1]
        started = [
            fork.Process(target=rank, args=(number, count, port, what, folder))
            for number in range(count)
        ]
        for process in started:
            process.start()
        for process in started:
            process.join()
        ended[what] = [process.exitcode for process in started]
    (folder / "ended.json").write_text(json.dumps(ended))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
