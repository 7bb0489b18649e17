"""What a VLM makes of moments: a cognition token and vision features each."""

import torch
from torch import Tensor

from mme_vla.backbone.layers.attention import additive_mask
from mme_vla.backbone.openvla.prismatic import Prismatic
from mme_vla.policy.memoryvla.core import cognition_token


def read_moments(vlm: Prismatic, pictures: Tensor, prompt: Tensor, prompt_mask: Tensor) -> tuple[Tensor, Tensor]:
    """Cognition token [n, 1, d] and vision features [n, p, c] of moments.

    Args:
        pictures: [n, 3, s, s] in [−1, 1]. prompt, prompt_mask: [n, l].
    """
    features = vlm.encode_images(pictures)
    embedded, patches = vlm.embed(prompt), vlm.projector(features)
    tokens = torch.cat([embedded[:, :1], patches.to(embedded), embedded[:, 1:]], 1)
    seen = torch.cat([prompt_mask[:, :1], torch.ones_like(patches[..., 0], dtype=torch.bool), prompt_mask[:, 1:]], 1)
    n = tokens.shape[1]
    causal = torch.ones(n, n, dtype=torch.bool, device=tokens.device).tril()
    mask = additive_mask(causal & seen[:, None, :], tokens.dtype)
    places = torch.arange(n, device=tokens.device).expand(len(tokens), -1)
    hidden = vlm.read(tokens, mask, places)
    return cognition_token(hidden, features.shape[1], prompt_mask.sum(1)), features
