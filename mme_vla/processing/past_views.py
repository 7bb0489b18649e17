"""Pictures of an episode's latest frames, for a memory whose backbone looks back at them."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from mme_vla.errors import UserError
from mme_vla.memory.base import LooksBack
from mme_vla.types import PastViews

Prepare = Callable[[Sequence[np.ndarray]], Tensor]
"""Pictures [n, H, W, 3] uint8 of every camera in the embodiment's order → [n, v, 3, s, s] uint8."""


class PastPictures:
    """Holds an episode's pictures as they came, as far back as is looked; they are prepared when they are asked for.

    Which of them are looked at is known only when the policy acts, and preparing one costs more than keeping it.
    """

    def __init__(self, look: LooksBack) -> None:
        self.look = look
        self._frames: dict[int, list[np.ndarray]] = {}
        self._count = 0

    def take(self, views: Mapping[str, np.ndarray], count: int, drawn: Mapping[str, np.ndarray] | None) -> None:
        """Add the next `count` frames of every camera; `drawn` as in `Episode.observe`."""
        first, self._count = self._count, self._count + count
        oldest = self._count - 1 - self.look.reach
        for frame in range(max(oldest, first), self._count):
            places = [_place(frame - first, None if drawn is None else drawn[name]) for name in views]
            if all(place is not None for place in places):
                shown = zip(views.values(), places, strict=True)
                self._frames[frame] = [view[place].copy() for view, place in shown if place is not None]
        self._frames = {frame: kept for frame, kept in self._frames.items() if frame >= oldest}

    def at(self, step: int, prepare: Prepare) -> PastViews:
        """Past views of a step, unbatched: `images` [k, v, 3, s, s] uint8 and `mask` [k].

        Raises:
            UserError: one of these frames was not drawn.
        """
        return past_views(self.look, step, self._read, prepare)

    def _read(self, frames: np.ndarray) -> list[np.ndarray]:
        lacking = [frame for frame in frames.tolist() if frame not in self._frames]
        if lacking:
            raise UserError(
                f"This policy looks back at the frames {lacking[:5]}, which were not drawn of every camera: what "
                "`frames_read` names has to be observed with all pictures."
            )
        shown = [self._frames[frame] for frame in frames.tolist()]
        return [np.stack(of_camera) for of_camera in zip(*shown, strict=True)]


def past_views(
    look: LooksBack, step: int, read: Callable[[np.ndarray], Sequence[np.ndarray]], prepare: Prepare
) -> PastViews:
    """Past views of a step, unbatched; where there is no such frame yet, black pictures that nobody sees.

    Args:
        read: frames [n], ascending, at least one → pictures [n, H, W, 3] of every camera.
    """
    wanted = look.at(step)
    there = wanted >= 0
    # The current frame goes along where there is no other: it says how large pictures are.
    frames = wanted[there] if there.any() else np.array([step])
    found = prepare(read(frames))
    images = found.new_zeros(len(wanted), *found.shape[1:])
    if there.any():
        images[torch.from_numpy(there)] = found
    return PastViews(images, torch.from_numpy(there), look.every)


def stack_past(items: Sequence[PastViews | None]) -> PastViews | None:
    """Unbatched past views as those of a batch; None where there are none."""
    given = [item for item in items if item is not None]
    if not given:
        return None
    return PastViews(
        torch.stack([item.images for item in given]), torch.stack([item.mask for item in given]), given[0].every
    )


def full_past(look: LooksBack | None, views: int, size: int, device: torch.device | str) -> PastViews | None:
    """Past views of a batch of one, all there and without content."""
    if look is None:
        return None
    images = torch.zeros(1, look.frames - 1, views, 3, size, size, dtype=torch.uint8, device=device)
    return PastViews(images, torch.ones(images.shape[:2], dtype=torch.bool, device=device), look.every)


def _place(offset: int, drawn: np.ndarray | None) -> int | None:
    if drawn is None:
        return offset
    at = int(np.searchsorted(drawn, offset))
    return at if at < len(drawn) and int(drawn[at]) == offset else None
