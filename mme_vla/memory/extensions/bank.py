"""Memory banks (MemoryVLA): learned tokens of past moments that are written, retrieved, fused and
merged.

Unlike the memories that choose among stored vision tokens, a bank keeps what the network itself
made of a moment, and is asked with the tokens of the current one. Its state belongs to an episode:
`init_state`, `read`, `update`.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from mme_vla.errors import check_choice, check_sizes, require
from mme_vla.memory.extensions.attending import FrameMemory, by_frame
from mme_vla.memory.history import StorageSpec
from mme_vla.memory.recurrent import check_every, default_hidden, recurrent_frames
from mme_vla.registry import MEMORIES
from mme_vla.types import HistoryTokens, MemoryTokens


@MEMORIES.register("bank")
class Banked(FrameMemory):
    """grid×grid tokens of the current frame, each fused with what it retrieves from the bank."""

    pad_left = True

    def __init__(
        self,
        d_vision: int,
        width: int,
        budget: int = 64,
        grid: int = 8,
        pooling: str = "mean",
        *,
        stride: int = 16,
        every: int = 1,
        moments: int = 32,
        video: int = 16,
        hidden: int | None = None,
        length: int = 16,
        retrieval_layers: int = 2,
        time_code: bool = True,
        fusion: str = "gate",
        consolidation: str = "tome",
    ) -> None:
        """Put the parts together.

        Args:
            d_vision: width of a vision token. width: of a memory token, given by the integration.
            budget: most memory tokens; grid×grid of them are made.
            grid, pooling: a moment is grid×grid tokens.
            stride, every, moments, video: which frames are moments (`recurrent_frames`), the
                current one among them.
            hidden: width of the bank; by default a quarter of `d_vision`, at least 64.
            length, retrieval_layers, time_code, fusion, consolidation: as for `MemoryBank`.
        """
        super().__init__()
        check_sizes("memory", grid=grid, stride=stride, video=video)
        check_every(every, stride)
        require(
            1 < moments > video,
            f"memory.moments={moments} must be at least 2, and more than memory.video={video}.",
        )
        require(
            budget >= grid**2,
            f"memory.budget={budget} does not hold the {grid}×{grid} tokens of a frame: {grid**2}.",
        )
        hidden = default_hidden(d_vision, hidden)
        self.budget, self.moments, self.video = grid**2, moments, video
        self.stride, self.every = stride, every
        self.storage = StorageSpec(grid, pooling)
        self.capacity = moments * grid**2
        self.reduce, self.output = nn.Linear(d_vision, hidden), nn.Linear(hidden, width)
        self.bank = MemoryBank(hidden, length, retrieval_layers, time_code, fusion, consolidation)

    def selected_frames(self, step: int, exec_start: int) -> np.ndarray:
        """The moments at `step`, the last of them `step` itself."""
        return recurrent_frames(step, exec_start, self.moments, self.video, self.stride, self.every)

    def forward(self, history: HistoryTokens) -> MemoryTokens:
        patches = self.storage.grid**2
        features = by_frame(history.features, patches).to(self.reduce.weight.dtype)
        moments = self.reduce(features)  # b t p d
        times = by_frame(history.positions, patches)[:, :, 0, 0].round().long()
        valid = by_frame(history.mask, patches)[..., 0]
        stored = self.bank.replay(moments[:, :-1], times[:, :-1], valid[:, :-1])
        current = moments[:, -1]
        tokens = self.output(self.bank.fuse(current, self.bank.ask(current, *stored)))
        return MemoryTokens(
            tokens, torch.ones(tokens.shape[:2], dtype=torch.bool, device=tokens.device)
        )


FUSIONS, CONSOLIDATIONS = ("gate", "add"), ("tome", "fifo")
LONGEST = 10_000.0  # of the time code's periods, in units of 2π
GATE_STD = 1e-3  # of a fresh gate, which so begins at about one half


@dataclass(frozen=True)
class BankState:
    """What a bank holds of one episode, in the order of time, without gradients.

    entries: [t, n, d]. times: [t] int64. merged: where the newest entry made two others one; −1
    where it did not.
    """

    entries: Tensor
    times: Tensor
    merged: int = -1

    def __len__(self) -> int:
        return len(self.times)


class TimeCode(nn.Module):
    """Times [n] → [n, d], through cosines, sines and two layers."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.frequencies = width // 4
        self.input, self.output = nn.Linear(self.frequencies, width), nn.Linear(width, width)

    def forward(self, times: Tensor) -> Tensor:
        features = self.features(times).to(self.input.weight.dtype)
        return self.output(functional.silu(self.input(features)))

    def features(self, times: Tensor) -> Tensor:
        """[cos(t f) | sin(t f)] of times [n], f_j = 10000^(−j/half); of an odd width the last
        number is 0.
        """
        half = self.frequencies // 2
        ramp = torch.arange(half, device=times.device, dtype=torch.float32) / max(half, 1)
        angles = times.float()[:, None] * LONGEST**-ramp
        return functional.pad(
            torch.cat([angles.cos(), angles.sin()], -1), (0, self.frequencies % 2)
        )


class RetrievalBlock(nn.Module):
    """Attention of one head as wide as the tokens, then an MLP; a norm after each. What is read is
    `read` wide.
    """

    def __init__(self, width: int, read: int | None = None) -> None:
        super().__init__()
        self.query, self.key, self.value = (
            nn.Linear(size or width, width) for size in (width, read, read)
        )
        self.attention_norm, self.mlp_norm = nn.LayerNorm(width), nn.LayerNorm(width)
        self.mlp_in, self.mlp_out = nn.Linear(width, 4 * width), nn.Linear(4 * width, width)

    def forward(
        self, query: Tensor, keys: Tensor, values: Tensor, mask: Tensor | None = None
    ) -> Tensor:
        """Queries [b, n, d] read keys and values [b, m, read]; mask [b, 1, m] is False
        on padding.
        """
        q, k, v = self.query(query), self.key(keys), self.value(values)
        x = self.attention_norm(
            query + functional.scaled_dot_product_attention(q, k, v, attn_mask=mask)
        )
        return self.mlp_norm(x + self.mlp_out(functional.gelu(self.mlp_in(x))))


class Retrieval(nn.Module):
    """How tokens of now, of width d, read entries of the past and are fused with the answer.

    The entries are a bank's own (`MemoryBank`), or the tokens of any memory (`gather_selection`).
    """

    def __init__(
        self,
        width: int,
        retrieval_layers: int = 2,
        time_code: bool = True,
        fusion: str = "gate",
        read: int | None = None,
    ) -> None:
        """Build it.

        Args:
            width: d. read: width of an entry, where it is another.
            retrieval_layers: blocks the current tokens read the entries through.
            time_code: whether keys carry their moment's time.
            fusion: how current and retrieved tokens become one: `gate` (learned, each number its
                own) or `add` (mean).
        """
        super().__init__()
        check_sizes("bank", retrieval_layers=retrieval_layers)
        check_choice("bank.fusion", fusion, FUSIONS)
        self.width = width
        self.blocks = nn.ModuleList(RetrievalBlock(width, read) for _ in range(retrieval_layers))
        self.gate = nn.Linear(2 * width, width) if fusion == "gate" else None
        self.time = TimeCode(read or width) if time_code else None
        if self.gate is not None:
            nn.init.normal_(self.gate.weight, std=GATE_STD)
            nn.init.normal_(self.gate.bias, std=GATE_STD)

    def ask(
        self,
        tokens: Tensor,
        entries: Tensor,
        times: Tensor | None = None,
        valid: Tensor | None = None,
    ) -> Tensor:
        """What entries [b, t, n, d] at times [b, t] answer to tokens [b, k, d].

        Args:
            times: for the time code, where there is one.
            valid: [b, t] bool, False where there is no entry; a row without any returns its tokens.
        """
        keys = entries
        if self.time is not None:
            assert times is not None
            keys = (
                entries
                + self.time(times.flatten()).to(tokens).unflatten(0, times.shape)[:, :, None]
            )
        empty = mask = None
        if valid is not None:
            empty = ~valid.any(1)
            # A row of nothing at all has no softmax; its answer is replaced below.
            readable = torch.cat([valid[:, :1] | empty[:, None], valid[:, 1:]], 1)
            mask = readable.repeat_interleave(entries.shape[2], 1)[:, None]
        output = tokens
        for block in self.blocks:
            output = block(output, keys.flatten(1, 2), entries.flatten(1, 2), mask)
        return output if empty is None else torch.where(empty[:, None, None], tokens, output)

    def fuse(self, tokens: Tensor, retrieved: Tensor) -> Tensor:
        """Current and retrieved tokens [b, n, d] as one."""
        if self.gate is None:
            return (tokens + retrieved) / 2
        share = torch.sigmoid(self.gate(torch.cat([tokens, retrieved], -1)))
        return share * tokens + (1 - share) * retrieved

    def read_memory(self, memory: MemoryTokens, tokens: Tensor) -> Tensor:
        """Fused tokens [b, k, d], from the current ones and a memory's tokens [b, n, read] in place
        of entries.
        """
        # Tokens where the mask is False are undefined: a weight of 0 alone would let a nan through.
        entries = memory.tokens.masked_fill(~memory.mask[..., None], 0).to(tokens)
        return self.fuse(tokens, self.ask(tokens, entries[:, :, None], valid=memory.mask))


class MemoryBank(Retrieval):
    """A bank of at most `length` moments, each n tokens of width d: what is written, merged, and so
    retrieved.
    """

    def __init__(
        self,
        width: int,
        length: int = 16,
        retrieval_layers: int = 2,
        time_code: bool = True,
        fusion: str = "gate",
        consolidation: str = "tome",
        store_fused: bool = False,
    ) -> None:
        """Build an empty bank.

        Args:
            width, retrieval_layers, time_code, fusion: as for `Retrieval`. length: most moments it
                holds.
            consolidation: what becomes of a moment too many: `tome` makes the two most alike
                neighbours one, `fifo` drops the oldest.
            store_fused: store the fused tokens instead of the current ones.
        """
        check_sizes("bank", length=length)
        check_choice("bank.consolidation", consolidation, CONSOLIDATIONS)
        super().__init__(width, retrieval_layers, time_code, fusion)
        self.length, self.consolidation, self.store_fused = length, consolidation, store_fused

    def init_state(self, tokens: int) -> BankState:
        """An empty bank for moments of so many tokens."""
        weight = next(self.parameters())
        times = torch.zeros(0, dtype=torch.int64, device=weight.device)
        return BankState(weight.new_zeros(0, tokens, self.width), times)

    def retrieve(self, states: Sequence[BankState], tokens: Tensor) -> Tensor:
        """What the current tokens [b, n, d] of b episodes retrieve from their banks; an empty bank
        returns these.
        """
        lengths = [len(state) for state in states]
        longest = max(lengths)
        if not longest:
            return tokens
        # b t n d
        entries = torch.stack([_padded(state.entries, longest) for state in states]).to(tokens)
        times = torch.stack([_padded(state.times, longest) for state in states]).to(tokens.device)
        valid = (
            torch.arange(longest, device=tokens.device)
            < torch.tensor(lengths, device=tokens.device)[:, None]
        )
        return self.ask(tokens, entries, times, None if min(lengths) == longest else valid)

    def read(self, states: Sequence[BankState], tokens: Tensor) -> Tensor:
        """Fused tokens [b, n, d] of b episodes, from the current ones and their banks."""
        return self.fuse(tokens, self.retrieve(states, tokens))

    def update(self, state: BankState, tokens: Tensor, fused: Tensor, time: int) -> BankState:
        """The bank after a moment [n, d] at `time`, of which `fused` was read; no
        gradient goes in.
        """
        stored = (fused if self.store_fused else tokens).detach()
        entries = torch.cat([state.entries.to(stored), stored[None]])
        times = torch.cat([state.times, state.times.new_tensor([time])])
        if len(times) <= self.length:
            return BankState(entries, times)
        if self.consolidation == "fifo":
            return BankState(entries[1:], times[1:])
        return _merge(entries, times)

    def replay(
        self, moments: Tensor, times: Tensor, valid: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """What banks hold after b sequences of moments, written at once: as `update` one by one,
        with fixed shapes.

        Args:
            moments: [b, t, n, d]. times: [b, t] int64. valid: [b, t] bool, False on padding, which
                goes in front.

        Returns:
            Entries [b, k, n, d] without gradients, times [b, k] and whether there is such an entry
            [b, k], k ≤ length, the empty places in front.
        """
        entries = moments.detach().clone()  # two that become one are written where the earlier was

        def entries_at(places: Tensor) -> Tensor:
            return entries.gather(1, places[..., None, None].expand(-1, -1, *entries.shape[2:]))

        def similarity(first: Tensor, second: Tensor) -> Tensor:
            return functional.cosine_similarity(entries_at(first), entries_at(second), dim=-1).mean(
                -1
            )

        places = torch.arange(self.length, device=times.device)[None]
        indices = places[:, : times.shape[1]].expand(len(times), -1)  # b k: which of the moments
        # of neighbours; merging changes two of them
        alike = similarity(indices[:, :-1], indices[:, 1:])
        for step in range(self.length, times.shape[1]):
            indices = torch.cat([indices, torch.full_like(indices[:, :1], step)], 1)
            # Where the first place is empty it goes; else the oldest does, or two neighbours become
            # one.
            pair = torch.full_like(indices[:, :1], -1)
            if self.consolidation == "tome":
                alike = torch.cat([alike, similarity(indices[:, -2:-1], indices[:, -1:])], 1)
                pair = torch.where(
                    valid.gather(1, indices[:, :1]), alike.argmax(1, keepdim=True), pair
                )
                both = entries_at(indices.gather(1, torch.cat([pair, pair + 1], 1).clamp(min=0)))
                one = torch.where(
                    (pair < 0)[..., None, None], both[:, :1], both.mean(1, keepdim=True)
                )
                earlier = indices.gather(1, pair.clamp(min=0))[..., None, None].expand_as(one)
                entries.scatter_(1, earlier, one)
                alike = alike.gather(1, places[:, :-1] + (places[:, :-1] >= pair).long())
            indices = indices.gather(1, places + (places > pair).long())
            if self.consolidation == "tome" and self.length > 1:
                left = torch.cat([pair - 1, pair], 1).clamp(0, self.length - 2)
                alike = alike.scatter(
                    1, left, similarity(indices.gather(1, left), indices.gather(1, left + 1))
                )
        return entries_at(indices), times.gather(1, indices), valid.gather(1, indices)

    def run(
        self,
        tokens: Tensor,
        times: Tensor,
        sequences: Sequence[Tensor],
        states: Sequence[BankState] | None = None,
    ) -> tuple[Tensor, list[BankState]]:
        """Take sequences of moments side by side, each in its own bank.

        Args:
            tokens: [m, n, d], all moments. times: [m] int64.
            sequences: places in them, each sequence in the order of time.
            states: banks the sequences continue with; empty ones by default.

        Returns:
            Fused tokens [m, n, d], and the bank after each sequence.
        """
        banks = (
            list(states)
            if states is not None
            else [self.init_state(tokens.shape[1]) for _ in sequences]
        )
        when = times.tolist()
        fused: list[Tensor] = []
        places: list[Tensor] = []
        for step in range(max(len(sequence) for sequence in sequences)):
            going = [i for i, sequence in enumerate(sequences) if step < len(sequence)]
            here = torch.stack([sequences[i][step] for i in going]).to(tokens.device)
            output = self.read([banks[i] for i in going], tokens[here])
            for row, i in enumerate(going):
                place = int(sequences[i][step])
                banks[i] = self.update(banks[i], tokens[place], output[row], when[place])
            fused.append(output)
            places.append(here)
        order = torch.cat(places).argsort()
        return torch.cat(fused)[order], banks


def _merge(entries: Tensor, times: Tensor) -> BankState:
    """Make the two neighbours that are most alike one: their mean, at the earlier's time."""
    alike = functional.cosine_similarity(entries[:-1], entries[1:], dim=-1).mean(-1)
    i = int((alike == alike.max()).nonzero()[0])
    one = (entries[i : i + 1] + entries[i + 1 : i + 2]) / 2
    return BankState(
        torch.cat([entries[:i], one, entries[i + 2 :]]),
        torch.cat([times[: i + 1], times[i + 2 :]]),
        i,
    )


def _padded(x: Tensor, length: int) -> Tensor:
    return functional.pad(x, (0, 0) * (x.ndim - 1) + (0, length - len(x)))
