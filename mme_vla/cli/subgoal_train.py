"""`mme-vla subgoal-train rows=<folder>/grounded.jsonl`: fine-tune a subgoal predictor with LoRA."""

from mme_vla.subgoal.finetuning.training import fine_tune as main

__all__ = ["main"]
