"""MemoryVLA's retrieval: from banks that are written one by one, or from a memory's tokens."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from mme_vla.memory.extensions.bank import MemoryBank, Retrieval
from mme_vla.types import MemoryTokens


class MemoryRetrieval(Retrieval):
    """Retrieval from the tokens of a memory of the library."""

    def read_memory(self, memory: MemoryTokens, tokens: Tensor) -> Tensor:
        """Fused tokens [b, k, d], from the current ones and a memory's tokens [b, n, read] in place
        of entries.
        """
        # Tokens where the mask is False are undefined: a weight of 0 alone would let a nan through.
        entries = memory.tokens.masked_fill(~memory.mask[..., None], 0).to(tokens)
        retrieved = self.retrieve_from(tokens, entries[:, :, None], valid=memory.mask)
        return self.fuse(tokens, retrieved)


@dataclass(frozen=True)
class BankState:
    """The content of a bank in one episode, in the order of time, without gradients.

    entries: [t, n, d].
    times: [t] int64.
    merged: where the last update merged two entries; −1 where it did not.
    """

    entries: Tensor
    times: Tensor
    merged: int = -1

    def __len__(self) -> int:
        return len(self.times)


class EpisodeBank(MemoryBank):
    """A bank whose state belongs to an episode: `init_state`, `read`, `update`."""

    def __init__(self, width: int, *, store_fused: bool = False, **options: Any) -> None:
        """Build an empty bank.

        Args:
            width, options: as for `MemoryBank`.
            store_fused: store the fused tokens instead of the current ones.
        """
        super().__init__(width, **options)
        self.store_fused = store_fused

    def init_state(self, tokens: int) -> BankState:
        """An empty bank for moments of so many tokens."""
        weight = next(self.parameters())
        times = torch.zeros(0, dtype=torch.int64, device=weight.device)
        return BankState(weight.new_zeros(0, tokens, self.width), times)

    def retrieve(self, states: Sequence[BankState], tokens: Tensor) -> Tensor:
        """Retrieve from the banks of b episodes with their current tokens [b, n, d]; an empty bank
        returns these.
        """
        lengths = [len(state) for state in states]
        longest = max(lengths)
        if not longest:
            return tokens
        padded = []
        padded_times = []
        for state in states:
            missing = longest - len(state)
            padded.append(functional.pad(state.entries, (0, 0, 0, 0, 0, missing)))
            padded_times.append(functional.pad(state.times, (0, missing)))
        entries = torch.stack(padded)  # b t n d
        times = torch.stack(padded_times)
        valid = None
        if min(lengths) < longest:
            places = torch.arange(longest, device=tokens.device)
            valid = places < torch.tensor(lengths, device=tokens.device)[:, None]
        return self.retrieve_from(tokens, entries.to(tokens), times.to(tokens.device), valid)

    def read(self, states: Sequence[BankState], tokens: Tensor) -> Tensor:
        """Fused tokens [b, n, d] of b episodes, from the current ones and their banks."""
        return self.fuse(tokens, self.retrieve(states, tokens))

    def update(self, state: BankState, tokens: Tensor, fused: Tensor, time: int) -> BankState:
        """The bank after a moment [n, d] at `time` with fused tokens [n, d]; without gradients."""
        stored = (fused if self.store_fused else tokens).detach()
        entries = torch.cat([state.entries.to(stored), stored[None]])
        times = torch.cat([state.times, state.times.new_tensor([time])])
        if len(times) <= self.length:
            return BankState(entries, times)
        if self.consolidation == "fifo":
            return BankState(entries[1:], times[1:])
        # The two neighbours that are most alike become their mean, at the earlier's time.
        alike = functional.cosine_similarity(entries[:-1], entries[1:], dim=-1).mean(-1)
        i = int((alike == alike.max()).nonzero()[0])
        merged = (entries[i : i + 1] + entries[i + 1 : i + 2]) / 2
        return BankState(
            entries=torch.cat([entries[:i], merged, entries[i + 2 :]]),
            times=torch.cat([times[: i + 1], times[i + 2 :]]),
            merged=i,
        )

    def run(
        self,
        tokens: Tensor,
        times: Tensor,
        sequences: Sequence[Tensor],
        states: Sequence[BankState] | None = None,
    ) -> tuple[Tensor, list[BankState]]:
        """Take sequences of moments side by side, each in its own bank.

        Args:
            tokens: [m, n, d], all moments.
            times: [m] int64.
            sequences: places in them, each sequence in the order of time.
            states: banks the sequences continue with; empty ones by default.

        Returns:
            Fused tokens [m, n, d], and the bank after each sequence.
        """
        if states is None:
            banks = [self.init_state(tokens.shape[1]) for _ in sequences]
        else:
            banks = list(states)
        moment_times = times.tolist()
        fused: list[Tensor] = []
        fused_indices: list[Tensor] = []
        for step in range(max(len(sequence) for sequence in sequences)):
            running = [i for i, sequence in enumerate(sequences) if step < len(sequence)]
            indices = torch.stack([sequences[i][step] for i in running]).to(tokens.device)
            output = self.read([banks[i] for i in running], tokens[indices])
            for row, i in enumerate(running):
                index = int(sequences[i][step])
                banks[i] = self.update(banks[i], tokens[index], output[row], moment_times[index])
            fused.append(output)
            fused_indices.append(indices)
        order = torch.cat(fused_indices).argsort()
        return torch.cat(fused)[order], banks
