"""What the prior methods add: names alone."""

from pathlib import Path

from mme_vla.registry import Extension, WeightFormat

_METHODS = "mme_vla.extras.methods"

EXTENSION = Extension(
    parts={
        "backbone": {"openvla": f"{_METHODS}.openvla_oft.model"},
        "policy": {
            "diffusion_policy": f"{_METHODS}.diffusion_policy.policy",
            "sam2act_plus": f"{_METHODS}.sam2act.policy",
            "openvla": f"{_METHODS}.openvla_oft.policy",
            "memoryvla": f"{_METHODS}.memoryvla.policy",
            "simplememvla": f"{_METHODS}.simplememvla.policy",
            "subtask": f"{_METHODS}.simplememvla.subtask",
        },
        "processor": {
            "diffusion_policy": f"{_METHODS}.diffusion_policy.processor",
            "sam2act_plus": f"{_METHODS}.sam2act.processor",
            "openvla": f"{_METHODS}.openvla_oft.processor",
            "memoryvla": f"{_METHODS}.memoryvla.processor",
            "simplememvla": f"{_METHODS}.simplememvla.processor",
            "subtask": f"{_METHODS}.simplememvla.subtask",
        },
        "prompt": dict.fromkeys(("openvla", "openvla_subgoal"), f"{_METHODS}.openvla_oft.prompt"),
        "training_set": {
            "groups": f"{_METHODS}.memoryvla.groups",
            "keyframes": f"{_METHODS}.sam2act.keyframes",
        },
        "side_file": {"keyframes": f"{_METHODS}.sam2act.keyframes"},
    },
    configs=Path(__file__).parent / "configs",
    weight_formats={
        "simplememvla": WeightFormat(
            f"{_METHODS}.simplememvla.weights",
            "SimpleMemVLA as its authors publish it, or Qwen3.5 (safetensors)",
            matches="is_simplememvla",
            adapter="simplememvla_adapter",
            write="write_simplememvla",
            stats="read_published_stats",
            spelling="read_names",
            check="check_config",
            configure="configured",
        ),
        "diffusion_policy": WeightFormat(
            f"{_METHODS}.diffusion_policy.weights",
            "Diffusion Policy as RoboMME's authors train it (.pth)",
            matches="is_diffusion_policy",
            adapter="diffusion_adapter",
            write="write_diffusion_policy",
            native="unwrap_names",
            stats="read_diffusion_stats",
        ),
        "sam2act_plus": WeightFormat(
            f"{_METHODS}.sam2act.weights",
            "SAM2Act and SAM2Act+ as their authors train them (.pth)",
            matches="is_sam2act",
            adapter="sam2act_adapter",
            write="write_sam2act",
            native="unwrap_sam2act_names",
        ),
        "openvla": WeightFormat(
            f"{_METHODS}.openvla_oft.weights",
            "OpenVLA, or a run of OpenVLA-OFT, merged or beside its base (safetensors, with .pt"
            " files)",
            matches="is_openvla",
            adapter="openvla_adapter",
            write="write_openvla",
            model="openvla_oft",
            spelling="with_heads",
            stats="read_dataset_statistics",
            named_base="named_base",
            merge="merge_run",
        ),
        "memoryvla": WeightFormat(
            f"{_METHODS}.memoryvla.weights",
            "MemoryVLA as its authors train it (.pt)",
            matches="is_memoryvla",
            adapter="memoryvla_adapter",
            write="write_memoryvla",
            native="read_names",
        ),
    },
)
