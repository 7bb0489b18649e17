"""SAM2Act+'s network: a coarse look with memory, and a closer one that also says how to turn and to grip."""

from dataclasses import replace

import torch
from torch import Tensor, nn

from mme_vla.backbone.layers.recomputing import Recompute
from mme_vla.backbone.sam2act.branch import Branch
from mme_vla.backbone.sam2act.picture_encoder import PictureEncoder
from mme_vla.backbone.sam2act.sizes import SAM2ActSizes
from mme_vla.backbone.sam2act.transformer import Look
from mme_vla.backbone.sam2act.views import VIEWS
from mme_vla.memory.sam2act.keyframe_bank import BankState, KeyframeBank, released_positions

COLOURS = slice(3, 6)
"""The channels of a virtual picture that the encoder sees."""


class SAM2ActNetwork(nn.Module):
    """Encoder, bank and both branches. What an episode remembers goes in and comes out; nothing of it stays here."""

    def __init__(self, sizes: SAM2ActSizes) -> None:
        super().__init__()
        self.sizes = sizes
        self.encoder = PictureEncoder(sizes)
        self.memory = KeyframeBank(
            grid=sizes.grid,
            token=sizes.token,
            memory=sizes.memory,
            layers=sizes.memory_layers,
            feedforward=sizes.memory_feedforward,
            mask_stages=sizes.mask_stages,
            remembered=sizes.remembered,
        )
        self.coarse = Branch(sizes)
        self.fine = Branch(sizes, with_heads=True)

    def recompute(self, wanted: Recompute) -> None:
        """Compute the transformer layers' activations again in the backward pass, or keep them."""
        self.coarse.transformer.recomputed = self.fine.transformer.recomputed = wanted

    def look(self, pictures: Tensor, state: Tensor, language: Tensor) -> Look:
        """What a branch reads: virtual pictures [b, 3, 10, s, s], the state [b, p], the goal's tokens [b, l, w]."""
        return Look(pictures, self.encoder(pictures[:, :, COLOURS].flatten(0, 1)), state, language)

    def coarse_step(self, look: Look, remembered: BankState) -> tuple[Tensor, BankState]:
        """Heatmap logits [b, 3, 1, s, s] of the coarse look, and what is remembered after it."""
        tokens = self.coarse.transformer(look)
        positions = released_positions(self.coarse.transformer.positions, len(look.pictures))
        return self._remember_and_decode(look, tokens, positions, remembered)

    def coarse_alone(self, look: Look) -> Tensor:
        """Heatmap logits [b, 3, 1, s, s] of the coarse look of episodes that remember nothing."""
        logits: Tensor = self.coarse.decoder(self.coarse.transformer(look), *look.maps[:2])
        return logits.unflatten(0, (-1, VIEWS))

    def coarse_sequences(self, look: Look, length: int) -> Tensor:
        """Heatmap logits [b, 3, 1, s, s] of sequences of keyframes, each with a bank of its own that begins empty.

        Gradients flow through everything that is remembered.

        Args:
            look: of b = n · length keyframes, sequence by sequence.
        """
        batch = len(look.pictures)
        tokens = self.coarse.transformer(look)
        positions = released_positions(self.coarse.transformer.positions, batch)
        rows = torch.arange(batch * VIEWS, device=tokens.device).view(-1, length, VIEWS)
        remembered, found = self.memory.init_state(), []
        for step in range(length):
            now = rows[:, step].flatten()
            maps = (look.maps[0][now], look.maps[1][now], look.maps[2][now])
            here = replace(look, maps=maps)
            logits, remembered = self._remember_and_decode(here, tokens[now], positions[now], remembered)
            found.append(logits)
        return torch.stack(found, 1).flatten(0, 1)

    def _remember_and_decode(
        self, look: Look, tokens: Tensor, positions: Tensor, remembered: BankState
    ) -> tuple[Tensor, BankState]:
        enriched = self.memory.read(remembered, tokens, positions)
        logits = self.coarse.decoder(enriched, *look.maps[:2])
        return logits.unflatten(0, (-1, VIEWS)), self.memory.update(remembered, tokens, logits)

    def fine_step(self, look: Look) -> tuple[Tensor, Tensor]:
        """Heatmap logits [b, 3, 1, s, s] of the closer look, and its tokens [b·3, token, g, g] for the heads."""
        tokens = self.fine.transformer(look)
        logits: Tensor = self.fine.decoder(tokens, *look.maps[:2])
        return logits.unflatten(0, (-1, VIEWS)), tokens

    def heads(self, tokens: Tensor, waypoints: Tensor, rotation: Tensor | None = None) -> dict[str, Tensor]:
        """What to do at waypoints [b, 3] of the closer look's cube: see `Heads.forward`."""
        heads = self.fine.heads
        assert heads is not None
        found: dict[str, Tensor] = heads(heads.features(tokens, waypoints), rotation)
        return found
