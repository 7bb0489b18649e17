"""The argument file with which ms-swift trains on the same rows, as in the paper."""

import json
from pathlib import Path

MODEL = "Qwen/Qwen3-VL-4B-Instruct"
ENVIRONMENT = {
    "IMAGE_MAX_TOKEN_NUM": "256",
    "VIDEO_MAX_TOKEN_NUM": "64",
    "FPS_MAX_FRAMES": "10",
    "QWENVL_BBOX_FORMAT": "legacy",  # points between <|box_start|> and <|box_end|>
    "NPROC_PER_NODE": "4",
}
_ARGUMENTS = {
    "model": MODEL,
    "train_type": "lora",  # of ms-swift 3.9 and later 3.x; version 4 calls it tuner_type
    "lora_rank": 16,
    "lora_alpha": 32,
    "target_modules": ["all-linear"],
    "freeze_vit": True,
    "freeze_aligner": True,
    "learning_rate": 1e-4,
    "warmup_ratio": 0.05,
    "num_train_epochs": 2,
    "max_length": 3200,
    "torch_dtype": "bfloat16",
    "per_device_train_batch_size": 4,
    "gradient_accumulation_steps": 4,  # times four GPUs: 64 rows a step; 3 gives the paper's 48
    "deepspeed": "zero2",
    "save_steps": 100,
    "logging_steps": 5,
}


def write_arguments(folder: Path, name: str) -> Path:
    """Write `swift_<name>.json` beside the rows; run it from that folder: their paths are relative to it."""
    path = folder / f"swift_{name}.json"
    arguments = {**_ARGUMENTS, "dataset": [f"{name}.jsonl"], "output_dir": f"swift_{name}"}
    path.write_text(json.dumps(arguments, indent=1) + "\n")
    return path


def command(name: str) -> str:
    """The command line that goes with it."""
    return " ".join([*(f"{key}={value}" for key, value in ENVIRONMENT.items()), "swift sft", f"swift_{name}.json"])
