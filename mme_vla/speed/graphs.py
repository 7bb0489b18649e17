"""A chunk as one CUDA graph: thousands of kernel launches become one, for each batch size that
occurs.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from mme_vla.types import Batch, MemoryTokens, TensorStruct

Inputs = Mapping[str, Tensor | TensorStruct]
"""What a chunk is computed from, by name; every tensor [b, …]."""

Run = Callable[[Inputs], Tensor]
"""Inputs → chunks [b, h, a], without waiting for the GPU anywhere."""


@dataclass
class _Captured:
    graph: torch.cuda.CUDAGraph
    inputs: Inputs
    chunks: Tensor


class GraphSampler:
    """Captures `run` once for every size, and replays it from then on.

    Batches are padded to a power of two with rows whose output is ignored, so that few sizes occur.
    All graphs share one pool of memory: a chunk is copied out before the next one is computed.

    Args:
        run: what is captured; it must give the same for a row whatever stands beside it.
    """

    def __init__(self, run: Run) -> None:
        self._run = run
        self._captured: dict[tuple[object, ...], _Captured] = {}
        self._pool: Any = None
        self._stream: Any = None

    def __len__(self) -> int:
        """Sizes captured so far."""
        return len(self._captured)

    @torch.no_grad()
    def __call__(self, inputs: Inputs) -> Tensor:
        """The chunks [b, h, a] of a batch, on the GPU."""
        tensors = _tensors(inputs)
        rows = len(tensors[0])
        capacity = 1 << (rows - 1).bit_length()
        key = (capacity, *((tuple(x.shape[1:]), x.dtype) for x in tensors))
        if key not in self._captured:
            # The last row over and over where there are fewer.
            full = _map(
                inputs, lambda x: torch.cat([x, x[-1:].expand(capacity - len(x), *x.shape[1:])])
            )
            self._captured[key] = self._capture(full)
        captured = self._captured[key]
        for static, x in zip(_tensors(captured.inputs), tensors, strict=True):
            static[:rows].copy_(x)
        captured.graph.replay()
        return captured.chunks[:rows].clone()

    def _capture(self, inputs: Inputs) -> _Captured:
        if self._pool is None:
            self._pool, self._stream = torch.cuda.graph_pool_handle(), torch.cuda.Stream()
        # Libraries choose their kernels and take their workspaces (cuBLAS 32 MiB a stream) in a
        # first run, which no graph may hold: on the stream that all graphs are captured on, so that
        # they are there.
        self._stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(self._stream):
            self._run(inputs)
        torch.cuda.current_stream().wait_stream(self._stream)
        graph = torch.cuda.CUDAGraph()
        # Other threads may use the GPU meanwhile: a subgoal predictor does.
        with torch.cuda.graph(graph, self._pool, self._stream, capture_error_mode="thread_local"):
            chunks = self._run(inputs)
        return _Captured(graph, inputs, chunks)


def _map(inputs: Inputs, change: Callable[[Tensor], Tensor]) -> Inputs:
    changed: dict[str, Tensor | TensorStruct] = {}
    for name, x in inputs.items():
        changed[name] = change(x) if isinstance(x, Tensor) else x._map(change)
    return changed


def _tensors(inputs: Inputs) -> list[Tensor]:
    tensors: list[Tensor] = []
    for value in inputs.values():
        if isinstance(value, Tensor):
            tensors.append(value)
        else:
            tensors += value.tensors()
    return tensors


class CapturedSampling:
    """A policy's sampler behind graphs: one `GraphSampler` for each number of steps.

    Args:
        sample: (batch, noise, steps, memory) → chunks, as `MMEModel.sample`.
        stamp: what graphs depend on beside their inputs and the places of weights; where it changes
            they are captured again.
    """

    def __init__(self, sample: Callable[..., Tensor], stamp: Callable[[], object]) -> None:
        self._sample, self._stamp = sample, stamp
        self._graphs: dict[int, GraphSampler] = {}
        self._captured_at: object = None

    def __call__(
        self, batch: Batch, noise: Mapping[str, Tensor], steps: int, memory: MemoryTokens | None
    ) -> Tensor:
        """Chunks [b, h, a]."""
        stamp = self._stamp()
        if stamp != self._captured_at:
            self._graphs = {}
            self._captured_at = stamp
        if steps not in self._graphs:
            self._graphs[steps] = GraphSampler(lambda inputs: self._run(inputs, steps))
        inputs: dict[str, Tensor | TensorStruct] = {
            "batch": replace(batch, history=None, actions=None, action_mask=None), **noise,
        }  # fmt: skip
        if memory is not None:
            inputs["memory"] = replace(memory, metrics={})
        return self._graphs[steps](inputs)

    def _run(self, inputs: Inputs, steps: int) -> Tensor:
        noise = {name: value for name, value in inputs.items() if isinstance(value, Tensor)}
        return self._sample(inputs["batch"], noise, steps, inputs.get("memory"))
