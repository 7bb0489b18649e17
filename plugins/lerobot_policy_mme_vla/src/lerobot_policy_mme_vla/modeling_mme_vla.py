"""A policy of mme-vla behind LeRobot's interface."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Self

import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies.pretrained import PreTrainedPolicy
from torch import Tensor

from lerobot_policy_mme_vla.configuration_mme_vla import IS_DEMO, STATE, MMEVLAConfig, image_key
from lerobot_policy_mme_vla.rows import Row, act
from lerobot_policy_mme_vla.samples import Samples
from mme_vla import Policy
from mme_vla.config.composition import compose
from mme_vla.config.plugins import import_trusted
from mme_vla.errors import UserError
from mme_vla.policy.build import build_from_config
from mme_vla.policy.finetune import apply_finetuning
from mme_vla.policy.saving import (
    CONFIG,
    build_saved,
    check_processor,
    local_folder,
    policy_class,
    recompute_buffers,
)
from mme_vla.policy.tensor_files import WEIGHTS, assign_tensors, load_tensors
from mme_vla.processing.base import load_processor
from mme_vla.training.data import check_frozen
from mme_vla.utils import Sums, write_sums
from mme_vla.weights import start_from

PREFIX = "model."


class MMEVLAPolicy(PreTrainedPolicy):
    """Any composition of mme-vla.

    LeRobot's loops hand over one batch of environments at a time; their episodes, memories
    included, live in rows that `reset` drops.

    Args:
        config: as LeRobot parsed it. dataset_meta: of the dataset it is to train on.
        model: in place of the one that `config` describes.

    Raises:
        UserError: a configuration that cannot be built, or features that are not this robot's.
    """

    config_class = MMEVLAConfig
    name = "mme_vla"
    config: MMEVLAConfig

    def __init__(
        self,
        config: MMEVLAConfig,
        dataset_stats: Any = None,
        dataset_meta: Any = None,
        model: Policy | None = None,
    ) -> None:
        super().__init__(config)
        self.model = _built(config) if model is None else model
        config.composition = json.dumps(self.model.config)
        config.check_robot(self.model.embodiment)
        self._samples = None if dataset_meta is None else Samples(self.model, config, dataset_meta)
        self._rows: list[Row] | None = None

    # Training

    def forward(
        self, batch: dict[str, Tensor], reduction: str = "mean"
    ) -> tuple[Tensor, dict[str, float]]:
        """The loss of the steps that a batch names by `index`, which are read as mme-vla reads
        them.

        Raises:
            UserError: the policy was not made for a dataset, or a loss that is not the mean is
                asked for.
        """
        if self._samples is None:
            raise UserError(
                "forward() needs the dataset: make the policy with dataset_meta, as lerobot-train"
                " does."
            )
        if reduction != "mean":
            raise UserError(
                f"reduction={reduction!r}: this policy has the mean loss alone, so no sample"
                " weighting."
            )
        loss, metrics = self.model(self._samples.batch(batch["index"]).to(self.model.device))
        return loss, {key: float(value) for key, value in metrics.items() if key != "loss"}

    def get_optim_params(self) -> list[Tensor]:  # type: ignore[override]
        """All that learns: not the vision tower, unless there is no memory and
        `freeze_vision=false` says so.
        """
        check_frozen(self.model, self.config.freeze_vision)
        apply_finetuning(self.model, freeze_vision=self.config.freeze_vision)
        return [parameter for parameter in self.parameters() if parameter.requires_grad]

    # Episodes

    def reset(self) -> None:
        """Forget the episodes."""
        self._rows = None

    @torch.no_grad()
    def select_action(self, batch: dict[str, Any], **_: Any) -> Tensor:
        """One action for every environment, [b, w]; each frame is remembered, and chunks are chosen
        in one batch.

        During the conditioning video (`observation.is_demo`) no chunk is chosen: the environment
        ignores the answer.
        """
        rows = self._see(batch)
        waiting = [row for row in rows if not (row.plan or row.in_video)]
        if waiting:
            execute = self.config.n_action_steps or self.model.embodiment.action.execute
            for row, chunk in zip(
                waiting, act(self.model, waiting, self.config.flow_steps), strict=True
            ):
                row.plan.extend(chunk[:execute])
        ignored = np.zeros(self.model.embodiment.action.width, np.float32)
        actions = [ignored if row.in_video else row.plan.popleft() for row in rows]
        return torch.from_numpy(np.stack(actions).astype(np.float32))

    @torch.no_grad()
    def predict_action_chunk(
        self,
        batch: dict[str, Any],
        inference_delay: int | None = None,
        prev_chunk_left_over: Tensor | None = None,
        **_: Any,
    ) -> Tensor:
        """Chunks [b, h, w] of absolute actions for the current observations.

        Args:
            inference_delay: actions of the chunk before that are executed until this one is there.
            prev_chunk_left_over: [n, w] or [b, n, w], those of its actions that are still to come;
                rows of zeros at the end, with which LeRobot fills up, are none.

        Raises:
            UserError: a policy without real-time chunking, or one that reads which actions were
                executed.
        """
        rows = self._see(batch)
        if prev_chunk_left_over is not None:
            if not self.supports_rtc():
                raise UserError(
                    "This policy does not support real-time chunking: use --inference.type=sync."
                )
            action_prefix = np.atleast_3d(prev_chunk_left_over.float().cpu().numpy())
            action_prefix = action_prefix.reshape(-1, *prev_chunk_left_over.shape[-2:])
            for row, actions in zip(rows, action_prefix, strict=True):
                row.read()
                actions = actions[: len(np.trim_zeros(np.abs(actions).sum(1), "b"))]
                if len(actions):
                    row.episode.set_action_prefix(actions, min(inference_delay or 0, len(actions)))
        return torch.from_numpy(act(self.model, rows, self.config.flow_steps))

    def supports_rtc(self) -> bool:
        """Whether a chunk can be chosen while another is executed: of flows that need not know what
        was executed.
        """
        return (
            self.model.info.supports_rtc
            and self.model.require_processor().prompt_spec.past_actions == 0
        )

    def _see(self, batch: Mapping[str, Any]) -> list[Row]:
        states = batch[STATE].float().cpu().numpy()
        images = {
            camera.name: _as_uint8(batch[image_key(camera, batch)])
            for camera in self.model.embodiment.cameras
        }
        demo = np.zeros(len(states), bool)
        if IS_DEMO in batch:
            demo = batch[IS_DEMO].reshape(len(states), -1)[:, 0].cpu().numpy() > 0.5
        goals = batch.get("task") or [""] * len(states)
        if self._rows is None:
            if self.model.require_processor().prompt_spec.reads_subgoal:
                raise UserError(
                    "This policy reads a subgoal, and LeRobot's loops have no place for one:"
                    " evaluate it with python -m mme_vla.evaluate."
                )
            self._rows = [
                Row(self.model.start_episode(goal, seed=self.config.seed)) for goal in goals
            ]
        for i, row in enumerate(self._rows):
            row.episode.goal = goals[i]
            row.see({name: views[i] for name, views in images.items()}, states[i], bool(demo[i]))
        return self._rows

    # Folders: LeRobot's files, and beside them mme-vla's

    def _save_pretrained(
        self, save_directory: Path, **options: Any
    ) -> None:  # 0.6.1 hands over a state_dict, later none
        super()._save_pretrained(save_directory, **options)
        write_sums(
            save_directory, [CONFIG, WEIGHTS, *self.model.require_processor().save(save_directory)]
        )

    @classmethod
    def from_pretrained(  # type: ignore[override]
        cls,
        pretrained_name_or_path: str | Path,
        *,
        config: MMEVLAConfig | None = None,
        revision: str | None = None,
        token: str | None = None,
        dataset_stats: Any = None,
        dataset_meta: Any = None,
        **_: Any,
    ) -> Self:
        """Load what `save_pretrained` wrote; no weight is initialised first, and every tensor has
        to fit.

        Raises:
            UserError: no checkpoint of this kind, a damaged one, or a plugin that is not imported
                (`--policy.discover_packages_path=<package>` imports one).
        """
        folder = local_folder(pretrained_name_or_path, revision, token)
        Sums(folder).check(CONFIG)  # earlier folders of this plugin do not list it
        settings: Any = PreTrainedConfig.from_pretrained(folder) if config is None else config
        if settings.composition is None:
            raise UserError(
                f"{folder} holds no configuration of mme-vla: its config.json lacks 'composition'."
            )
        sections = json.loads(settings.composition)
        import_trusted(sections, str(folder), False)
        model = build_saved(policy_class(sections), sections, str(folder))
        tensors = {
            name.removeprefix(PREFIX): tensor for name, tensor in load_tensors(folder).items()
        }
        assign_tensors(model, tensors, str(folder))
        recompute_buffers(model)
        model.processor = load_processor(folder)
        check_processor(model, str(folder))
        loaded = cls(settings, dataset_stats=dataset_stats, dataset_meta=dataset_meta, model=model)
        return loaded.to(settings.device).eval()


def _built(config: MMEVLAConfig) -> Policy:
    """The policy that a configuration describes, with fresh weights or those to start from."""
    folders = [] if config.config_dir is None else [Path(config.config_dir).resolve()]
    words = [f"model={config.model}", *config.overrides]
    model = build_from_config(compose("policy", words, extra_dirs=folders), seed=config.seed)
    if config.init_from is not None:
        start_from(model, config.init_from)
    return model


def _as_uint8(images: Tensor) -> np.ndarray:
    """LeRobot's images [b, 3, H, W] in [0, 1] as they were, [b, H, W, 3] uint8."""
    converted = (
        images if images.dtype == torch.uint8 else (images.float() * 255).round().to(torch.uint8)
    )
    return converted.permute(0, 2, 3, 1).cpu().numpy()
