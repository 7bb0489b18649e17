"""What a memory remembers along an episode, as a video: the contact sheet of every few steps."""

from collections.abc import Iterator

import numpy as np
from PIL import Image

from mme_vla.data.episodes import EpisodeSource
from mme_vla.data.memory_image import memory_sheet
from mme_vla.errors import UserError
from mme_vla.memory.base import Memory, make_scorer
from mme_vla.memory.history import OnlineHistory


def selection_sheets(
    source: EpisodeSource, episode: int, memory: Memory, name: str, every: int = 8
) -> Iterator[tuple[int, Image.Image]]:
    """Draw what `memory` remembers at the first execution step and at every `every`-th after it.

    Selections need no weights: the tokens stored are empty.

    Yields:
        (step, image); images grow with what is remembered.
    """
    import torch

    if not 0 <= episode < len(source):
        raise UserError(f"episode={episode}: {source.name} has episodes 0 … {len(source) - 1}.")
    if every < 1:
        raise UserError(f"every={every} must be at least 1: the steps between two images.")
    start, length = int(source.exec_starts[episode]), int(source.lengths[episode])
    frames = source.frames(episode, np.arange(length))
    history, patches = OnlineHistory(memory.storage, make_scorer(memory), start), memory.storage.grid**2
    n_observed = 0
    for step in range(start, length, every):
        part = frames[n_observed : step + 1]
        history.append(part, torch.zeros(len(history.to_encode(len(part))), patches, 1))
        n_observed = step + 1
        selected = memory.select(history, step)
        title = f"{name} at step {step}: {len(selected)} of {memory.budget} tokens · {source.goal(episode)}"
        yield step, memory_sheet(frames[: step + 1], selected, memory.storage.grid, start, step, title)
