"""Training of a tiny policy on samples made in memory."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from accelerate import Accelerator

from mme_vla import MMEPolicy, build_policy
from mme_vla.policy.finetune import apply_finetuning
from mme_vla.processing.normalise import NormStats, QuantileStats
from mme_vla.training.logging import Loggers, open_loggers
from mme_vla.training.loop import Trainer
from mme_vla.training.order import Validation
from mme_vla.training.runs import Run
from mme_vla.training.settings import TrainSettings
from mme_vla.types import Batch, HistoryTokens

SMALL = {
    "depth": 1,
    "vision": {"depth": 1, "image_size": 16, "patch_size": 1, "width": 16, "mlp_dim": 16},
}
RECIPE: dict[str, Any] = {
    "steps": 6, "batch_size": 4, "lr": 1e-2, "ema": 0.5, "workers": 0, "device": "cpu",
    "log_every": 1, "save_every": 2, "val_every": 3,
}  # fmt: skip
STATS = QuantileStats(
    *(torch.full((8,), value).double().numpy() for value in (0.0, 1.0, -1.0, 1.0))
)


class Samples:
    """Random observations, each a function of its index, for policies with and without memory."""

    def __init__(self, policy: MMEPolicy, count: int = 10, actions: float = 0.0) -> None:
        self.policy, self.count, self.actions = policy, count, actions

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, index: int) -> Batch:
        draw = torch.Generator().manual_seed(index)
        config, memory = self.policy.backbone.config, self.policy.memory
        size = config.vision.image_size
        history = None
        if memory is not None:
            mask = torch.arange(memory.capacity) < 20
            features = (
                torch.randn(memory.capacity, config.vlm.width, generator=draw) * mask[:, None]
            )
            history = HistoryTokens(features, torch.ones(memory.capacity, 3) * mask[:, None], mask)
        return Batch(
            images=torch.randint(0, 256, (2, 3, size, size), generator=draw, dtype=torch.uint8),
            image_mask=torch.ones(2, dtype=torch.bool),
            prompt=torch.randint(4, 100, (8,), generator=draw),
            prompt_mask=torch.ones(8, dtype=torch.bool),
            history=history,
            actions=torch.full((config.horizon, config.action_dim), self.actions),
        )


def collate(items: Sequence[Batch]) -> Batch:
    def stack(parts: Sequence[Any]) -> Any:
        if parts[0] is None or isinstance(parts[0], torch.Tensor):
            return None if parts[0] is None else torch.stack(list(parts))
        return type(parts[0])(
            **{key: stack([vars(part)[key] for part in parts]) for key in vars(parts[0])}
        )

    return stack(items)


def policy(name: str = "pi05", **overrides: Any) -> MMEPolicy:
    memory = {} if name == "pi05" else {"memory": {"budget": 64}}
    built = build_policy(name, backbone=SMALL, **memory, **overrides)
    built.require_processor().stats = NormStats(STATS, STATS)
    apply_finetuning(built)
    return built


def trainer(
    folder: Path, built: MMEPolicy | None = None, run: Run | None = None, **changes: Any
) -> Trainer:
    built = built or policy()
    recipe = {**RECIPE, **changes}
    actions = recipe.pop("actions", 0.0)
    settings = TrainSettings.from_dict(recipe, seed=1)
    run, config = run or Run(folder), {"train": recipe, "seed": 1}
    validation = Validation(Samples(built, 5), collate, 3, 2, seed=1)
    samples = Samples(built, actions=actions)
    return Trainer(
        built, samples, collate, validation, settings, run, config, Accelerator(cpu=True)
    )


def loggers(folder: Path, first_step: int = 0) -> Loggers:
    return open_loggers(folder, {}, first_step)
