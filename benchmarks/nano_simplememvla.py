"""SimpleMemVLA at nano size, with its video or without, on one task by choices: demonstrations,
then training.

python benchmarks/nano_simplememvla.py record --folder data/pick
python benchmarks/nano_simplememvla.py train --folder data/pick --output outputs/video
python benchmarks/nano_simplememvla.py train --folder data/pick --output outputs/no_video --no-video
python benchmarks/nano_simplememvla.py measure --folder data/pick --output
outputs/video/checkpoints/step_000900

Frames are rendered only at decisions and where the video shows them.
`mme-vla evaluate checkpoint=…` evaluates.
"""

import argparse
import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from accelerate import Accelerator

from mme_vla.config.composition import compose, resolved
from mme_vla.embodiment.robomme import embodiment_of
from mme_vla.extras.methods.simplememvla.policy import SimpleMemVlaPolicy
from mme_vla.extras.methods.simplememvla.video import Window
from mme_vla.extras.nano.demonstrations import Demonstration, Scene
from mme_vla.extras.nano.learning import statistics
from mme_vla.extras.nano.runs import Group, demonstrate
from mme_vla.policy.base import Policy
from mme_vla.policy.build import build_from_config
from mme_vla.processing.base import Sample
from mme_vla.training.logging import ProgressLine, open_loggers
from mme_vla.training.loop import Trainer
from mme_vla.training.order import Validation
from mme_vla.training.runs import claim_run
from mme_vla.training.settings import TrainSettings
from mme_vla.types import stack_noise

LEVEL, FIRST_SEED = "easy", 3_000_000
HELD_OUT = 10  # one demonstration in so many only measures the loss
WORDS = (
    "model=simplememvla",
    "backbone=simplememvla_nano",
    "embodiment=robomme_choice_front",
    "embodiment.action.horizon=4",
    "embodiment.action.execute=1",
    "policy.augment=false",
    "train=nano",
    "+train.schedule=cosine",
    "train.lr=1e-3",
    "train.log_every=25",
    "train.val_every=100",
    "train.val_samples=48",
    "train.save_every=100",
)


@dataclass(frozen=True)
class VideoFrames:
    """The frames that a video shows at the decisions of an episode, for `Scene.choices`."""

    window: Window
    every: int = 1

    def read(self, frames: np.ndarray, exec_start: int) -> frozenset[int]:
        """Those shown at any of these frames [n]."""
        return frozenset(
            np.concatenate([self.window.frames(int(frame)) for frame in frames]).tolist()
        )


def composed(*words: str) -> dict[str, Any]:
    """The configuration of a training."""
    return resolved(compose("train", [*WORDS, *words]))


def record(task: str, folder: Path, count: int) -> list[Path]:
    """Demonstrations that succeed, the first so many seeds; existing ones are not made again."""
    config = composed()
    window_section, robot = config["processor"], embodiment_of(config)
    window = Window(window_section["seconds"], window_section["fps"], window_section["native_fps"])
    choices: Any = (VideoFrames(window),)
    folder.mkdir(parents=True, exist_ok=True)
    scene = Scene(
        task, FIRST_SEED, LEVEL, folder, tuple(robot.camera_names), choices, False, robot.action
    )
    return demonstrate(
        [Group((replace(scene, seed=seed) for seed in itertools.count(FIRST_SEED)), count)]
    )


def decisions(policy: SimpleMemVlaPolicy, files: Sequence[Path]) -> list[dict[str, Any]]:
    """Every decision of these demonstrations as a training item."""
    processor, items = policy.require_processor(), []
    camera, action = policy.embodiment.memory_camera, policy.embodiment.action
    for made in map(Demonstration.load, files):
        for place, frame in enumerate(made.motions.decisions.tolist()):
            chunk, recorded = made.motions.chunk(frame, action.horizon)
            video = np.stack([made.images[camera][i] for i in processor.frames(frame).tolist()])
            subtask, none = made.subgoals["simple"][place], np.zeros((0, action.width), np.float32)
            sample = Sample(
                {camera: video}, made.states[frame : frame + 1], made.goal, subtask, none, chunk
            )
            items.append({**processor.item(sample), "action_mask": torch.from_numpy(recorded)})
    return items


def train(files: Sequence[Path], output: Path, words: Sequence[str]) -> None:
    """Train in a folder, or continue there."""
    config = composed(*words)
    resume = str(output) if any((output / "checkpoints").glob("step_*")) else None
    run, lock = claim_run(output, True, resume, config)
    with lock:
        policy: Any = build_from_config(compose("train", [*WORDS, *words]))
        learnt = [file for number, file in enumerate(files, 1) if number % HELD_OUT]
        processor = policy.require_processor()
        processor.stats = statistics(
            (Demonstration.load(file, images=False) for file in learnt), policy
        )
        samples, held_out = (
            decisions(policy, learnt),
            decisions(policy, files[HELD_OUT - 1 :: HELD_OUT]),
        )
        settings = TrainSettings.from_dict(config["train"], int(config["seed"]))
        validation = Validation(
            held_out, processor.collate, settings.val_samples, settings.batch_size, settings.seed
        )
        trainer = Trainer(
            policy,
            samples,
            processor.collate,
            validation,
            settings,
            run,
            config,
            Accelerator(cpu=True),
            name=str(config["name"]),
        )
        line, loggers = ProgressLine(settings.steps, run.step), open_loggers(output, {}, run.step)
        line.say(f"{trainer.describe()}; {len(samples)} decisions of {len(learnt)} demonstrations")
        with line:
            trainer.run(line, loggers)
        loggers.close()


@torch.no_grad()
def measure(files: Sequence[Path], checkpoint: Path) -> None:
    """Print how many held-out decisions have the right option, and how far their points are off."""
    policy: Any = Policy.from_pretrained(str(checkpoint)).eval()
    processor, robot = policy.require_processor(), policy.embodiment.action
    items, rights, distances = decisions(policy, files[HELD_OUT - 1 :: HELD_OUT]), [], []
    for start in range(0, len(items), 16):
        batch = processor.collate(items[start : start + 16])
        generator = torch.Generator().manual_seed(0)
        noise = stack_noise([policy.sampling_noise(generator) for _ in batch.prompts])
        made, meant = (
            processor.absolute_actions(chunk, batch.state)[:, 0]
            for chunk in (policy.sample_actions(batch, noise), batch.actions)
        )
        right = made[:, list(robot.choice)].argmax(1) == meant[:, list(robot.choice)].argmax(1)
        rights += right.tolist()
        distances += (made - meant)[:, list(robot.point)].norm(dim=1).tolist()
    print(f"right option in {sum(rights)} of {len(rights)} decisions; points off by a median of "
          f"{np.median(distances):.3f} of the image's side")  # fmt: skip
    print("".join("x" if right else "." for right in rights))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("command", choices=("record", "train", "measure"))
    parser.add_argument("--folder", type=Path, required=True)
    parser.add_argument("--task", default="PickXtimes")
    parser.add_argument("--count", type=int, default=110)
    parser.add_argument(
        "--output", type=Path, help="of train: a run folder; of measure: a checkpoint"
    )
    parser.add_argument("--no-video", action="store_true")
    parser.add_argument("overrides", nargs="*", help="train.steps=300 …")
    args = parser.parse_intermixed_args()
    files = record(args.task, args.folder, args.count)
    if args.command == "measure":
        measure(files, args.output)
    elif args.command == "train":
        video = f"processor.video={'false' if args.no_video else 'true'}"
        train(
            files, args.output, [video, "train.steps=900", "train.batch_size=16", *args.overrides]
        )


if __name__ == "__main__":
    main()
