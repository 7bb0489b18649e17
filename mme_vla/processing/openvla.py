"""`OpenVlaProcessor`: pictures, words, states and actions as OpenVLA-OFT takes them."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor

from mme_vla.errors import UserError, brief
from mme_vla.processing.base import Counted, Sample
from mme_vla.processing.clipped_quantiles import ClippedQuantiles
from mme_vla.processing.openvla_pictures import jpeg_round_trip, lanczos
from mme_vla.processing.pictures import as_uint8_frames, to_unit_range
from mme_vla.processing.processor import Processor
from mme_vla.registry import PROCESSORS
from mme_vla.types import Batch


@PROCESSORS.register("openvla")
class OpenVlaProcessor(Processor):
    """Lanczos-3 pictures, Llama's words, clipped quantiles of raw numbers, and the state for the network."""

    counted = Counted(horizon=1, every=True, extremes=True, exact=True)
    full_chunks_only = True
    jpeg: bool = False
    """Write every picture as JPEG and read it again before it is resized, as the original's data were."""

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> Self:
        """As `Processor.from_config`, with `jpeg` beside the other settings.

        Raises:
            UserError: also where the network's actions are wider than the robot's.
        """
        jpeg = config.get("jpeg", False)
        if not isinstance(jpeg, bool):
            raise UserError(f"processor.jpeg must be true or false, not {brief(jpeg)}.")
        built = super().from_config({key: value for key, value in config.items() if key not in ("name", "jpeg")})
        if built.embodiment.action.width != built.action_dim:
            raise UserError(
                f"backbone.action_dim={built.action_dim}: this network's actions are as wide as the robot's, "
                f"{built.embodiment.action.width}."
            )
        built.jpeg = jpeg
        return built

    # Pictures

    def images(self, views: Sequence[np.ndarray | Tensor]) -> Tensor:
        """As `Processor.images`, resized with Lanczos-3; a crop or an augmentation is the policy's."""
        return super().images([self._resized(as_uint8_frames(view)) for view in views])

    def memory_images(self, frames: np.ndarray | Tensor, device: torch.device | str | None = None) -> Tensor:
        """As `Processor.memory_images`, resized with Lanczos-3; neither cropped nor augmented."""
        array = frames.cpu().numpy() if isinstance(frames, Tensor) else frames
        resized = torch.from_numpy(np.require(self._resized(array), requirements=["C", "W"]))
        return to_unit_range(resized.to(device) if device is not None else resized).movedim(-1, 1)

    @property
    def memory_pictures(self) -> str:
        """Whether they are JPEG in between."""
        return "jpeg" if self.jpeg else ""

    def _resized(self, frames: np.ndarray) -> np.ndarray:
        return lanczos(jpeg_round_trip(frames) if self.jpeg else frames, self.image_size)

    # Words

    def prompt(self, *given: Any, **named: Any) -> tuple[Tensor, Tensor]:
        """As `Processor.prompt`, closed by the piece `▁`, whose state answers for the first number of the chunk."""
        ids, mask = super().prompt(*given, **named)
        place = min(int(mask.sum()), len(ids) - 1)
        ids[place], mask[place] = self.tokenizer.piece("▁"), True
        return ids, mask

    # Numbers

    def proprio(self, state: np.ndarray | Tensor) -> Tensor:
        """Raw states [..., s], normalised and clipped, for the network to read."""
        stats = self.require_stats().state
        return ClippedQuantiles.of(stats).normalize(torch.as_tensor(state, dtype=torch.float32))

    def actions(self, chunk: np.ndarray | Tensor, state: np.ndarray | Tensor) -> Tensor:
        """As `Processor.actions`, clipped."""
        raw = self.embodiment.action.to_relative(*(torch.as_tensor(x, dtype=torch.float32) for x in (chunk, state)))
        return ClippedQuantiles.of(self.require_stats().actions).normalize(raw)

    def absolute_actions(self, chunk: Tensor, state: Tensor) -> Tensor:
        """As `Processor.absolute_actions`."""
        raw = ClippedQuantiles.of(self.require_stats().actions).unnormalize(chunk.float())
        return self.embodiment.action.to_absolute(raw, state.to(raw))

    # Batches

    def item(self, sample: Sample) -> dict[str, Any]:
        """As `Processor.item`, with the normalised state `proprio` [s]."""
        return super().item(sample) | {"proprio": self.proprio(sample.states[-1])}

    def collate(self, items: Sequence[dict[str, Any]]) -> Batch:
        """As `Processor.collate`."""
        return replace(super().collate(items), proprio=torch.stack([item["proprio"] for item in items]))

    def to_config(self) -> dict[str, Any]:
        """As `Processor.to_config`."""
        return {"name": "openvla", **super().to_config(), "jpeg": self.jpeg}
