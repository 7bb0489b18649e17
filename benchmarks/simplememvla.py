"""What SimpleMemVLA costs: seconds of a decision over a long episode, FLOPs at full size, peak
memory of a GPU.

python benchmarks/simplememvla.py time                  # tiny; a window of 20 s, an episode of 100
s python benchmarks/simplememvla.py count                 # on the meta device, beside
framesamp_modul python benchmarks/simplememvla.py memory chunk          # of one GPU, or of a
stand-in that computes nothing python benchmarks/simplememvla.py memory update
"""

import argparse
import json
import time
from typing import Any

import numpy as np
import torch
from torch.utils.flop_counter import FlopCounterMode, conv_flop_count

from mme_vla import build_policy
from mme_vla.extras.probing.analyses.cost import flops, on_meta
from mme_vla.policy.finetune import apply_finetuning
from mme_vla.testing.small import unit_stats

TERA, GIB = 1e12, 2**30
SECONDS = 20
COMPARED = ("simplememvla", "framesamp_modul")


def measure_time(steps: int, every: int) -> None:
    """Seconds of decisions along one episode, without and with reading ahead; the latter is not in
    them.
    """
    options: dict[str, Any] = {"processor": {"seconds": SECONDS, "max_words": 4}}
    policy: Any = build_policy("simplememvla", **options)
    policy.require_processor().stats = unit_stats(policy.embodiment)
    rng = np.random.default_rng(0)
    side, seconds = 32, {}
    for ahead in (False, True):
        episode: Any = policy.start_episode("pick up the cube", seed=0)
        rows = []
        for step in range(0, steps, 16):
            count = 1 if step == 0 else 16
            views = {
                name: rng.integers(0, 255, (count, side, side, 3), np.uint8)
                for name in ("front", "wrist")
            }
            episode.observe(views, np.full((count, 8), 0.1, np.float32))
            begun = time.process_time()
            policy.act(episode)
            rows.append(
                (
                    step,
                    time.process_time() - begun,
                    len(episode.video.frames),
                    len(episode.video.patches),
                )
            )
            while ahead and policy.prepare(episode):
                pass
        seconds[ahead] = rows
    print(
        "| frame | decision | after reading ahead | frames kept | temporal patches kept"
        " |\n|---:|---:|---:|---:|---:|"
    )
    for (step, base, frames, patches), (_, prepared, _, _) in zip(
        seconds[False], seconds[True], strict=True
    ):
        if step % every == 0:
            print(
                f"| {step} | {1e3 * base:,.0f} ms | {1e3 * prepared:,.0f} ms | {frames} |"
                f" {patches} |"
            )


def count() -> None:
    """Parameters and FLOPs at full size."""
    print("| model | parameters | forward pass | sampled chunk | update | update, frozen tower |")
    print("|---|---:|---:|---:|---:|---:|")
    for model in COMPARED:
        policy: Any = on_meta(model)
        batch = policy.full_batch("meta")
        work = (lambda: policy(batch), lambda: policy.sample_actions(batch))  # noqa: B023
        numbers = [
            *map(flops, work),
            *(update_flops(policy, batch, frozen) for frozen in (False, True)),
        ]
        parameters = sum(p.numel() for p in policy.parameters())
        cells = [f"{number / TERA:.2f} T" for number in numbers]
        print(f"| `{model}` | {parameters:,} | {' | '.join(cells)} |", flush=True)


def update_flops(policy: Any, batch: Any, freeze_vision: bool) -> int:
    """FLOPs of the forward and the backward pass of one sample, without recomputation."""
    apply_finetuning(policy, freeze_vision=freeze_vision)
    with FlopCounterMode(
        display=False, custom_mapping={torch.ops.aten.convolution_backward: _conv_gradients}
    ) as counter:
        policy(batch)[0].backward()
    return counter.get_total_flops()


def _conv_gradients(made: Any, x: Any, weight: Any, *options: Any, **_: Any) -> int:
    """FLOPs of a convolution's gradients, from shapes. PyTorch's own count of a grouped one is for
    a dense one.
    """
    transposed, needed = options[4], options[-1]
    return sum(needed[:2]) * conv_flop_count(x, weight, made, transposed)


def memory(what: str, recompute: bool, cudnn: bool) -> None:
    """Peak memory of a chunk (bfloat16 weights), or of two updates of one sample (AdamW over
    float32 weights).
    """
    device = torch.device("cuda")
    torch.backends.cudnn.enabled = cudnn
    torch.backends.cuda.enable_cudnn_sdp(cudnn)
    options: dict[str, Any] = {"policy.augment": False, "policy.compute_dtype": "bfloat16"}
    policy: Any = build_policy("simplememvla", backbone="simplememvla", device="meta", **options)
    if what == "chunk":
        policy = policy.to(torch.bfloat16)
    policy = policy.to_empty(device=device)
    policy.backbone.reset_buffers()
    weights = torch.cuda.memory_allocated()
    batch = policy.full_batch(device)
    torch.cuda.reset_peak_memory_stats()
    if what == "chunk":
        policy.eval().requires_grad_(False).sample_actions(batch)
    else:
        apply_finetuning(policy, freeze_vision=False)
        policy.train().recompute(recompute)
        optimizer = torch.optim.AdamW(policy.parameters(), lr=1e-5, fused=True)
        for _ in range(2):
            policy(batch)[0].backward()
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
    peak = torch.cuda.max_memory_allocated()
    print(json.dumps({"what": what, "weights_gib": weights / GIB, "peak_gib": peak / GIB}))


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("figure", choices=("time", "count", "memory"))
    parser.add_argument(
        "what", nargs="?", default="chunk", choices=("chunk", "update"), help="of `memory`"
    )
    parser.add_argument("--steps", type=int, default=2000, help="frames of the episode")
    parser.add_argument("--every", type=int, default=160, help="frames between two rows")
    parser.add_argument("--keep", action="store_true", help="of an update: keep all activations")
    parser.add_argument("--no-cudnn", action="store_true", help="for a stand-in of a GPU")
    args = parser.parse_args()
    if args.figure == "time":
        torch.set_num_threads(1)
        measure_time(args.steps, args.every)
    elif args.figure == "count":
        count()
    else:
        memory(args.what, not args.keep, not args.no_cudnn)


if __name__ == "__main__":
    main()
