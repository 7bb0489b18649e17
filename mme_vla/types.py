"""The containers everyone shares.

One legend for shapes, used in the whole library:

b batch · n tokens, or episodes of a call · d width · t frames · v views (cameras) · h action
horizon · a action width · w width of an executed action · l prompt length · N query heads · K key
and value heads · e width of a head
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, Self

import numpy as np
import torch
from torch import Tensor


def send(x: Tensor, device: torch.device) -> Tensor:
    """A tensor on a device; from the CPU to a GPU through page-locked memory, without waiting for
    the copy.
    """
    if device.type == "cuda" and not x.is_cuda:
        return x.pin_memory().to(device, non_blocking=True)
    return x.to(device)


def to_unit_range(images: Tensor) -> Tensor:
    """Map uint8 0…255 to float32 -1…1."""
    # In place: the images of an episode are large, and each step would take as much memory again.
    return images.to(torch.float32, copy=True).div_(255).mul_(2).sub_(1)


Noise = dict[str, Tensor]
"""Random numbers by name, one row a sample. The caller makes them, so that batching and sharding
cannot change them.
"""


def named_noise(noise: Mapping[str, Tensor] | Tensor | None, time: Tensor | None = None) -> Noise:
    """Noise by name; a bare tensor is a flow's `noise`, with its times beside it."""
    named = {"noise": noise} if isinstance(noise, Tensor) else dict(noise or {})
    if time is not None:
        named["time"] = time
    return named


def stack_noise(rows: Sequence[Mapping[str, Tensor]]) -> Noise:
    """Noise of single samples (`sampling_noise`) as that of a batch."""
    if not rows:
        return {}
    return {name: torch.stack([row[name] for row in rows]) for name in rows[0]}


def map_noise(noise: Mapping[str, Tensor], change: Callable[[Tensor], Tensor]) -> Noise:
    """Every value through `change`: rows of a batch, another device."""
    return {name: change(value) for name, value in noise.items()}


def check_mask(what: str, mask: Tensor, shape: Sequence[int]) -> None:
    """Raise an error unless a mask is bool and of a shape: one of numbers would be added or counted
    somewhere, and one row broadcast.
    """
    if not isinstance(mask, Tensor) or mask.dtype != torch.bool or mask.shape != tuple(shape):
        kind, size = getattr(mask, "dtype", mask), list(getattr(mask, "shape", ()))
        raise ValueError(f"{what} is {kind} {size}: it must be torch.bool {list(shape)}.")


class Labels(dict[str, Tensor]):
    """Labels, or losses, by name, each [b, …]. Inside a `TensorStruct` they move with it."""


class TensorStruct:
    """A dataclass of tensors (or nested structs, labels, or None) that moves between devices as
    one.
    """

    def _map(self, fn: Any) -> Self:
        values = {}
        for member in fields(self):  # type: ignore[arg-type]
            value = getattr(self, member.name)
            if isinstance(value, Tensor):
                values[member.name] = fn(value)
            elif isinstance(value, TensorStruct):
                values[member.name] = value._map(fn)
            elif isinstance(value, Labels):
                values[member.name] = Labels({name: fn(label) for name, label in value.items()})
            else:
                values[member.name] = value
        return type(self)(**values)

    def to(self, *args: Any, **kwargs: Any) -> Self:
        """Return a copy whose tensors went through `Tensor.to` with these arguments. As in
        `nn.Module.to`, masks and integers keep their type.
        """

        def convert(x: Tensor) -> Tensor:
            y = x.to(*args, **kwargs)
            if x.is_floating_point() or y.dtype == x.dtype:
                return y
            return x.to(y.device)

        return self._map(convert)

    def sent(self, device: torch.device) -> Self:
        """Return a copy on a device, made without waiting: see `send`."""
        return self._map(lambda x: send(x, device))

    def rows(self, index: Tensor | slice) -> Self:
        """Return the rows of every tensor that `index` names: numbers [n], a mask, or a slice."""
        return self._map(lambda x: x[index])

    def pin_memory(self) -> Self:
        """Return a copy in page-locked memory (what `DataLoader(pin_memory=True)` calls)."""
        return self._map(lambda x: x.pin_memory())

    def tensors(self) -> Iterator[Tensor]:
        """Yield every tensor, nested ones included."""
        for member in fields(self):  # type: ignore[arg-type]
            value = getattr(self, member.name)
            if isinstance(value, Tensor):
                yield value
            elif isinstance(value, TensorStruct):
                yield from value.tensors()
            elif isinstance(value, Labels):
                yield from value.values()


@dataclass(frozen=True)
class FrameBatch:
    """Consecutive frames of one camera, of which some have an image.

    images: [n, H, W, 3] uint8.
    index: [n] int64, ascending; which of the `length` frames they show.
    """

    images: np.ndarray
    index: np.ndarray
    length: int

    @classmethod
    def of(
        cls, images: np.ndarray, index: np.ndarray | None = None, length: int | None = None
    ) -> Self:
        """A batch; by default every frame has an image."""
        if length is None:
            length = len(images)
        if index is None:
            index = np.arange(length)
        return cls(images, np.asarray(index, np.int64), length)

    def select(self, frames: np.ndarray) -> np.ndarray:
        """Images of frames that have one."""
        return self.images[np.searchsorted(self.index, frames)]

    def image(self, frame: int) -> np.ndarray | None:
        """The image of a frame, if it has one."""
        row = int(np.searchsorted(self.index, frame))
        if row == len(self.index) or int(self.index[row]) != frame:
            return None
        return self.images[row]


@dataclass
class HistoryTokens(TensorStruct):
    """Selected past vision tokens, zero-padded.

    features: [b, n, d_vision]; pooled vision tokens as stored: bfloat16 unless
        `policy.history_dtype` is another.
    positions: [b, n, 3]; (frame, row, column) of each token: the frame counted from the episode's
        first, video included, the rest patch centres in sixteenths of a view's side.
    mask: [b, n] bool; False on padding.
    step: [b] int64; the current frame, counted like the others. None where it is not needed.
    labels: in training, the labels of each token's frame that the memory reads (`ReadsLabels`),
        each [b, n] or [b, n, k] float32, 0 on padding. Empty in episodes.
    """

    features: Tensor
    positions: Tensor
    mask: Tensor
    step: Tensor | None = None
    labels: Labels = field(default_factory=Labels)

    def __post_init__(self) -> None:
        check_mask("HistoryTokens.mask", self.mask, self.features.shape[:-1])
        if not self.features.is_floating_point():
            raise ValueError(
                f"HistoryTokens.features is {self.features.dtype}: it must be of floats. A cache"
                " holds bfloat16 as uint16: features.view(torch.bfloat16)."
            )

    @property
    def ages(self) -> Tensor | None:
        """How many frames before the current one each token's frame lies, [b, n] float32; 0 on
        padding.
        """
        if self.step is None:
            return None
        return (self.step[..., None] - self.positions[..., 0]).float() * self.mask


@dataclass
class MemoryTokens(TensorStruct):
    """What every neural memory hands over: at most `budget` valid tokens.

    tokens: [b, budget, d].
    mask: [b, budget] bool. Where it is False the token's value is undefined.
    metrics: scalars that a memory reports of how it came to these tokens, detached.
    ages: [b, budget] float32; frames between the frame of a token and the current one. None where
        tokens belong to no frame, or the selection has no number of the current frame.
    losses: auxiliary losses by name, each [b], with gradients. Only training reads them
        (`train.losses`).
    """

    tokens: Tensor
    mask: Tensor
    metrics: dict[str, Tensor] = field(default_factory=dict)
    ages: Tensor | None = None
    losses: dict[str, Tensor] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.losses = Labels(self.losses)  # rows of the tokens are rows of these
        check_mask("MemoryTokens.mask", self.mask, self.tokens.shape[:-1])

    def logged(self) -> dict[str, Tensor]:
        """The metrics under the names of a training's log, `memory/<name>`."""
        return {f"memory/{name}": value for name, value in self.metrics.items()}


@dataclass
class Overlap(TensorStruct):
    """Actions of the chunk before that are still to be executed; the sampling of a new chunk is
    pulled towards them.

    actions: [b, h, a]; normalised as the network predicts.
    weight: [b, h, a] in [0, 1]: how strongly the chunk is pulled towards each number; 0 where the
        chunk before has none.
    """

    actions: Tensor
    weight: Tensor


@dataclass
class PastViews(TensorStruct):
    """Views of past frames, for a vision tower that reads them along with the current ones.

    images: [b, k, v, 3, s, s] uint8, oldest first, the current frame not among them; float in
        [−1, 1] once they are as the tower takes them.
    mask: [b, k] bool; False on frames before the episode's first.
    every: each so-many-th layer of the tower attends through time, and at least its last.
    """

    images: Tensor
    mask: Tensor
    every: int


@dataclass
class Batch(TensorStruct):
    """What the network reads, and for training what it should return.

    images: [b, v, 3, s, s] uint8; the views at the vision tower's resolution, in the embodiment's
        order.
    image_mask: [b, v] bool; False hides a view.
    prompt: [b, l] int64 token ids.
    prompt_mask: [b, l] bool.
    history: the memory's selection, None for a policy without memory.
    actions: [b, h, a]; normalised, padded chunk. None when sampling.
    action_mask: [b, h] bool; steps that count in the loss. None counts all.
    state: [b, s]; raw state of the robot: it anchors relative actions, and backbones may read it.
    proprio: [b, s]; normalised state, for the networks that read it.
    view_tokens: [b, v, n, d]; a frozen tower's tokens of `images`, where they were made beforehand.
    overlap: what a sampled chunk is to agree with; None where it is free.
    past: past views that a memory gives along with the current ones; None for all others.
    options: [b, letters] bool; the letters offered to a policy that chooses among options. None
        means all.
    weight: [b] float32; multiplies each sample's loss (`data.weights`). None counts all alike.
    labels: in training, labels of the current frame (`ReadsLabels` of any part but the memory).
    """

    images: Tensor
    image_mask: Tensor
    prompt: Tensor
    prompt_mask: Tensor
    history: HistoryTokens | None = None
    actions: Tensor | None = None
    action_mask: Tensor | None = None
    state: Tensor | None = None
    proprio: Tensor | None = None
    view_tokens: Tensor | None = None
    overlap: Overlap | None = None
    past: PastViews | None = None
    options: Tensor | None = None
    weight: Tensor | None = None
    labels: Labels = field(default_factory=Labels)

    def without_prompt_padding(self, multiple: int = 16) -> "Batch":
        """Drop the columns on the right that no prompt of the batch uses, keeping a multiple of
        `multiple`.

        Nothing attends to padding and nothing counts it, so the answer is the same and cheaper.
        Done where batches are made, on the CPU: the network itself never reads content.
        """
        columns = torch.arange(1, self.prompt_mask.shape[1] + 1, device=self.prompt_mask.device)
        longest = int((self.prompt_mask * columns).max())  # up to the last used one
        length = -(-longest // multiple) * multiple  # rounded up; slicing ends at the prompt's own
        return replace(
            self, prompt=self.prompt[:, :length], prompt_mask=self.prompt_mask[:, :length]
        )


class ReadsLabels:
    """Capability of a memory, an integration or a backbone: it learns from labels of the dataset.

    reads_labels: columns of numbers in the dataset: `subtask_boundary` (1 where a sub-task begins,
        else 0), `subtask_index` (how many sub-tasks have begun), and the same of facts,
        `fact_visible` and `fact_index`. A memory has them by frame in `HistoryTokens.labels`, the
        others of the current frame in `Batch.labels`.
    """

    reads_labels: Sequence[str] = ()


def labels_read(*parts: object) -> tuple[str, ...]:
    """Names of the labels that some parts of a policy read, each once."""
    names: list[str] = []
    for part in parts:
        if isinstance(part, ReadsLabels):
            names += part.reads_labels
    return tuple(dict.fromkeys(names))
