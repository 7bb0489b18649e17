"""Memory banks (MemoryVLA): learned tokens of past frames that are retrieved, fused and merged.

Unlike the memories that choose among stored vision tokens, a bank keeps tokens that the network
itself computed from a frame. The tokens of the current frame are the queries.
"""

from typing import Any, ClassVar

import torch
from torch import Tensor, nn
from torch.nn import functional

from mme_vla.errors import check_choice, check_sizes, require
from mme_vla.memory.extensions.attending import by_frame
from mme_vla.memory.history import StorageSpec
from mme_vla.memory.recurrent import FrameSchedule, ScheduledMemory, default_hidden
from mme_vla.registry import MEMORIES
from mme_vla.types import HistoryTokens, MemoryTokens

FUSIONS = ("gate", "add")
CONSOLIDATIONS = ("tome", "fifo")
LONGEST = 10_000.0  # of the time code's periods, in units of 2π
GATE_STD = 1e-3  # of a fresh gate, which so begins at about one half


class TimeCode(nn.Module):
    """Times [n] → [n, d], through cosines, sines and two layers."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.frequencies = width // 4
        self.input = nn.Linear(self.frequencies, width)
        self.output = nn.Linear(width, width)

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
        features = torch.cat([angles.cos(), angles.sin()], -1)
        return functional.pad(features, (0, self.frequencies % 2))


class RetrievalBlock(nn.Module):
    """Attention of one head as wide as the tokens, then an MLP; a norm after each. Keys and values
    are made of entries of width `read`, by default that of the tokens.
    """

    def __init__(self, width: int, read: int | None = None) -> None:
        super().__init__()
        read = read or width
        self.query = nn.Linear(width, width)
        self.key = nn.Linear(read, width)
        self.value = nn.Linear(read, width)
        self.attention_norm = nn.LayerNorm(width)
        self.mlp_norm = nn.LayerNorm(width)
        self.mlp_in = nn.Linear(width, 4 * width)
        self.mlp_out = nn.Linear(4 * width, width)

    def forward(
        self, query: Tensor, keys: Tensor, values: Tensor, mask: Tensor | None = None
    ) -> Tensor:
        """Queries [b, n, d] read keys and values [b, m, read]; mask [b, 1, m] is False
        on padding.
        """
        q, k, v = self.query(query), self.key(keys), self.value(values)
        read = functional.scaled_dot_product_attention(q, k, v, attn_mask=mask)
        x = self.attention_norm(query + read)
        return self.mlp_norm(x + self.mlp_out(functional.gelu(self.mlp_in(x))))


class Retrieval(nn.Module):
    """How current tokens, of width d, read entries of the past and are fused with what they read.

    The entries are a bank's own (`MemoryBank`), or the tokens of any memory.
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
            width: d.
            read: width of an entry, where it is another.
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

    def retrieve_from(
        self,
        tokens: Tensor,
        entries: Tensor,
        times: Tensor | None = None,
        valid: Tensor | None = None,
    ) -> Tensor:
        """Retrieve from entries [b, t, n, d] with tokens [b, k, d] as queries; [b, k, d].

        Args:
            times: of the entries [b, t], for the time code, where there is one.
            valid: [b, t] bool, False where there is no entry; a row without any returns its tokens.
        """
        keys = entries
        if self.time is not None:
            assert times is not None
            time_code = self.time(times.flatten()).to(tokens).unflatten(0, times.shape)
            keys = entries + time_code[:, :, None]
        mask = None
        if valid is not None:
            is_empty = ~valid.any(1)
            # A row of nothing at all has no softmax; its output is replaced below.
            readable = torch.cat([valid[:, :1] | is_empty[:, None], valid[:, 1:]], 1)
            mask = readable.repeat_interleave(entries.shape[2], 1)[:, None]
        output = tokens
        for block in self.blocks:
            output = block(output, keys.flatten(1, 2), entries.flatten(1, 2), mask)
        if valid is None:
            return output
        return torch.where(is_empty[:, None, None], tokens, output)

    def fuse(self, tokens: Tensor, retrieved: Tensor) -> Tensor:
        """Current and retrieved tokens [b, n, d] as one."""
        if self.gate is None:
            return (tokens + retrieved) / 2
        share = torch.sigmoid(self.gate(torch.cat([tokens, retrieved], -1)))
        return share * tokens + (1 - share) * retrieved


class MemoryBank(Retrieval):
    """A bank of at most `length` moments, each n tokens of width d: merging and retrieval."""

    def __init__(
        self,
        width: int,
        length: int = 16,
        retrieval_layers: int = 2,
        time_code: bool = True,
        fusion: str = "gate",
        consolidation: str = "tome",
    ) -> None:
        """Build the layers of a bank.

        Args:
            width, retrieval_layers, time_code, fusion: as for `Retrieval`.
            length: most moments it holds.
            consolidation: what becomes of a moment too many: `tome` makes the two most alike
                neighbours one, `fifo` drops the oldest.
        """
        check_sizes("bank", length=length)
        check_choice("bank.consolidation", consolidation, CONSOLIDATIONS)
        super().__init__(width, retrieval_layers, time_code, fusion)
        self.length = length
        self.consolidation = consolidation

    def replay(
        self, moments: Tensor, times: Tensor, valid: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """The content of banks that took b sequences of moments one by one, with fixed shapes.

        Args:
            moments: [b, t, n, d].
            times: [b, t] int64.
            valid: [b, t] bool, False on padding, which goes in front.

        Returns:
            Entries [b, k, n, d] without gradients, times [b, k] and whether there is such an entry
            [b, k], k ≤ length, the empty places in front.
        """
        entries = moments.detach().clone()  # a merged entry is written where the earlier one was
        merges = self.consolidation == "tome"

        def entries_at(indices: Tensor) -> Tensor:
            return entries.gather(1, indices[..., None, None].expand(-1, -1, *entries.shape[2:]))

        def similarity(first: Tensor, second: Tensor) -> Tensor:
            cosine = functional.cosine_similarity(entries_at(first), entries_at(second), dim=-1)
            return cosine.mean(-1)

        places = torch.arange(self.length, device=times.device)[None]
        # Which of the moments is in each place [b, k], and how alike neighbours are [b, k − 1].
        indices = places[:, : times.shape[1]].expand(len(times), -1)
        alike = similarity(indices[:, :-1], indices[:, 1:])
        for step in range(self.length, times.shape[1]):
            indices = torch.cat([indices, torch.full_like(indices[:, :1], step)], 1)
            # `pair` is the place whose entry is merged with the next one. −1 drops the first place:
            # where it is empty, or always without merging.
            pair = torch.full_like(indices[:, :1], -1)
            if merges:
                alike = torch.cat([alike, similarity(indices[:, -2:-1], indices[:, -1:])], 1)
                is_full = valid.gather(1, indices[:, :1])
                pair = torch.where(is_full, alike.argmax(1, keepdim=True), pair)
                pair_places = torch.cat([pair, pair + 1], 1).clamp(min=0)
                both = entries_at(indices.gather(1, pair_places))
                mean = both.mean(1, keepdim=True)
                merged = torch.where((pair < 0)[..., None, None], both[:, :1], mean)
                earlier = indices.gather(1, pair.clamp(min=0))[..., None, None]
                entries.scatter_(1, earlier.expand_as(merged), merged)
                alike = alike.gather(1, places[:, :-1] + (places[:, :-1] >= pair).long())
            # Take the merged entry's second half, or the first place, out of the row.
            indices = indices.gather(1, places + (places > pair).long())
            if merges and self.length > 1:
                # Merging changes how alike the new entry and its two neighbours are.
                left = torch.cat([pair - 1, pair], 1).clamp(0, self.length - 2)
                changed = similarity(indices.gather(1, left), indices.gather(1, left + 1))
                alike = alike.scatter(1, left, changed)
        return entries_at(indices), times.gather(1, indices), valid.gather(1, indices)


@MEMORIES.register("bank")
class Banked(ScheduledMemory):
    """grid×grid tokens of the current frame, each fused with what it retrieves from the bank.

    Besides its own options it takes those of `MemoryBank`.
    """

    option_types: ClassVar[tuple[type, ...]] = (MemoryBank,)
    pad_left = 1

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
        **bank: Any,
    ) -> None:
        """Put the parts together.

        Args:
            d_vision: width of a vision token.
            width: of a memory token, given by the integration.
            budget: most memory tokens; grid×grid of them are made.
            grid, pooling: a moment is grid×grid tokens.
            stride, every, moments, video: which frames are moments (`recurrent_frames`), the
                current one among them.
            hidden: width of the bank; by default a quarter of `d_vision`, at least 64.
            bank: options of the `MemoryBank`.
        """
        super().__init__()
        check_sizes("memory", grid=grid, video=video)
        require(
            1 < moments > video,
            f"memory.moments={moments} must be at least 2, and more than memory.video={video}.",
        )
        require(
            budget >= grid**2,
            f"memory.budget={budget} does not hold the {grid}×{grid} tokens of a frame: {grid**2}.",
        )
        hidden = default_hidden(d_vision, hidden)
        self.budget = grid**2
        self.capacity = moments * grid**2
        self.storage = StorageSpec(grid, pooling)
        self.schedule = FrameSchedule(moments, video, stride, every)
        self.reduce = nn.Linear(d_vision, hidden)
        self.output = nn.Linear(hidden, width)
        self.bank = MemoryBank(hidden, **bank)

    def forward(self, history: HistoryTokens) -> MemoryTokens:
        patches = self.storage.grid**2
        features = by_frame(history.features, patches).to(self.reduce.weight.dtype)
        moments = self.reduce(features)  # b t p d
        times = by_frame(history.positions, patches)[:, :, 0, 0].round().long()
        valid = by_frame(history.mask, patches)[..., 0]
        entries, entry_times, entry_mask = self.bank.replay(
            moments[:, :-1], times[:, :-1], valid[:, :-1]
        )
        current = moments[:, -1]
        retrieved = self.bank.retrieve_from(current, entries, entry_times, entry_mask)
        tokens = self.output(self.bank.fuse(current, retrieved))
        mask = torch.ones(tokens.shape[:2], dtype=torch.bool, device=tokens.device)
        return MemoryTokens(tokens, mask)
