"""A chunk as one CUDA graph: thousands of kernel launches become one, for each batch size that
occurs.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from mme_vla.types import Batch, Labels, MemoryTokens, TensorStruct


@dataclass
class Inputs(TensorStruct):
    """What a chunk is computed from; every tensor [b, …]."""

    batch: Batch
    noise: Labels
    memory: MemoryTokens | None


@dataclass
class _Captured:
    graph: torch.cuda.CUDAGraph
    inputs: Inputs
    chunks: Tensor


class CapturedSampling:
    """A policy's sampler, captured once for every size and number of steps, and replayed from then
    on.

    Batches are padded to a power of two with rows whose output is ignored, so that few sizes occur.
    All graphs share one pool of memory: a chunk is copied out before the next one is computed.

    Args:
        sample: (batch, noise, steps, memory) → chunks [b, h, a], as `MMEModel.sample`, without
            waiting for the GPU anywhere. It must give the same for a row whatever stands beside it.
        stamp: what graphs depend on beside their inputs and the places of weights; where it changes
            they are captured again.
    """

    def __init__(self, sample: Callable[..., Tensor], stamp: Callable[[], object]) -> None:
        self._sample, self._stamp = sample, stamp
        self._captured: dict[tuple[object, ...], _Captured] = {}
        self._captured_at: object = None
        self._pool: Any = None
        self._stream: Any = None

    @torch.no_grad()
    def __call__(
        self, batch: Batch, noise: Mapping[str, Tensor], steps: int, memory: MemoryTokens | None
    ) -> Tensor:
        """The chunks [b, h, a] of a batch, on the GPU."""
        stamp = self._stamp()
        if stamp != self._captured_at:
            self._captured = {}
            self._captured_at = stamp
            self._pool = None
        batch = replace(batch, history=None, actions=None, action_mask=None)
        if memory is not None:
            memory = replace(memory, metrics={})
        inputs = Inputs(batch, Labels(noise), memory)
        tensors = list(inputs.tensors())
        rows = len(tensors[0])
        capacity = 1 << (rows - 1).bit_length()
        key = (steps, capacity, *((tuple(x.shape[1:]), x.dtype) for x in tensors))
        with torch.cuda.device(tensors[0].device):  # streams are those of the current GPU
            if key not in self._captured:
                # The last row over and over where there are fewer.
                full = inputs._map(
                    lambda x: torch.cat([x, x[-1:].expand(capacity - len(x), *x.shape[1:])])
                )
                self._captured[key] = self._capture(full, steps)
            captured = self._captured[key]
            for static, x in zip(captured.inputs.tensors(), tensors, strict=True):
                static[:rows].copy_(x)
            captured.graph.replay()
            return captured.chunks[:rows].clone()

    def _capture(self, inputs: Inputs, steps: int) -> _Captured:
        if self._pool is None:
            self._pool = torch.cuda.graph_pool_handle()
        # One for good on each GPU: libraries keep workspaces for every stream.
        if self._stream is None or self._stream.device_index != torch.cuda.current_device():
            self._stream = torch.cuda.Stream()
        # Libraries choose their kernels and take their workspaces (cuBLAS 32 MiB a stream) in a
        # first run, which no graph may hold: on the stream that all graphs are captured on, so that
        # they are there.
        self._stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(self._stream):
            self._run(inputs, steps)
        torch.cuda.current_stream().wait_stream(self._stream)
        graph = torch.cuda.CUDAGraph()
        # Other threads may use the GPU meanwhile: a subgoal predictor does.
        with torch.cuda.graph(graph, self._pool, self._stream, capture_error_mode="thread_local"):
            chunks = self._run(inputs, steps)
        return _Captured(graph, inputs, chunks)

    def _run(self, inputs: Inputs, steps: int) -> Tensor:
        return self._sample(inputs.batch, inputs.noise, steps, inputs.memory)
