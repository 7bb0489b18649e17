"""A dataset, training runs, evaluations, probes and board rows at the smallest sizes, and the
figures that they give.

Every function works in the current folder with relative paths, so that nothing in the files names a
machine.
"""

import csv
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

from net.archives import PACKAGE_PATH, EndedError, command, run
from net.models import PI05, sizes_of, words

DATA = ["data=lerobot", "data.sources=[dataset]", "data.cache.root=cache"]
TRAIN = [
    *DATA, "data.val_episodes=[1]", "logger=none",
    "train.batch_size=2", "train.workers=0", "train.device=cpu", "train.log_every=1",
    "train.save_every=2", "train.warmup=1", "train.ema=0.5", "train.val_samples=2",
    "train.val_every=2", "train.open_loop_chunks=0",
]  # fmt: skip
FRAMESAMP = ["model=framesamp_modul", "memory.budget=32", "memory.grid=2", *words(PI05)]
RUNS = {
    "plain": FRAMESAMP,
    "lora": [
        "model=tokendrop_expert", "memory.budget=80", *words(PI05), "backbone.depth=2",
        "finetune=lora", "finetune.rank=2",
    ],
    "sharded": FRAMESAMP,
}  # fmt: skip
"""Run folder → its words: optimizer and averages in one file each, adapters, and the shards of two
processes.
"""
ROLLOUT = ["max_steps=18", "render=false", "flow_steps=2", "max_batch=1", "workers=1", "device=cpu"]
EVALUATE = [
    "checkpoint=training/plain", "tasks=[PickXtimes,VideoUnmask]", "episodes=1", *ROLLOUT,
    "output=evaluation",
]  # fmt: skip
OFFLINE = ["checkpoint=policy", "recordings=dataset", "recorded=1", "draws=2", "moments=2"]
PROBE = [
    *OFFLINE,
    "flow_steps=2",
    "with=[shuffle,drop:1]",
    "scan=true",
    "device=cpu",
    "output=probe",
]
CARD = ["card", *OFFLINE, "task=VideoUnmask", "episodes=1", *ROLLOUT, "output=card"]
POLICY = "framesamp_modul"
"""The saved model that is probed, as the folder `policy`."""
BOARD = ("pi05", "present_modul", "framesamp_modul")

EARLIER = Path("tests", "data", "compatibility")
"""Where `earlier.tar.xz` has the runs of version 0.1.0: a run keeps the end of its checkpoint's
path.
"""
SHARDS = EARLIER / "evaluation" / "shared"
SHARD = [
    f"checkpoint={EARLIER}/pretrained/groundsg", "episodes=1", "tasks=[PickXtimes,VideoUnmask]",
    *ROLLOUT, "seed=7", "subgoal=oracle", "shard=1/2", f"output={SHARDS}",
]  # fmt: skip
SCRIPTED = EARLIER / "evaluation" / "scripted"


def evaluate_scripted() -> Any:
    """Resume a finished run in the tests' own environment."""
    import mme_vla
    from helpers.scripted_env import make_moving_env

    return mme_vla.evaluate(
        EARLIER / "training" / "framesamp", ["PickXtimes", "VideoUnmask"], 2, seed=3,
        output=SCRIPTED, base=make_moving_env,
        show_progress=False, max_steps=24, flow_steps=2, workers=1, max_batch=1, video="all",
    )  # fmt: skip


def numbers(text: str) -> list[str]:
    """The numbers in what a command prints: its words may change."""
    return re.findall(r"\d+(?:\.\d+)?", text)


def make_dataset() -> None:
    """Two synthetic episodes of 22 and 20 frames, one with a conditioning video."""
    from helpers.h5_files import write_file

    Path("h5").mkdir()
    write_file(
        Path("h5", "record_dataset_PickXtimes.h5"),
        [22, 20],
        [6, 0],
        poses=True,
        depth=True,
        choices=True,
    )
    command("convert", "input=h5", "output=dataset", "images=png")
    shutil.rmtree("h5")


def train() -> None:
    """The runs, each as its second update left it, on a cache that `cache` made."""
    command("cache", *FRAMESAMP, *DATA)
    for name, model_arguments in RUNS.items():
        arguments = [*model_arguments, *TRAIN, "train.steps=2", f"output=training/{name}"]
        if name == "sharded":
            launcher = [
                sys.executable,
                "-m",
                "torch.distributed.run",
                "--standalone",
                "--nproc-per-node",
                "2",
            ]
            variables = {**os.environ, "PYTHONPATH": str(PACKAGE_PATH)}
            launched = [
                *launcher,
                "-m",
                "mme_vla.train",
                *arguments,
                "train.parallel.strategy=fsdp",
            ]
            subprocess.run(launched, check=True, env=variables)
        else:
            command("train", *arguments)


def make_board() -> None:
    """Rows that the repository ships, as rows of one's own."""
    from helpers.published import published_folder

    rows = published_folder("nano16/further")
    for row in BOARD:
        shutil.copytree(rows / row, Path("board", row))
    shutil.copy(rows / "scenes.json", "board")


def losses(folder: Path, after: int = 0) -> dict[str, list[float]]:
    """Losses of a run after an update, of training and validation."""
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    later = [line for line in lines if line["step"] > after]
    return {key: [line[key] for line in later if key in line] for key in ("train/loss", "val/loss")}


def resume(name: str) -> dict[str, list[float]]:
    """Continue a run, in place, for two updates: their losses."""
    command("train", *RUNS[name], *TRAIN, "train.steps=4", f"resume=training/{name}")
    return losses(Path("training", name), after=2)


def first_loss(model: str, checkpoint: Path) -> list[float]:
    """The loss of a saved policy in its first update on the dataset."""
    output = Path("first", model)
    command(
        "train", f"model={model}", *words(sizes_of(model)), *TRAIN, "train.steps=1",
        "train.val_samples=0", "train.batch_size=1", f"init_from={checkpoint}", f"output={output}",
    )  # fmt: skip
    return losses(output)["train/loss"]


def statistics(run: str) -> dict[str, Any]:
    """The statistics that a run's checkpoint holds, and the goals of the dataset."""
    content: dict[str, Any] = json.loads(
        next(Path("training", run).rglob("norm_stats.json")).read_text()
    )
    return content["norm_stats"]


def dataset() -> dict[str, Any]:
    """Episodes, frames and goals of the dataset, and the statistics that a run on it computes."""
    info = json.loads(Path("dataset", "meta", "info.json").read_text())
    printed = "".join(
        command("inspect", "dataset=dataset", f"episode={episode}") for episode in (0, 1)
    )
    command(
        "train",
        *FRAMESAMP,
        *TRAIN,
        "train.steps=1",
        "train.val_samples=0",
        "output=training/statistics",
    )
    return {
        "episodes": info["total_episodes"],
        "frames": info["total_frames"],
        "printed": sorted(
            set(numbers(command("inspect", "dataset=dataset"))) & {"2", "42", "36", "6", "20", "22"}
        ),
        "goals": sorted(goal for goal in ("do task 0", "do task 1") if goal in printed),
        "statistics": statistics("statistics"),
    }


def cached() -> bool:
    """Whether the cache holds every episode."""
    return ": 0 episodes encoded, 2 in all" in command("cache", *FRAMESAMP, *DATA)


def result_rows(folder: str | Path = "evaluation") -> list[dict[str, str]]:
    """The figures that `results` writes of an evaluation of two episodes."""
    command(
        "results",
        folder,
        "--tasks",
        "PickXtimes",
        "VideoUnmask",
        "--episodes",
        "1",
        "--csv",
        "figures.csv",
    )
    with Path("figures.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def verified() -> list[str]:
    """The differences that `results verify` finds, but for the library, the packages and the
    machine, which may be others.
    """
    step = Path("training", "plain", "checkpoints", "step_000002")
    code, out, err = run("results", "verify", "evaluation", "--no-scenes", "--checkpoint", step)
    if code not in (0, 1, 3):
        raise EndedError(err)
    others = ("code", "simulator", "libraries", "renderer", "hardware", "note", "not compared")
    return [line.strip() for line in out.splitlines()[1:] if not line.strip().startswith(others)]


def probed() -> list[str]:
    """The numbers of the table of the finished probe."""
    return numbers(command("probe", "compare=[probe]"))


def card() -> dict[str, Any]:
    """The report card; what is there already is not run again."""
    command("probe", *CARD)
    content: dict[str, Any] = json.loads(Path("card", "card.json").read_text())
    return content


def board() -> list[list[str]]:
    """Name, trainings, success and its parts in the board's lines on the rows of one's own, in
    their order.

    Places and intervals depend on the other rows, which a later version may have more of.
    """
    lines = [
        line.strip("│ ").split("│")
        for line in command("nano", "board", "rows=board", "--samples", "20").splitlines()
    ]
    rows = [[cell.strip() for cell in line] for line in lines]
    return [
        [row[0], *row[2:4], *row[5:9]]
        for row in rows
        if row[0] in [f"{name} (yours)" for name in BOARD]
    ]
