r"""Write `tests/data/compatibility`: files of every published format, and what they mean, as this
version has them.

    python scripts/make_compatibility_files.py tests/data/compatibility

Run it at the version whose files later versions have to read, from the root of a clone with the
group `dev`, on a CPU.
`tests/end_to_end/test_compatibility.py` opens the files and compares what it gets with
`expected.json`. Floating-point figures agree to 1e-5 between CPUs, not bitwise. Never regenerate
the folder to make that test pass: a failure means that files of users can no longer be read.

Sizes are far below those of `backbone=tiny`, so that the whole folder has less than 3 MB. Where a
network has parts of a fixed size (Diffusion Policy's ResNet-18, the shipped vision tower of nano)
or is still too large (SAM2Act+, MemoryVLA, OpenVLA-OFT), only the names and shapes of its tensors
are kept, in `tensors.json`, and `fill_tensors` makes the same values again.
"""

import csv
import json
import os
import re
import runpy
import shutil
import socket
import subprocess
import sys
import tempfile
import zlib
from collections.abc import Mapping, Sequence
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any
from unittest import mock

os.environ.setdefault("OMP_NUM_THREADS", "1")

import numpy as np
import torch
from safetensors.torch import load_file, save_file

import mme_vla

REPOSITORY = Path(__file__).resolve().parent.parent
sys.path.append(str(REPOSITORY / "tests"))
from net.models import words  # noqa: E402, beside the tests

TINY = {
    "backbone.vision": {
        "image_size": 16,
        "patch_size": 1,
        "depth": 1,
        "width": 8,
        "mlp_dim": 8,
        "num_heads": 1,
    },
    "backbone.vlm": {"width": 8, "mlp_dim": 8},
    "backbone.action": {"width": 8, "mlp_dim": 8},
    "backbone.depth": 1,
    "backbone.num_heads": 1,
    "backbone.head_dim": 8,
    "backbone.action_dim": 8,
    "backbone.vocab_size": 1024,
}
SHORT = {"budget": 32, "grid": 2}
RECURRENT = {"budget": 32, "position_dim": 48, "max_steps": 3, "max_video": 2, "chunk": 2}
TOWERS = {
    name: {"width": 8, "depth": 2, "mlp_dim": 16, "num_heads": 1} for name in ("dino", "siglip")
}
TWO_TOWERS = {
    "backbone.vision": {"image_size": 56, "patch_size": 7, **TOWERS},
    "backbone.vlm": {"depth": 1, "width": 16, "mlp_dim": 16, "num_heads": 1},
    "backbone.vocab_size": 1024,
}
PRETRAINED: dict[str, tuple[str, dict[str, Any]]] = {
    "pi05_past_actions": ("pi05_past_actions", TINY),
    "groundsg": ("groundsg", TINY),
    "tokendrop_expert": ("tokendrop_expert", {**TINY, "memory": {"budget": 80}}),
    "ttt_context": ("ttt_context", {**TINY, "memory": RECURRENT}),
    "rmt_modul": ("rmt_modul", {**TINY, "memory": RECURRENT}),
    "joined": ("framesamp_ttt_modul", {**TINY, "memory": {"budget": 64}}),
    "hybrid": ("hybrid", {**TINY, "memory": {"budget": 64}}),
}  # fmt: skip
"""Folder → model and settings. One of each kind of policy and of each kind of memory that has
tensors of its own.
"""
NAMES_ONLY: dict[str, tuple[str, dict[str, Any]]] = {
    "diffusion_policy": ("diffusion_policy", {}),
    "sam2act_plus": ("sam2act_plus", {}),
    "memoryvla": ("memoryvla", {
        **TWO_TOWERS,
        "backbone.perceptual_width": 8, "backbone.compression_width": 8,
        "backbone.head": {"width": 16, "depth": 1, "num_heads": 1},
    }),
    "openvla_framesamp": ("openvla_oft_framesamp_context", {
        **TWO_TOWERS, "memory": {"budget": 32, "position_dim": 48},
    }),
    "nano": ("framesamp_modul", {"backbone": "nano", "memory": {"budget": 4, "grid": 1}}),
}  # fmt: skip
"""As `PRETRAINED`, without the values of the weights."""
TRAIN = [
    "data=lerobot",
    "data.val_episodes=[1]",
    "logger=none",
    "train.batch_size=2",
    "train.workers=0",
    "train.device=cpu",
    "train.log_every=1",
    "train.save_every=2",
    "train.warmup=1",
    "train.ema=0.5",
    "train.val_samples=2",
    "train.val_every=2",
    "train.open_loop_chunks=0",
]
RUNS = {
    "framesamp": ["model=framesamp_modul", "memory.budget=32", "memory.grid=2"],
    "lora": [
        "model=tokendrop_expert",
        "memory.budget=80",
        "finetune=lora",
        "finetune.rank=2",
        "backbone.depth=2",
    ],
    "sharded": ["model=framesamp_modul", "memory.budget=32", "memory.grid=2"],
}
"""Run folder → its words: averages and optimizer in one file each, adapters, and the shards of two
processes.
"""
ROLLOUT = [
    "episodes=1",
    "tasks=[PickXtimes,VideoUnmask]",
    "render=false",
    "max_steps=18",
    "flow_steps=2",
    "max_batch=1",
    "workers=1",
    "device=cpu",
]
FINISHED = {"sweep": 1, "scripted": 2, "shared": 1}
"""Folder of runs → episodes of each task."""


def nested(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings as keywords of `build_policy`: dotted keys become mappings."""
    found: dict[str, Any] = {}
    for key, value in settings.items():
        section, _, name = key.partition(".")
        if name:
            found.setdefault(section, {})[name] = value
        else:
            found[section] = value
    return found


def command(name: str, *arguments: str | Path) -> str:
    """Run `mme-vla <name> <arguments>` in this process; what it prints."""
    before, sys.argv = sys.argv, ["mme-vla", name, *map(str, arguments)]
    printed = StringIO()
    try:
        with redirect_stdout(printed), mock.patch.dict(os.environ, COLUMNS="120"):
            runpy.run_module("mme_vla", run_name="__main__")
    except SystemExit as end:
        if end.code not in (None, 0):
            raise RuntimeError(
                f"{name} {' '.join(map(str, arguments))} ended with {end.code}"
            ) from end
    finally:
        sys.argv = before
    return printed.getvalue()


def fill_tensors(shapes: Mapping[str, Sequence[Any]]) -> dict[str, torch.Tensor]:
    """Tensors of these dtypes and shapes whose values follow from their names alone."""
    tensors = {}
    for name, (dtype, shape) in shapes.items():
        rng = np.random.default_rng(zlib.crc32(name.encode()))
        values = rng.uniform(0.01, 0.1, shape) if dtype == "float32" else np.zeros(shape)
        if dtype == "float32" and len(shape) > 1:
            values *= rng.choice([-1.0, 1.0], shape)
        tensors[name] = torch.from_numpy(np.asarray(values)).to(getattr(torch, dtype))
    return tensors


def actions(policy: Any, width: int = 8, depth: bool = False) -> list[Any]:
    """Two chunks of one episode: after a short conditioning video, and four frames later."""
    rng = np.random.default_rng(5)
    episode = policy.start_episode("press the button", seed=3)
    episode.subgoal = "press the button at <10, 20>"
    down = np.array([[0, -1, 0, 0.0], [-1, 0, 0, 0.0], [0, 0, -1, 1.0]], np.float32)
    chunks = []
    for count in (9, 4):
        frames: dict[str, np.ndarray] = {}
        for camera in ("front", "wrist"):
            frames[camera] = rng.integers(0, 256, (count, 64, 64, 3), dtype=np.uint8)
            if depth:
                frames[f"{camera}_depth"] = rng.integers(400, 1000, (count, 64, 64, 1)).astype(
                    np.int16
                )
                frames[f"{camera}_camera_extrinsic"] = np.tile(down, (count, 1, 1))
        state = rng.normal(size=(count, width)).astype(np.float32) * (0.1 if depth else 1)
        episode.observe(
            frames, state, is_demo=np.arange(count) < count - 1 if count == 9 else False
        )
        chunks.append(np.round(np.asarray(policy.act([episode])[0], np.float64), 7).tolist())
    return chunks


def make_dataset(folder: Path, scratch: Path) -> None:
    """Two synthetic episodes as a dataset of images and as one of videos, and the side file of
    first frames.
    """
    from helpers.h5_files import write_file

    recordings = scratch / "h5"
    recordings.mkdir()
    write_file(
        recordings / "record_dataset_PickXtimes.h5",
        [22, 20],
        [6, 0],
        poses=True,
        depth=True,
        choices=True,
    )
    command("convert", f"input={recordings}", f"output={folder / 'dataset'}", "images=png")
    command("convert", f"input={recordings}", f"output={folder / 'dataset_video'}", "names=lerobot",
            "keyframes=true")  # fmt: skip
    command("exec-starts", f"input={recordings}", f"output={folder / 'exec_starts.json'}")


def make_policies(folder: Path) -> None:
    """A `save_pretrained` folder of every kind; weights are perturbed so that no gate is shut."""
    from mme_vla.testing.small import unit_stats

    for place, kinds in (("pretrained", PRETRAINED), ("names", NAMES_ONLY)):
        for name, (model, settings) in kinds.items():
            policy = mme_vla.build_policy(model, **nested(settings))
            policy.require_processor().stats = unit_stats(policy.embodiment)
            generator = torch.Generator().manual_seed(1)
            with torch.no_grad():
                for parameter in policy.parameters():
                    parameter.add_(0.05 * torch.randn(parameter.shape, generator=generator))
            target = folder / place / name
            policy.save_pretrained(target, card={"data": "synthetic"})
            if place == "names":
                keep_names(target)


def keep_names(folder: Path) -> None:
    """Replace the weights of a saved policy by the names, dtypes and shapes of its tensors."""
    tensors = load_file(folder / "model.safetensors")
    shapes = {
        name: [str(value.dtype).removeprefix("torch."), list(value.shape)]
        for name, value in tensors.items()
    }
    (folder / "tensors.json").write_text(json.dumps(shapes) + "\n")
    (folder / "model.safetensors").unlink()
    (folder / "SHA256SUMS").unlink()


def load_named(folder: Path, scratch: Path) -> Any:
    """The policy of a folder with `tensors.json` in place of weights."""
    copy = scratch / folder.name
    shutil.copytree(folder, copy)
    shapes = json.loads((copy / "tensors.json").read_text())
    save_file(fill_tensors(shapes), copy / "model.safetensors")
    return mme_vla.Policy.from_pretrained(copy)


def policy_figures(folder: Path, scratch: Path) -> dict[str, Any]:
    """The chunks of every checkpoint: saved policies, exports, and what runs left."""
    figures: dict[str, Any] = {}
    for path in [
        *sorted((folder / "pretrained").iterdir()),
        *sorted((folder / "training").iterdir()),
    ]:
        figures[str(path.relative_to(folder))] = actions(mme_vla.Policy.from_pretrained(path))
    for path in sorted((folder / "names").iterdir()):
        depth = path.name == "sam2act_plus"
        figures[str(path.relative_to(folder))] = actions(load_named(path, scratch), depth=depth)
    return figures


def export(folder: Path) -> None:
    for target in ("lerobot", "openpi", "released"):
        command("weights", folder / "pretrained" / "pi05_past_actions", folder / "exports" / target,
                "--to", target)  # fmt: skip


def places(folder: Path, cache: Path) -> list[str]:
    """The words of a training command that say where its data are."""
    return [f"data.sources=[{folder / 'dataset'}]", f"data.cache.root={cache}"]


def train(folder: Path) -> None:
    """The run folders, each as its second update left it, and the vision caches that they share."""
    for name, chosen in RUNS.items():
        output = f"output={folder / 'training' / name}"
        arguments = [
            *words(TINY),
            *chosen,
            *TRAIN,
            *places(folder, folder / "cache"),
            "train.steps=2",
            output,
        ]
        if name == "sharded":
            launcher = [
                sys.executable,
                "-m",
                "torch.distributed.run",
                "--standalone",
                "--nproc-per-node",
                "2",
            ]
            subprocess.run(
                [*launcher, "-m", "mme_vla.train", *arguments, "train.parallel.strategy=fsdp"],
                check=True,
            )
        else:
            command("train", *arguments)


def resumed_losses(folder: Path, name: str, chosen: Sequence[str], scratch: Path) -> list[float]:
    """Resume a copy of a run with a copy of the cache: two losses, and the validation losses after
    them.
    """
    run, cache = scratch / "training" / name, scratch / "cache"
    shutil.copytree(folder / "training" / name, run)
    if not cache.exists():
        shutil.copytree(folder / "cache", cache)
    command("train", *chosen, *places(folder, cache), "train.steps=4", f"resume={run}")
    lines = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    later = [line for line in lines if line["step"] > 2]
    keys = ("train/loss", "val/loss")
    return [line[key] for key in keys for line in later if key in line]


def evaluations(folder: Path) -> dict[str, list[str]]:
    """The words of the finished runs of the benchmark's episodes: a sweep over seeds, and two
    shards with subgoals.
    """
    trained, symbolic = (
        f"checkpoint={folder}/training/framesamp",
        f"checkpoint={folder}/pretrained/groundsg",
    )
    return {
        "sweep/7": [trained, *ROLLOUT, "seed=7"],
        "sweep/42": [trained, *ROLLOUT, "seed=42"],
        "shared": [symbolic, *ROLLOUT, "seed=7", "subgoal=oracle", "shard=1/2"],
    }


def evaluate(folder: Path) -> None:
    """Run `evaluations` in the simulator, and episodes in the tests' own environment whose outcomes
    are successes.
    """
    chosen, output = evaluations(folder), folder / "evaluation"
    seeds = [*chosen["sweep/7"][:-1], "seed=7,42"]
    command(
        "evaluate",
        "--multirun",
        *seeds,
        f"output={output}/sweep/${{seed}}",
        f"hydra.sweep.dir={output}/launcher",
    )
    for shard in ("shard=0/2", "shard=1/2"):
        command("evaluate", *chosen["shared"][:-1], shard, f"output={output}/shared")
    evaluate_scripted(folder, output / "scripted")


def evaluate_scripted(folder: Path, output: Path) -> Any:
    """Run, or continue with, four episodes in the tests' own environment, which needs
    no simulator.
    """
    from helpers.scripted_env import make_moving_env

    return mme_vla.evaluate(
        folder / "training" / "framesamp", ["PickXtimes", "VideoUnmask"], 2, seed=3, output=output,
        base=make_moving_env,
        show_progress=False, max_steps=24, flow_steps=2, workers=1, max_batch=1, video="all",
    )  # fmt: skip


def result_rows(folder: Path, episodes: int, scratch: Path) -> list[dict[str, str]]:
    """The figures that `results` writes of all runs in `folder`."""
    table = scratch / "figures.csv"
    command(
        "results",
        folder,
        "--tasks",
        "PickXtimes",
        "VideoUnmask",
        "--episodes",
        str(episodes),
        "--csv",
        table,
    )
    with table.open(newline="") as file:
        return list(csv.DictReader(file))


def probe(folder: Path, output: Path, *more: str) -> str:
    """Probe a checkpoint on the dataset, or continue with it; the table that is printed."""
    return command(
        "probe",
        f"checkpoint={folder / 'training' / 'framesamp'}",
        f"recordings={folder / 'dataset'}",
        "draws=2",
        "moments=2",
        "flow_steps=2",
        "recorded=1",
        "with=[shuffle,drop:1]",
        "scan=true",
        "device=cpu",
        f"output={output}",
        *more,
    )


def numbers(text: str) -> list[str]:
    """The numbers in what a command prints: its words may change."""
    return re.findall(r"\d+(?:\.\d+)?", text)


def probe_figures(folder: Path) -> list[str]:
    """The numbers of the table that `probe compare` prints of a finished probe."""
    return numbers(command("probe", f"compare=[{folder}]"))


def dataset_figures(folder: Path, name: str) -> list[str]:
    """What `inspect` counts in a dataset, whose checksums it compares, with the side file of first
    frames.
    """
    printed = command(
        "inspect", f"dataset={folder / name}", f"exec_starts={folder / 'exec_starts.json'}"
    )
    # Names of the numbers of states and actions are printed by later versions.
    return numbers(
        "\n".join(
            line for line in printed.splitlines() if not line.startswith(("state: ", "action: "))
        )
    )


def nano_tower() -> str:
    """A hash of the vision tower of the shipped checkpoint, as caches depend on it."""
    return str(mme_vla.MMEPolicy.from_pretrained("nano").vision_fingerprint())


def tidy(folder: Path) -> None:
    """Remove what people look at and no command reads, and the names of this machine and its
    folders.
    """
    for place in ("evaluation/launcher", "probe/remembered"):
        shutil.rmtree(folder / place)
    (folder / "probe" / "page.html").unlink()
    for file in (folder / "training").glob("*/summary.json"):
        file.write_text(file.read_text().replace(f"{REPOSITORY}/", ""))
    for claim in (folder / "evaluation" / "shared" / "claims").glob("*.json"):
        claim.write_text(claim.read_text().replace(socket.gethostname(), "host"))


def figures(folder: Path, scratch: Path) -> dict[str, Any]:
    """What every file means: `expected.json`."""
    chosen = {name: [*words(TINY), *run, *TRAIN] for name, run in RUNS.items()}
    return {
        "version": mme_vla.__version__,
        "tolerance": "1e-5: between CPUs the last bits of float32 sums differ",
        "actions": policy_figures(folder, scratch),
        "evaluations": evaluations(folder),
        "success_rate": evaluate_scripted(folder, folder / "evaluation" / "scripted").success_rate,
        "export_words": ["model=pi05_past_actions", "backbone=tiny", *words(TINY)],
        "datasets": {name: dataset_figures(folder, name) for name in ("dataset", "dataset_video")},
        "nano_tower": nano_tower(),
        "probe": probe_figures(folder / "probe"),
        "words": chosen,
        "losses": {
            name: resumed_losses(folder, name, run, scratch) for name, run in chosen.items()
        },
        "results": {
            name: result_rows(folder / "evaluation" / name, count, scratch)
            for name, count in FINISHED.items()
        },
    }


def main(folder: Path) -> None:
    """Write everything below `folder`, a path relative to the repository, that does
    not exist yet.
    """
    os.chdir(REPOSITORY)
    folder.mkdir(parents=True)
    with tempfile.TemporaryDirectory() as place:
        scratch = Path(place)
        make_dataset(folder, scratch)
        make_policies(folder)
        export(folder)
        train(folder)
        evaluate(folder)
        probe(folder, folder / "probe")
        tidy(folder)
        expected = figures(folder, scratch)
    (folder / "expected.json").write_text(json.dumps(expected, indent=1) + "\n")


if __name__ == "__main__":
    if len(sys.argv) != 2:
        raise SystemExit(__doc__)
    main(Path(sys.argv[1]))
