"""The other half of SimpleMemVLA without its video: π0.5 that generates the current sub-task, and
acts on its words.

A small decoder reads the embeddings of current images and prompt and generates the sub-task. The
hidden states of its words are memory tokens for the action expert, through any integration. The
parts are of this library, not of the authors.

Shapes: b batch · n tokens of images and prompt · S words · d width of memory tokens.
"""

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, replace
from typing import Any, Self

import torch
from torch import Tensor, nn
from torch.nn import functional

from mme_vla.backbone.base import FineTuneSpec
from mme_vla.backbone.building import read_backbone
from mme_vla.config.sections import without
from mme_vla.errors import UserError
from mme_vla.extras.methods.simplememvla.prompt import clean_response
from mme_vla.integration.base import Integration
from mme_vla.memory.base import MemoryModule
from mme_vla.policy.mme import MMEPolicy
from mme_vla.policy.sections import PolicySections
from mme_vla.processing.base import Sample
from mme_vla.processing.processor import Processor
from mme_vla.registry import POLICIES, PROCESSORS
from mme_vla.types import Batch, MemoryTokens

_COUNTED_WORDS = 12
"""Words of a sub-task where costs are counted."""


@dataclass
class SubtaskBatch(Batch):
    """A batch with the sub-tasks that are learned.

    words: [b, S] ids, the last one ends a text.
    words_mask: [b, S] bool.
    forced: ids [b, S] in place of generated ones.
    """

    words: Tensor | None = None
    words_mask: Tensor | None = None
    forced: Tensor | None = None


@PROCESSORS.register("subtask")
class SubtaskProcessor(Processor):
    """π0.5's processor, with the current sub-task as a target."""

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> Self:
        return super().from_config(without(config, "name"))

    def item(self, sample: Sample) -> dict[str, Any]:
        if sample.subgoal is None:
            raise UserError(
                "This policy learns to generate the sub-task: set subgoal_text.kind to"
                " simple_subgoal."
            )
        words = [
            *self.tokenizer.encode(clean_response(sample.subgoal), bos=False),
            self.tokenizer.end,
        ]
        return {**super().item(sample), "words": torch.tensor(words)}

    def collate(self, items: Sequence[dict[str, Any]]) -> SubtaskBatch:
        batch, words = super().collate(items), [item["words"] for item in items]
        padded = nn.utils.rnn.pad_sequence(words, batch_first=True)
        lengths = torch.tensor([len(row) for row in words])
        mask = torch.arange(padded.shape[1]) < lengths[:, None]
        return SubtaskBatch(**vars(batch), words=padded, words_mask=mask)

    def to_config(self) -> dict[str, Any]:
        return {**super().to_config(), "name": "subtask"}


class SubtaskDecoder(nn.Module):
    """Generates a sub-task word by word, and returns the hidden state of each word.

    Args:
        context_width: of the tokens it reads.
        width: d.
        longest: most words.
    """

    def __init__(
        self,
        context_width: int,
        width: int,
        vocab_size: int,
        depth: int = 2,
        heads: int = 4,
        longest: int = 24,
    ) -> None:
        super().__init__()
        if width % heads:
            raise UserError(
                f"policy.subtask_heads={heads} must divide the width of memory tokens, {width}."
            )
        self.longest = longest
        self.context = nn.Linear(context_width, width)
        self.words = nn.Embedding(vocab_size, width)
        self.begin = nn.Parameter(torch.randn(1, 1, width) * width**-0.5)
        self.places = nn.Parameter(torch.randn(1, longest + 2, width) * 0.02)
        layer = nn.TransformerDecoderLayer(
            width, heads, 4 * width, 0.0, "gelu", batch_first=True, norm_first=True
        )
        self.layers = nn.TransformerDecoder(layer, depth, nn.LayerNorm(width))
        nn.init.normal_(self.words.weight, std=width**-0.5)

    def hidden(self, context: Tensor, mask: Tensor, ids: Tensor) -> Tensor:
        """Hidden states [b, S + 1, d]: of the beginning, and at each word [b, S].

        Args:
            context: [b, n, context_width].
            mask: [b, n] bool.
        """
        words = torch.cat([self.begin.expand(len(ids), -1, -1), self.words(ids)], 1)
        words = words + self.places[:, : words.shape[1]]
        causal = torch.ones(
            words.shape[1], words.shape[1], dtype=torch.bool, device=ids.device
        ).triu(1)
        states: Tensor = self.layers(
            words,
            self.context(context),
            tgt_mask=causal,
            memory_key_padding_mask=~mask,
            tgt_is_causal=True,
        )
        return states

    def logits(self, hidden: Tensor) -> Tensor:
        """Logits [..., vocabulary] float32 of the word after each hidden state."""
        return functional.linear(hidden, self.words.weight.to(hidden.dtype)).float()

    @torch.no_grad()
    def generate(self, context: Tensor, mask: Tensor, end: int) -> tuple[Tensor, Tensor]:
        """The likeliest words [b, S], each row up to `end`, and their mask [b, S]."""
        ids = torch.zeros(len(context), 0, dtype=torch.int64, device=context.device)
        ended = torch.zeros(len(context), dtype=torch.bool, device=context.device)
        masks = []
        while ids.shape[1] <= self.longest and not bool(ended.all()):
            word = self.logits(self.hidden(context, mask, ids)[:, -1]).argmax(-1)
            word = torch.full_like(word, end) if ids.shape[1] == self.longest else word
            masks.append(~ended)
            ended = ended | (word == end)
            ids = torch.cat([ids, word[:, None]], 1)
        return ids, torch.stack(masks, 1)


@POLICIES.register("subtask")
class SubtaskPolicy(MMEPolicy):
    """A backbone and an integration that reads the words which the policy generates, in a memory's
    place.
    """

    def __init__(
        self, *parts: Any, subtask_depth: int = 2, subtask_heads: int = 4, subtask_words: int = 24,
        subtask_weight: float = 1.0, **options: Any,
    ) -> None:  # fmt: skip
        """Build the decoder; `parts` and `options` as for `MMEPolicy`.

        Args:
            subtask_depth, subtask_heads: of the decoder.
            subtask_words: most words of a sub-task.
            subtask_weight: of the cross entropy of its words.
        """
        super().__init__(*parts, **options)
        _, network = read_backbone(PolicySections.of(self.config).backbone)
        self.subtask_weight = subtask_weight
        self.subtask = SubtaskDecoder(
            network.vlm.width,
            self.integration.memory_width,
            network.vocab_size,
            subtask_depth,
            subtask_heads,
            subtask_words,
        )

    @staticmethod
    def _check_parts(
        sections: PolicySections,
        integration: Integration,
        memory: MemoryModule | None,
        supports: Set[str],
    ) -> None:
        if memory is not None or not integration.memory_width:
            raise UserError(
                "policy.name=subtask: the words of the sub-task are in a memory's place. Set"
                " memory=none, and an integration that reads them (integration=modulator, context"
                " or expert)."
            )

    def _context(self, batch: Batch) -> tuple[Tensor, Tensor]:
        """Embeddings [b, n, d] of current images and prompt, and their mask [b, n]."""
        tokens, masks = [], []
        for block in self.backbone.embed(self.model.prepare_images(batch)):
            tokens.append(block.tokens)
            masks.append(block.mask)
        return torch.cat(tokens, 1), torch.cat(masks, 1)

    def forward(self, batch: Batch, *args: Any, **options: Any) -> tuple[Tensor, dict[str, Tensor]]:
        """The action's loss under the recorded words, and the weighted cross entropy of these.

        Each word's counts as much as its sample (`Batch.weight`).
        """
        if not isinstance(batch, SubtaskBatch) or batch.words is None or batch.words_mask is None:
            raise ValueError(
                "forward() computes a loss: the batch must hold the words of its sub-tasks."
            )
        if batch.words.shape[1] > self.subtask.longest + 1:
            raise UserError(
                f"A sub-task has {batch.words.shape[1] - 1} words, more than policy.subtask_words="
                f"{self.subtask.longest}: raise it."
            )
        with self.autocast():
            hidden = self.subtask.hidden(*self._context(batch), batch.words)
            logits = self.subtask.logits(hidden[:, :-1])
        mask = batch.words_mask
        losses = (
            functional.cross_entropy(logits.transpose(1, 2), batch.words, reduction="none") * mask
        )
        if batch.weight is not None:
            losses = losses * batch.weight[:, None]
        words = losses.sum() / mask.sum()
        memory = MemoryTokens(hidden[:, 1:], mask)
        action, metrics = super().forward(batch, *args, **{**options, "memory": memory})
        loss = action + self.subtask_weight * words
        return loss, {
            **metrics,
            "loss": loss.detach(),
            "action": action.detach(),
            "words": words.detach(),
        }

    @torch.no_grad()
    def sample_actions(
        self,
        batch: Batch,
        noise: Mapping[str, Tensor] | Tensor | None = None,
        steps: int | None = None,
        generator: torch.Generator | None = None,
        memory: MemoryTokens | None = None,
    ) -> Tensor:
        """A chunk under the words that the policy generates; arguments as for `MMEPolicy`."""
        if memory is None:
            memory = self.generate(batch)
        return super().sample_actions(batch, noise, steps, generator, memory)

    @torch.no_grad()
    def generate(self, batch: Batch) -> MemoryTokens:
        """The hidden states of the sub-tasks that the policy generates."""
        with self.autocast():
            context = self._context(batch)
            if isinstance(batch, SubtaskBatch) and batch.forced is not None:
                ids, mask = batch.forced, torch.ones_like(batch.forced, dtype=torch.bool)
            else:
                processor = self.require_processor()
                assert isinstance(processor, SubtaskProcessor)
                ids, mask = self.subtask.generate(*context, processor.tokenizer.end)
            return MemoryTokens(self.subtask.hidden(*context, ids)[:, 1:], mask)

    @property
    def finetune_spec(self) -> FineTuneSpec:
        """As of `MMEPolicy`; the decoder belongs to the component `memory`."""
        spec = super().finetune_spec
        components = {**spec.components, "memory": rf"{spec.components['memory']}|subtask\."}
        return replace(spec, components=components)

    def full_batch(self, device: torch.device | str = "cpu") -> SubtaskBatch:
        words = torch.zeros(1, _COUNTED_WORDS, dtype=torch.int64, device=device)
        full = vars(super().full_batch(device))
        return SubtaskBatch(
            **full, words=words, words_mask=torch.ones_like(words, dtype=torch.bool), forced=words
        )
