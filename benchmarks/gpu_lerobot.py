"""The row of `gpu.py` about LeRobot's PI05 as shipped: the same images, prompt and chunk, its own
code.
"""

import statistics
from typing import Any

import torch
from against_lerobot import HORIZON, lerobot_pi05, trainer
from gpu_setup import Setup, milliseconds, peak_gib

PROMPT = 64
STEPS = 10


def lerobot_row(setup: Setup) -> dict[str, Any]:
    """An update (forward, backward, AdamW; no EMA, vision frozen) and a chunk, eager.

    On a GPU at full size with bfloat16 weights and moments, as its own configuration offers;
    elsewhere reduced, in float32.

    Raises:
        ImportError: LeRobot or its transformers are not installed.
    """
    device, b = setup.device, setup.batch
    full = setup.backbone == "pi05"
    source: Any = lerobot_pi05(
        "bfloat16" if device.type == "cuda" else "float32", reduced=not full
    ).to(device)
    time = torch.full((b,), 0.5, device=device)

    def inputs(rows: int) -> tuple[Any, ...]:
        images = list(torch.rand(2, rows, 3, 224, 224, device=device) * 2 - 1)
        masks = [torch.ones(rows, dtype=torch.bool, device=device)] * 2
        tokens = torch.full((rows, PROMPT), 5, device=device)
        return images, masks, tokens, torch.ones(rows, PROMPT, dtype=torch.bool, device=device)

    batch, (actions, noise) = inputs(b), torch.randn(2, b, HORIZON, 32, device=device).unbind(0)
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    step = trainer(source, lambda: source.forward(*batch, actions, noise, time).mean())
    took = statistics.median(milliseconds(step, setup.rounds, 3, device))
    row = {"ms": took, "samples_per_s": 1e3 * b / took, "peak_gib": peak_gib(device)}
    alone, noise = inputs(1), noise[:1]
    source.eval()
    with torch.no_grad():
        chunk = milliseconds(
            lambda: source.sample_actions(*alone, noise=noise, num_steps=STEPS),
            setup.rounds,
            2,
            device,
        )
    return {
        "training": row,
        "chunk": {"eager": {"p50_ms": statistics.median(chunk), "p99_ms": chunk[-1]}},
    }
