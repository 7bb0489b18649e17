r"""A training step and a sampled chunk of `pi05` against LeRobot's own PI05 as shipped, at reduced
width.

    python benchmarks/against_lerobot.py [--threads 1] [--batch 1] [--rounds 10] [--compile] \
        [--cpu-time] [--profile]

Both have two cameras at 224 pixels, 200 prompt tokens of which 60 are used, a chunk of 20, a frozen
vision tower and the same dimensions; they take turns in one process. Ours runs twice: on the 200
tokens as they are, and as its own pipeline makes batches, without the padding that no prompt of the
batch uses (the answer is the same). LeRobot's is as shipped (eager). `--profile` adds where the
time of a chunk goes. Needs the extra `vlm` (LeRobot's policy is built on transformers).
"""

import argparse
import time as time_of
from collections.abc import Callable
from unittest.mock import patch

import torch
from timing import alternate, machine
from torch import Tensor, nn

from mme_vla import build_policy
from mme_vla.types import Batch

SIZES = {
    "vision": {
        "image_size": 224,
        "patch_size": 14,
        "width": 192,
        "depth": 4,
        "mlp_dim": 768,
        "num_heads": 4,
    },
    "vlm": {"width": 256, "mlp_dim": 1024},
    "action": {"width": 128, "mlp_dim": 512},
    "depth": 4,
    "num_heads": 8,
    "num_kv_heads": 1,
    "head_dim": 32,
    "vocab_size": 4096,
}
PROMPT_LENGTH, PROMPT_USED, HORIZON = 200, 60, 20


def lerobot_pi05(dtype: str, reduced: bool = True) -> nn.Module:
    """LeRobot's PI05 network, reduced by its size functions answering `SIZES`; how it computes is
    not touched.
    """
    from lerobot.policies.pi05 import modeling_pi05 as source_module
    from lerobot.policies.pi05.configuration_pi05 import PI05Config

    config = PI05Config(
        dtype=dtype,
        chunk_size=HORIZON,
        n_action_steps=HORIZON,
        freeze_vision_encoder=True,
        device="cpu",
    )
    if not reduced:
        return source_module.PI05Pytorch(config)

    def sizes_of(variant: str) -> source_module.GemmaConfig:
        expert = SIZES["vlm"] if variant == "gemma_2b" else SIZES["action"]
        shared = {key: SIZES[key] for key in ("depth", "num_heads", "num_kv_heads", "head_dim")}
        return source_module.GemmaConfig(**expert, **shared)

    vlm_class, expert_class = (
        source_module.PaliGemmaForConditionalGenerationWithPiGemma,
        source_module.PiGemmaForCausalLM,
    )

    def reduced_vlm(config):
        vision = SIZES["vision"]
        config.vision_config.hidden_size = vision["width"]
        config.vision_config.num_hidden_layers = vision["depth"]
        config.vision_config.num_attention_heads = vision["num_heads"]
        config.vision_config.intermediate_size = vision["mlp_dim"]
        config.vision_config.patch_size = vision["patch_size"]
        config.vision_config.projection_dim = config.projection_dim = SIZES["vlm"]["width"]
        config.text_config.vocab_size = config._vocab_size = SIZES["vocab_size"]
        return vlm_class(config=config)

    def reduced_expert(config):
        config.vocab_size = SIZES["vocab_size"]
        return expert_class(config=config)

    reduced_parts = {
        "get_gemma_config": sizes_of,
        "PaliGemmaForConditionalGenerationWithPiGemma": reduced_vlm,
        "PiGemmaForCausalLM": reduced_expert,
    }
    with patch.multiple(source_module, **reduced_parts):
        return source_module.PI05Pytorch(config)


def our_pi05(dtype: str) -> nn.Module:
    """Our policy at the same sizes, vision frozen."""
    policy = build_policy(
        "pi05", backbone=SIZES, policy={"augment": "false", "compute_dtype": dtype}
    )
    policy.backbone.vision.requires_grad_(False)
    return policy


def trainer(model: nn.Module, loss: Callable[[], Tensor]) -> Callable[[], None]:
    """One optimisation step: forward, backward, AdamW."""
    optimizer = torch.optim.AdamW(
        [p for p in model.parameters() if p.requires_grad], lr=1e-5, fused=True
    )

    def step() -> None:
        model.train()
        optimizer.zero_grad(set_to_none=True)
        loss().backward()
        optimizer.step()

    return step


KINDS = {
    "matrix products": ("aten::addmm", "aten::mm", "aten::bmm"),
    "attention": ("aten::_scaled_dot_product_flash_attention_for_cpu", "aten::_softmax"),
    "copies and casts": ("aten::copy_", "aten::cat"),
    "convolution of patches": ("aten::mkldnn_convolution", "aten::_slow_conv2d_forward"),
}


def shares(work: Callable[[], object]) -> dict[str, float]:
    """Share of the CPU time that each kind of operation takes; the rest is elementwise or small."""
    with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CPU]) as profile:
        work()
    times = {event.key: event.self_cpu_time_total for event in profile.key_averages()}
    total = sum(times.values())
    result = {
        kind: sum(times.get(name, 0.0) for name in names) / total for kind, names in KINDS.items()
    }
    return result | {"norms, elementwise, calls": 1 - sum(result.values())}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--batch", type=int, default=1)
    parser.add_argument("--rounds", type=int, default=10)
    parser.add_argument("--compile", action="store_true", help="compile ours, layer by layer")
    parser.add_argument("--dtype", default="float32", choices=["float32", "bfloat16"])
    parser.add_argument(
        "--cpu-time", action="store_true", help="CPU time, where others use the machine too"
    )
    parser.add_argument("--profile", action="store_true", help="where the time of a chunk goes")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    torch.manual_seed(0)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")

    b = args.batch
    images = torch.randint(0, 256, (b, 2, 3, 224, 224), dtype=torch.uint8, device=device)
    floats = list((images.float() / 127.5 - 1).unbind(1))
    masks = [torch.ones(b, dtype=torch.bool, device=device)] * 2
    tokens = torch.randint(4, SIZES["vocab_size"], (b, PROMPT_LENGTH), device=device)
    used = (torch.arange(PROMPT_LENGTH, device=device) < PROMPT_USED).expand(b, -1)
    actions, noise = torch.randn(2, b, HORIZON, 32, device=device).unbind(0)
    time = torch.full((b,), 0.5, device=device)
    batch = Batch(images, torch.stack(masks, 1), tokens, used, actions=actions)

    target, source = our_pi05(args.dtype).to(device), lerobot_pi05(args.dtype).to(device)

    def their_loss() -> Tensor:
        return source.forward(floats, masks, tokens, used, actions, noise, time).mean()

    def their_chunk() -> Tensor:
        source.eval()
        with torch.no_grad():
            return source.sample_actions(floats, masks, tokens, used, noise=noise, num_steps=10)

    if args.compile:
        target.backbone.compile(dynamic=False)
    cut = batch.without_prompt_padding()
    assert (
        target.sample_actions(batch, noise) - target.sample_actions(cut, noise)
    ).abs().max() < 1e-4

    def our_chunk(inputs: Batch) -> Callable[[], Tensor]:
        return lambda: target.eval().sample_actions(inputs, noise)

    for model, name in ((target, "ours"), (source, "LeRobot")):
        print(f"{name:8} {sum(p.numel() for p in model.parameters()) / 1e6:.2f} M parameters")
    compiled = ", ours compiled" if args.compile else ""
    print(f"{machine()}; batch {b}, {args.dtype}, median of {args.rounds}{compiled}")
    steps = {
        "LeRobot": trainer(source, their_loss),
        "ours, 200 tokens": trainer(target, lambda: target(batch, noise, time)[0]),
        "ours, padding dropped": trainer(target, lambda: target(cut, noise, time)[0]),
    }
    chunks = {
        "LeRobot": their_chunk,
        "ours, 200 tokens": our_chunk(batch),
        "ours, padding dropped": our_chunk(cut),
    }
    for what, contest in (("training step", steps), ("sample_actions", chunks)):
        clock = time_of.process_time if args.cpu_time else time_of.perf_counter
        for name, seconds in (result := alternate(contest, args.rounds, clock=clock)).items():
            print(
                f"{what:15} {name:22} {1e3 * seconds:7.1f} ms   {seconds / result['LeRobot']:.2f}x"
            )
    for name, chunk in chunks.items() if args.profile else ():
        parts = ", ".join(f"{kind} {share:.0%}" for kind, share in shares(chunk).items())
        print(f"chunk, {name}: {parts}")


if __name__ == "__main__":
    main()
