"""`mme-vla subgoal-train rows=<folder>/grounded.jsonl`: fine-tune a subgoal predictor with LoRA."""

from pathlib import Path

from omegaconf import DictConfig

from mme_vla.subgoal.finetuning.training import fine_tune


def main(cfg: DictConfig) -> Path:
    """Train as configs/subgoal_train.yaml and the command line say; return the adapter's folder."""
    return fine_tune(cfg)
