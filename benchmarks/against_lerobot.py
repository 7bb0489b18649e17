"""A training step and a sampled chunk of `pi05` against LeRobot's own PI05 as shipped, at reduced width.

    python benchmarks/against_lerobot.py [--threads 1] [--batch 1] [--rounds 10] [--dtype float32]

Both have two cameras at 224 pixels, 200 prompt tokens of which 60 are used, a chunk of 20, a frozen vision tower and
the same dimensions; they take turns in one process. Needs the extra `vlm` (LeRobot's policy is built on transformers).
"""

import argparse

import torch
from timing import alternate, machine
from torch import Tensor, nn

from mme_vla import build_policy
from mme_vla.types import Batch

SIZES = {
    "vision": {"image_size": 224, "patch_size": 14, "width": 192, "depth": 4, "mlp_dim": 768, "num_heads": 4},
    "vlm": {"width": 256, "mlp_dim": 1024},
    "action": {"width": 128, "mlp_dim": 512},
    "depth": 4,
    "num_heads": 8,
    "num_kv_heads": 1,
    "head_dim": 32,
    "vocab_size": 4096,
}
PROMPT_LENGTH, PROMPT_USED, HORIZON = 200, 60, 20


def lerobot_pi05(dtype: str) -> nn.Module:
    """LeRobot's PI05 network with its size functions answering `SIZES`; nothing of how it computes is touched."""
    from lerobot.policies.pi05 import modeling_pi05 as theirs
    from lerobot.policies.pi05.configuration_pi05 import PI05Config

    def sizes_of(variant: str) -> theirs.GemmaConfig:
        expert = SIZES["vlm"] if variant == "gemma_2b" else SIZES["action"]
        shared = {key: SIZES[key] for key in ("depth", "num_heads", "num_kv_heads", "head_dim")}
        return theirs.GemmaConfig(**expert, **shared)

    vlm_class, expert_class = theirs.PaliGemmaForConditionalGenerationWithPiGemma, theirs.PiGemmaForCausalLM

    def reduced_vlm(config):  # noqa: ANN001, ANN202
        vision = SIZES["vision"]
        config.vision_config.hidden_size = vision["width"]
        config.vision_config.num_hidden_layers = vision["depth"]
        config.vision_config.num_attention_heads = vision["num_heads"]
        config.vision_config.intermediate_size = vision["mlp_dim"]
        config.vision_config.patch_size = vision["patch_size"]
        config.vision_config.projection_dim = config.projection_dim = SIZES["vlm"]["width"]
        config.text_config.vocab_size = config._vocab_size = SIZES["vocab_size"]
        return vlm_class(config=config)

    def reduced_expert(config):  # noqa: ANN001, ANN202
        config.vocab_size = SIZES["vocab_size"]
        return expert_class(config=config)

    theirs.get_gemma_config = sizes_of
    theirs.PaliGemmaForConditionalGenerationWithPiGemma = reduced_vlm
    theirs.PiGemmaForCausalLM = reduced_expert
    config = PI05Config(dtype=dtype, chunk_size=HORIZON, n_action_steps=HORIZON, freeze_vision_encoder=True, device="cpu")
    return theirs.PI05Pytorch(config)


def our_pi05(dtype: str) -> nn.Module:
    """Our policy at the same sizes, vision frozen."""
    backbone = {key: value for key, value in SIZES.items()}
    policy = build_policy("pi05", backbone=backbone, policy={"augment": "false", "compute_dtype": dtype})
    policy.backbone.vision.requires_grad_(False)
    return policy


def trainer(model: nn.Module, loss) -> callable:  # noqa: ANN001
    """One optimisation step: forward, backward, AdamW."""
    optimizer = torch.optim.AdamW([p for p in model.parameters() if p.requires_grad], lr=1e-5, fused=True)

    def step() -> None:
        model.train()
        optimizer.zero_grad(set_to_none=True)
        loss().backward()
        optimizer.step()

    return step


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--batch", type=int, default=1)
    parser.add_argument("--rounds", type=int, default=10)
    parser.add_argument("--dtype", default="float32", choices=["float32", "bfloat16"])
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    torch.manual_seed(0)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")

    b = args.batch
    pictures = torch.randint(0, 256, (b, 2, 3, 224, 224), dtype=torch.uint8, device=device)
    floats = list((pictures.float() / 127.5 - 1).unbind(1))
    seen = [torch.ones(b, dtype=torch.bool, device=device)] * 2
    tokens = torch.randint(4, SIZES["vocab_size"], (b, PROMPT_LENGTH), device=device)
    used = (torch.arange(PROMPT_LENGTH, device=device) < PROMPT_USED).expand(b, -1)
    actions, noise = torch.randn(2, b, HORIZON, 32, device=device).unbind(0)
    time = torch.full((b,), 0.5, device=device)
    batch = Batch(pictures, torch.stack(seen, 1), tokens, used, actions=actions)

    ours, theirs = our_pi05(args.dtype).to(device), lerobot_pi05(args.dtype).to(device)

    def their_loss() -> Tensor:
        return theirs.forward(floats, seen, tokens, used, actions, noise, time).mean()

    def their_chunk() -> Tensor:
        theirs.eval()
        with torch.no_grad():
            return theirs.sample_actions(floats, seen, tokens, used, noise=noise, num_steps=10)

    def our_chunk() -> Tensor:
        ours.eval()
        return ours.sample_actions(batch, noise)

    for model, name in ((ours, "ours"), (theirs, "LeRobot")):
        print(f"{name:8} {sum(p.numel() for p in model.parameters()) / 1e6:.2f} M parameters")
    print(f"{machine()}; batch {b}, {args.dtype}, median of {args.rounds}")
    steps = {"ours": trainer(ours, lambda: ours(batch, noise, time)[0]), "LeRobot": trainer(theirs, their_loss)}
    for what, contest in (("training step", steps), ("sample_actions", {"ours": our_chunk, "LeRobot": their_chunk})):
        result = alternate(contest, args.rounds)
        ratio = result["ours"] / result["LeRobot"]
        print(f"{what:15} ours {1e3 * result['ours']:7.1f} ms   LeRobot {1e3 * result['LeRobot']:7.1f} ms   {ratio:.2f}x")


if __name__ == "__main__":
    main()
