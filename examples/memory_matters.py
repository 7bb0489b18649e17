"""Does the memory work? A stream whose answer was visible only in the conditioning video.

    python examples/memory_matters.py                         # every neural variant and pi05, about two minutes each
    python examples/memory_matters.py framesamp_modul pi05 --seconds 60

In the video a square of one of four colours passes over the scene; when execution begins it is gone, and the right
action depends on its colour alone. The current view, the goal and the state say nothing, so a policy without memory can
only guess. Prints the open-loop error of each policy on episodes it has not seen, and draws it.
"""

import argparse
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from mme_vla import build_policy
from mme_vla.memory.base import stack_history
from mme_vla.memory.history import CachedHistory
from mme_vla.policy import MMEPolicy
from mme_vla.testing import NEURAL, cached_history
from mme_vla.types import Batch

COLOURS = np.array([[220, 40, 40], [40, 200, 60], [50, 70, 230], [230, 210, 40]], np.uint8)
ANSWERS = np.array([[1, 1, 1, 1, -1, -1, -1, -1], [1, -1, 1, -1, 1, -1, 1, -1],
                    [-1, -1, 1, 1, 1, 1, -1, -1], [-1, 1, 1, -1, -1, 1, 1, -1]], np.float32)  # fmt: skip
SIZE, SQUARE = 64, 24  # pixels
VIDEO, LENGTH = 24, 48  # frames of conditioning video, and of the whole episode


@dataclass
class Stream:
    """One synthetic episode: the colour it showed, its frames [t, h, w, 3], and its tokens for a memory."""

    colour: int
    frames: np.ndarray
    history: CachedHistory | None = None


def make_stream(rng: np.random.Generator) -> Stream:
    """A grey scene; from the second to the last frames of the video a coloured square wanders over it."""
    scene = np.full((SIZE, SIZE, 3), 110, np.uint8) + rng.integers(0, 12, (SIZE, SIZE, 1), dtype=np.uint8)
    frames = np.repeat(scene[None], LENGTH, 0)
    colour = int(rng.integers(len(COLOURS)))
    y, x = rng.integers(0, SIZE - SQUARE, 2)
    for t in range(2, VIDEO - 2):
        top, left = (y + 2 * t) % (SIZE - SQUARE), (x + t) % (SIZE - SQUARE)
        frames[t, top : top + SQUARE, left : left + SQUARE] = COLOURS[colour]
    return Stream(colour, frames)


def make_streams(policy: MMEPolicy, count: int, seed: int) -> list[Stream]:
    """`count` episodes, encoded once for the policy's memory."""
    rng = np.random.default_rng(seed)
    streams = [make_stream(rng) for _ in range(count)]
    if policy.memory is not None:
        for stream in streams:
            stream.history = cached_history(policy, stream.frames, exec_start=VIDEO)
    return streams


def make_batch(policy: MMEPolicy, streams: list[Stream], rng: np.random.Generator, size: int) -> Batch:
    """Random execution steps of random episodes, with the action their colour asks for."""
    processor, config = policy.require_processor(), policy.backbone.config
    chosen = [streams[i] for i in rng.integers(len(streams), size=size)]
    steps = rng.integers(VIDEO, LENGTH, size=size)
    views = np.stack([stream.frames[t] for stream, t in zip(chosen, steps, strict=True)])
    prompt, prompt_mask = processor.prompt("do what the video showed")
    actions = torch.zeros(size, config.horizon, config.action_dim)
    actions[..., :8] = torch.from_numpy(ANSWERS[[stream.colour for stream in chosen]])[:, None]
    history = None
    if policy.memory is not None:
        memory = policy.memory
        recalled = [memory.recall(s.history, int(t)) for s, t in zip(chosen, steps, strict=True) if s.history]
        history = stack_history(recalled)
    return Batch(
        images=processor.images([views, views]),
        image_mask=torch.ones(size, 2, dtype=torch.bool),
        prompt=prompt.expand(size, -1),
        prompt_mask=prompt_mask.expand(size, -1),
        history=history,
        actions=actions,
    ).without_prompt_padding()


def open_loop_error(policy: MMEPolicy, streams: list[Stream], chunks: int = 48) -> float:
    """Mean absolute error of sampled chunks on unseen episodes; guessing a colour gives about 0.75."""
    policy.eval()
    batch = make_batch(policy, streams, np.random.default_rng(7), chunks)
    sampled = policy.sample_actions(batch, generator=torch.Generator().manual_seed(0))
    assert batch.actions is not None
    return float((sampled - batch.actions)[..., :8].abs().mean())


def learn(model: str, seconds: float, budget: int = 128, batch_size: int = 8, lr: float = 3e-3, seed: int = 0) -> dict:
    """Train one policy for `seconds` (and at most 800 steps); its error on unseen episodes, and what it took."""
    torch.manual_seed(seed)
    options = {} if model == "pi05" else {"memory": {"budget": budget}}
    policy = build_policy(model, seed=seed, policy={"augment": False}, **options)
    policy.backbone.vision.requires_grad_(False)
    seen, unseen = make_streams(policy, 64, seed), make_streams(policy, 32, seed + 1)
    optimizer = torch.optim.AdamW([p for p in policy.parameters() if p.requires_grad], lr=lr, betas=(0.9, 0.95))
    rng, start, steps = np.random.default_rng(seed), time.perf_counter(), 0
    policy.train()
    while time.perf_counter() - start < seconds and steps < 800:
        for group in optimizer.param_groups:
            group["lr"] = lr * min(1.0, (steps + 1) / 30)
        loss, _ = policy(make_batch(policy, seen, rng, batch_size))
        loss.backward()
        torch.nn.utils.clip_grad_norm_(policy.parameters(), 1.0)
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)
        steps += 1
        if steps % 100 == 0 and model != "pi05" and open_loop_error(policy, unseen, 16) < 0.1:
            break
        policy.train()
    took = time.perf_counter() - start
    return {"model": model, "error": open_loop_error(policy, unseen), "steps": steps, "seconds": took}


def plot(results: list[dict], path: Path) -> None:
    """Draw one bar a policy."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(7, 0.4 * len(results) + 1.4), layout="constrained")
    names = [r["model"] for r in results]
    bars = axes.barh(
        names, [r["error"] for r in results], color=["#9a9a9a" if n == "pi05" else "#2b6cb0" for n in names]
    )
    axes.bar_label(bars, fmt="%.2f", padding=3)
    axes.axvline(0.75, color="#c05621", linestyle="--", linewidth=1, label="guessing a colour")
    axes.invert_yaxis()
    axes.set_xlabel("open-loop error on unseen episodes (mean absolute, actions are ±1)")
    axes.legend(frameon=False)
    axes.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=130)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", nargs="*", default=["pi05", *NEURAL], help="variants to train")
    parser.add_argument("--seconds", type=float, default=120, help="longest training of one variant")
    parser.add_argument("--plot", type=Path, default=Path("memory_matters.png"))
    args = parser.parse_args()
    results = []
    for model in args.models:
        results.append(learn(model, args.seconds))
        print("{model:20} error {error:.3f} after {steps} steps, {seconds:.0f} s".format(**results[-1]), flush=True)
    plot(results, args.plot)
    print(f"plot: {args.plot}")


if __name__ == "__main__":
    main()
