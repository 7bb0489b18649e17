"""Does the memory work? A stream whose target was visible only in the conditioning video.

    # every neural variant and pi05, two at a time
    python examples/memory_matters.py
    python examples/memory_matters.py framesamp_modul --seconds 60
    # a memory of your own, with its own options
    python examples/memory_matters.py my_model --config-dir configs

In the video a square of one of four colours passes over the scene; when execution begins it is
gone, and the right action depends on its colour alone. The current view, the goal and the state say
nothing, so a policy without memory can only guess: `pi05` is always trained beside what is named.
Prints the open-loop error of each policy on 32 episodes it has not seen, and draws it with its
interval over these episodes.

The recipe is the same for all: 64 memory tokens, remembered frames of 4×4 tokens; all but FrameSamp
read every 4th frame, recurrent ones pad to no chunk; RMT has 16 slots and attends in float32. At
first a slot reads every token and every slot alike, and slots begin at random: with many slots and
few tokens the frame is a small part of what a slot takes in, and what all slots have in common is
learned late.

The memories beyond the paper can be named too (`retrieval_modul`); what they change is in
`OF_KIND`. In the video the arm leans aside, for each colour its own way: that is all that the
memory `actions` is told, and `spacetime` beside its images.
"""

import argparse
import json
import multiprocessing
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mme_vla import build_policy
from mme_vla.cli.errors import print_user_errors
from mme_vla.config.composition import compose
from mme_vla.evaluation.results.statistics import percentiles, resampled_means
from mme_vla.memory.base import stack_history
from mme_vla.memory.history import CachedHistory
from mme_vla.policy.mme import MMEPolicy
from mme_vla.processing.images import past_views, stack_past
from mme_vla.testing.small import ALL_BEYOND, NEURAL, cached_history
from mme_vla.types import Batch, PastViews
from mme_vla.utils.style import COLOURS as SERIES
from mme_vla.utils.style import FAINT, INK, figure, legend, svg

COLOURS = np.array([[220, 40, 40], [40, 200, 60], [50, 70, 230], [230, 210, 40]], np.uint8)
ANSWERS = np.array(
    [
        [1, 1, 1, 1, -1, -1, -1, -1],
        [1, -1, 1, -1, 1, -1, 1, -1],
        [-1, -1, 1, 1, 1, 1, -1, -1],
        [-1, 1, 1, -1, -1, 1, 1, -1],
    ],
    np.float32,
)
SIZE, SQUARE = 64, 40  # pixels
VIDEO, LENGTH = 8, 12  # frames of conditioning video, and of the whole episode
MEMORYLESS = "pi05"
INTEGRATIONS = {"modul": SERIES[0], "context": SERIES[1], "expert": SERIES[2]}
MEMORY = {"budget": 64, "grid": 4}
OF_KIND: dict[str, dict[str, Any]] = {
    "framesamp": {},
    "tokendrop": {"stride": 4},
    "ttt": {"stride": 4, "chunk": 1},
    "rmt": {"stride": 4, "chunk": 1, "budget": 16, "attention_dtype": "float32"},
    "retrieval": {"every": 1, "cut": -1.0, "longest": 4},
    "moment": {"stride": 4},
    "gist": {"stride": 2, "anchors": 1, "recent": 1},
    "learned_topk": {"pool": LENGTH},
    "anchors": {},
    "events": {"stride": 1, "gripper": 0.15},
    "pyramid": {"strides": [1, 4], "budget": 96},
    "keyframes": {"every": 2, "pool": LENGTH // 2 + 1, "budget": 96},
    "actions": {
        "stride": 1,
        "max_steps": LENGTH,
        "max_video": VIDEO,
        "chunk": 4,
        "budget": 4,
        "grid": None,
    },
    "spacetime": {"frames": 6, "stride": 2, "every": 1, "budget": None, "grid": None},
}


@dataclass
class Stream:
    """One synthetic episode: its colour, its frames [t, h, w, 3], what the arm felt and did [t,
    17], and its tokens.
    """

    colour: int
    frames: np.ndarray
    motion: torch.Tensor
    history: CachedHistory | None = None


def memory_options(model: str) -> dict[str, Any]:
    """What this demonstration changes in the shipped memory of a model."""
    if model not in (*NEURAL, *ALL_BEYOND):
        return {}
    options = MEMORY | OF_KIND[model.rsplit("_", 1)[0]]
    return {name: value for name, value in options.items() if value is not None}


def models_of(named: Sequence[str]) -> list[str]:
    """What is trained: the models that are named, and the one without memory to hold
    them against.
    """
    return list(dict.fromkeys([*named, MEMORYLESS]))


def make_stream(rng: np.random.Generator) -> Stream:
    """A grey scene; in all but the first and the last frame of the video a coloured square wanders
    over it.
    """
    frames = np.full((LENGTH, SIZE, SIZE, 3), 110, np.uint8)
    colour = int(rng.integers(len(COLOURS)))
    y, x = rng.integers(0, SIZE - SQUARE, 2)
    for t in range(1, VIDEO - 1):
        top, left = (y + 2 * t) % (SIZE - SQUARE), (x + t) % (SIZE - SQUARE)
        frames[t, top : top + SQUARE, left : left + SQUARE] = COLOURS[colour]
    motion = torch.zeros(LENGTH, 17)
    motion[1 : VIDEO - 1, :8] = (
        torch.from_numpy(ANSWERS[colour]) * torch.linspace(0, 1, VIDEO - 2)[:, None]
    )
    return Stream(colour, frames, motion)


def make_streams(policy: MMEPolicy, count: int, seed: int) -> list[Stream]:
    """`count` episodes, encoded once for the policy's memory."""
    rng = np.random.default_rng(seed)
    streams = [make_stream(rng) for _ in range(count)]
    if policy.memory is not None:
        for stream in streams:
            stream.history = cached_history(policy, stream.frames, exec_start=VIDEO)
            stream.history.motion, stream.history.state_width = stream.motion.__getitem__, 8
    return streams


def make_batch(policy: MMEPolicy, selected: list[Stream], rng: np.random.Generator) -> Batch:
    """A random execution step of each episode, with the action of its colour."""
    processor, config = policy.require_processor(), policy.backbone.config
    size = len(selected)
    steps = rng.integers(VIDEO, LENGTH, size=size)
    views = np.stack([stream.frames[t] for stream, t in zip(selected, steps, strict=True)])
    prompt, prompt_mask = processor.prompt("do what the video showed")
    actions = torch.zeros(size, config.horizon, config.action_dim)
    actions[..., :8] = torch.from_numpy(ANSWERS[[stream.colour for stream in selected]])[:, None]
    history = None
    if policy.memory is not None:
        memory = policy.memory
        recalled = [
            memory.gather_selection(s.history, int(t))
            for s, t in zip(selected, steps, strict=True)
            if s.history
        ]
        history = stack_history(recalled)
    return Batch(
        images=processor.images([views, views])[:, :1],  # one camera says it all
        image_mask=torch.ones(size, 1, dtype=torch.bool),
        prompt=prompt.expand(size, -1),
        prompt_mask=prompt_mask.expand(size, -1),
        history=history,
        actions=actions,
        past=past_of(policy, selected, steps),
    ).without_prompt_padding()


def past_of(policy: MMEPolicy, selected: Sequence[Stream], steps: np.ndarray) -> PastViews | None:
    """Past views of the one camera, where the memory gives the vision tower any."""
    past_spec = None if policy.memory is None else policy.memory.past_view_spec
    if past_spec is None:
        return None
    prepare = policy.require_processor().images
    past = stack_past([
        past_views(past_spec, int(t), lambda at, stream=stream: [stream.frames[at]] * 2, prepare)
        for stream, t in zip(selected, steps, strict=True)
    ])  # fmt: skip
    assert past is not None
    return replace(past, images=past.images[:, :, :1])


def open_loop_errors(policy: MMEPolicy, streams: list[Stream]) -> list[float]:
    """Mean absolute error of a sampled chunk of each episode; guessing a colour gives about 0.75
    on average.
    """
    policy.eval()
    batch = make_batch(policy, streams, np.random.default_rng(7))
    sampled = policy.sample_actions(batch, generator=torch.Generator().manual_seed(0))
    assert batch.actions is not None
    return (sampled - batch.actions)[..., :8].abs().mean((1, 2)).tolist()


def learn(
    model: str,
    seconds: float = 240,
    steps: int = 1000,
    episodes: int = 128,
    batch_size: int = 8,
    lr: float = 1.5e-3,
    seed: int = 0,
    backbone: Mapping[str, Any] | None = None,
    config_dir: Path | None = None,
    every: int = 100,
    enough: float = 0.08,
) -> dict[str, Any]:
    """Train one policy until it fits the episodes it trains on; its errors on others, and what it
    took.

    Args:
        seconds: most CPU time, encoding included.
        steps: most updates.
        episodes: to learn from.
        backbone: keys of the tiny backbone to change.
        config_dir: YAML files of your own.
        every: updates between two measurements of the error on what it trains on.
        enough: error that it stops at.
    """
    wall, start = time.perf_counter(), time.process_time()
    torch.manual_seed(seed)
    changed = memory_options(model)
    options = {"memory": changed} if changed else {}
    policy = build_policy(
        model,
        seed=seed,
        config_dir=config_dir,
        policy={"augment": False},
        backbone=backbone or {},
        **options,
    )
    policy.backbone.vision.requires_grad_(False)
    train_streams, unseen = make_streams(policy, episodes, seed), make_streams(policy, 32, seed + 1)
    trained = [p for p in policy.parameters() if p.requires_grad]
    optimizer = torch.optim.AdamW(trained, lr=lr, betas=(0.9, 0.95), fused=True)
    rng, done = np.random.default_rng(seed), 0
    while time.process_time() - start < seconds and done < steps:
        policy.train()
        for group in optimizer.param_groups:
            group["lr"] = lr * min(1.0, (done + 1) / 30)
        selected = [train_streams[i] for i in rng.integers(episodes, size=batch_size)]
        loss, _ = policy(make_batch(policy, selected, rng))
        loss.backward()
        torch.nn.utils.clip_grad_norm_(trained, 1.0)
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)
        done += 1
        if done % every == 0 and policy.memory is not None:
            error = np.mean(open_loop_errors(policy, train_streams[:32]))
            print(
                f"  {model}: {error:.2f} on the episodes it learns from after {done} steps",
                flush=True,
            )
            if error < enough:
                break
    cpu, wall = time.process_time() - start, time.perf_counter() - wall
    errors = open_loop_errors(policy, unseen)
    return {
        "model": model,
        "error": float(np.mean(errors)),
        "errors": [round(error, 4) for error in errors],
        "steps": done,
        "cpu": cpu,
        "wall": wall,
    }


def plot(results: list[dict], path: Path) -> None:
    """Draw the error of each policy with its interval over episodes, a row a memory."""
    rows: dict[str, list[dict]] = {}
    for result in results:
        rows.setdefault(result["model"].rpartition("_")[0] or result["model"], []).append(result)
    with figure((7.2, 0.42 * len(rows) + 1.4)) as (canvas, (axes,)):
        for row, policies in enumerate(rows.values()):
            for place, result in enumerate(policies):
                # Policies of a memory lie beside each other in its row.
                y = row + 0.22 * (place - (len(policies) - 1) / 2)
                kind = result["model"].rpartition("_")[2]
                colour = INTEGRATIONS.get(kind, FAINT)
                errors = {"": [np.array(result["errors"])]}
                low, high = percentiles(resampled_means(errors, 10_000, seed=0))
                axes.plot([low, high], [y, y], color=colour, lw=1.6)
                axes.plot(result["error"], y, "o", color=colour, ms=5)
        for kind, colour in INTEGRATIONS.items():
            axes.plot([], [], "-o", color=colour, ms=5, label=kind)
        axes.axvline(0.75, color=INK, ls="--", lw=1, label="guessing a colour")
        axes.set_yticks(range(len(rows)), list(rows))
        axes.set_ylim(len(rows) - 0.5, -0.5)
        axes.set_xlim(0, max(0.9, axes.get_xlim()[1]))
        axes.grid(True, axis="x")
        axes.grid(False, axis="y")
        n = len(results[0]["errors"])
        axes.set_xlabel(f"error of sampled chunks (actions are ±1), 95 % over {n} unseen episodes")
        legend(canvas, axes, 4)
        if path.suffix == ".svg":
            path.write_text(svg(canvas))
        else:
            canvas.savefig(path)


def one_of_several(job: tuple[str, float, Path | None]) -> dict[str, Any]:
    """A variant in a process of its own, on one core."""
    torch.set_num_threads(1)
    model, seconds, config_dir = job
    return learn(model, seconds, config_dir=config_dir)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "models", nargs="*", default=list(NEURAL), help="variants to train, beside pi05"
    )
    parser.add_argument("--config-dir", type=Path, help="a folder of your own YAML files")
    parser.add_argument(
        "--seconds",
        type=float,
        default=240,
        help="most CPU time of one variant: two minutes of two cores",
    )
    parser.add_argument(
        "--processes", type=int, default=2, help="variants that train side by side, one core each"
    )
    parser.add_argument("--plot", type=Path, default=Path("memory_matters.png"))
    parser.add_argument(
        "--results", type=Path, help="JSON lines to add to; what stands there is not trained again"
    )
    args = parser.parse_args()
    with print_user_errors():
        compare(args)


def compare(args: argparse.Namespace) -> None:
    """Train what is named, print and draw it.

    Raises:
        UserError: an unknown model; nothing is trained then.
    """
    models, results = models_of(args.models), read_results(args.results)
    for model in models:
        compose(
            "policy", [f"model={model}"], extra_dirs=[args.config_dir] if args.config_dir else []
        )
    jobs = [(model, args.seconds, args.config_dir) for model in models if model not in results]
    with multiprocessing.get_context("spawn").Pool(args.processes, maxtasksperchild=1) as pool:
        for result in pool.imap_unordered(one_of_several, jobs):
            results[result["model"]] = result
            if args.results is not None:
                with args.results.open("a") as file:
                    file.write(json.dumps(result) + "\n")
    line = (
        "{model:20} error {error:.3f} after {steps} steps, {cpu:.0f} s of CPU time, {wall:.0f} s of"
        " wall time"
    )
    displayed = [results[model] for model in models]
    print("\n".join(line.format(**result) for result in displayed))
    plot(displayed, args.plot)
    print(f"plot: {args.plot}")


def read_results(path: Path | None) -> dict[str, dict[str, Any]]:
    """Return what an earlier run has written, by model."""
    if path is None or not path.is_file():
        return {}
    return {row["model"]: row for row in map(json.loads, path.read_text().splitlines())}


if __name__ == "__main__":
    main()
