"""Small policies, batches and episodes for testing a memory or an integration: the library's own
tests use them.
"""

from functools import cache
from typing import Any

import numpy as np
import torch
from omegaconf import DictConfig, OmegaConf

from mme_vla.embodiment import ROBOMME_JOINT, Embodiment
from mme_vla.memory.base import padded_length
from mme_vla.memory.history import CachedHistory, score_frames
from mme_vla.policy.build import build_from_config, policy_words
from mme_vla.policy.mme import MMEPolicy, mme_of
from mme_vla.processing.images import full_past
from mme_vla.processing.normalise import NormStats
from mme_vla.types import Batch, HistoryTokens, PastViews

PERCEPTUAL = [
    f"{m}_{i}" for m in ("framesamp", "tokendrop") for i in ("context", "modul", "expert")
]
RECURRENT = [f"{m}_{i}" for m in ("ttt", "rmt") for i in ("context", "modul", "expert")]
NEURAL = [*PERCEPTUAL, *RECURRENT]
"""The paper's."""
BEYOND_MEMORIES = (
    "retrieval",
    "moment",
    "gist",
    "actions",
    "learned_topk",
    "anchors",
    "events",
    "pyramid",
    "keyframes",
)
"""On every backbone with a place for tokens; `spacetime` needs one whose tower looks back."""
ALL_BEYOND = [
    f"{m}_{i}" for m in (*BEYOND_MEMORIES, "spacetime") for i in ("context", "modul", "expert")
]
BEYOND = [
    "retrieval_modul",
    "moment_context",
    "gist_expert",
    "actions_expert",
    "learned_topk_context",
    "spacetime_context",
    "anchors_context",
    "events_modul",
    "pyramid_expert",
    "keyframes_modul",
]
"""Of each memory beyond the paper one composition, for tests that go through all models."""
# The first four are one network; hybrid is framesamp_modul with a subgoal in its prompt.
ALL_MODELS = ["pi05", "pi05_past_actions", "simplesg", "groundsg", *NEURAL, "hybrid"]
SMALL_VISION = {
    "image_size": 64,
    "patch_size": 4,
    "width": 32,
    "depth": 1,
    "mlp_dim": 64,
    "num_heads": 2,
}


def unit_stats(robot: Embodiment = ROBOMME_JOINT) -> NormStats:
    """Statistics that leave numbers about as they are."""
    return NormStats.unit(robot.state.width, robot.action.width)


def small_policy(name: str, seed: int = 42, **overrides: Any) -> MMEPolicy:
    """A tiny policy whose gates are open, so that every part reaches the action (fresh adaptive
    norms are shut).
    """
    built = build_from_config(
        _composed(*policy_words(name, {"backbone": "tiny", **overrides})), seed=seed
    )
    policy = mme_of(built, "small_policy()")
    policy.require_processor().stats = unit_stats(policy.embodiment)
    open_gates(policy)
    return policy


def tiny_sections(model: str, backbone: str = "tiny") -> dict[str, Any]:
    """The plain sections of a model at a small backbone's size, for `MMEPolicy.from_config`."""
    sections = OmegaConf.to_container(
        _composed(*policy_words(model, {"backbone": backbone})), resolve=True
    )
    assert isinstance(sections, dict)
    parts = ("backbone", "memory", "integration", "policy", "embodiment")
    return {key: sections[key] for key in parts}


@cache
def _composed(*words: str) -> DictConfig:
    """Composing takes several times as long as building a tiny policy, and tests build the same
    ones over and over.
    """
    from mme_vla.config.composition import compose  # Hydra; batches and checks do without

    return compose("policy", words)


def open_gates(policy: MMEPolicy, scale: float = 0.5) -> None:
    """Draw the adaptive norms at random, the same in every variant."""
    generator = torch.Generator().manual_seed(7)
    with torch.no_grad():
        for name, parameter in sorted(policy.named_parameters()):
            if (
                name.endswith(("norm.dense.weight", "norm.dense.bias"))
                and ".experts.memory." not in name
            ):
                std = scale * (parameter.shape[-1] ** -0.5 if parameter.ndim == 2 else 1)
                parameter.copy_(torch.randn(parameter.shape, generator=generator) * std)


def random_history(
    policy: MMEPolicy, batch: int, valid: int, seed: int = 0
) -> HistoryTokens | None:
    """`valid` random tokens at random places, the rest padding; whole frames where padding goes in
    front.
    """
    if policy.memory is None:
        return None
    generator = torch.Generator().manual_seed(seed)
    patches, d = policy.memory.storage.grid**2, policy.backbone.vision_width
    if policy.memory.pad_left:
        valid = -(-valid // patches) * patches
    n = padded_length(policy.memory, valid)
    mask = torch.zeros(batch, n, dtype=torch.bool)
    mask[:, slice(n - valid, n) if policy.memory.pad_left else slice(valid)] = True
    features = torch.randn(batch, n, d, generator=generator) * mask[..., None]
    positions = torch.randint(0, 64, (batch, n, 3), generator=generator).float() * mask[..., None]
    return HistoryTokens(features, positions, mask, torch.full((batch,), 64))


def random_batch(policy: MMEPolicy, batch: int = 2, valid: int = 100, seed: int = 0) -> Batch:
    """A batch of noise images, short prompts and random actions."""
    generator = torch.Generator().manual_seed(seed)
    size, length, views = policy.backbone.image_size, 16, len(policy.embodiment.cameras)
    prompt_mask = torch.zeros(batch, length, dtype=torch.bool)
    prompt_mask[:, : length // 2] = True
    return Batch(
        images=torch.randint(
            0, 256, (batch, views, 3, size, size), generator=generator, dtype=torch.uint8
        ),
        image_mask=torch.ones(batch, views, dtype=torch.bool),
        prompt=torch.randint(4, 100, (batch, length), generator=generator) * prompt_mask,
        prompt_mask=prompt_mask,
        history=random_history(policy, batch, valid, seed),
        actions=torch.randn(batch, policy.horizon, policy.action_dim, generator=generator),
        past=random_past(policy, batch, seed),
    )


def random_past(policy: MMEPolicy, batch: int, seed: int = 0) -> PastViews | None:
    """Past views of noise, where the memory gives any; the first sample's oldest lies before its
    episode.
    """
    if policy.memory is None:
        return None
    views = len(policy.embodiment.cameras)
    past = full_past(policy.memory.past_view_spec, views, policy.backbone.image_size, "cpu")
    if past is None:
        return None
    generator = torch.Generator().manual_seed(seed + 1)
    shape = (batch, *past.images.shape[1:])
    mask = past.mask.repeat(batch, 1)
    mask[0, 0] = False
    images = torch.randint(0, 256, shape, generator=generator, dtype=torch.uint8)
    return PastViews(images, mask, past.every)


def moving_frames(count: int, size: int = 64, seed: int = 0) -> np.ndarray:
    """Frames [count, size, size, 3] uint8 of a still background and a bright square
    that wanders.
    """
    rng = np.random.default_rng(seed)
    background = rng.integers(0, 200, (size, size, 3), dtype=np.uint8)
    frames = np.repeat(background[None], count, 0)
    for t in range(count):
        y, x = (3 * t) % (size - 12), (5 * t) % (size - 12)
        frames[t, y : y + 12, x : x + 12] = rng.integers(0, 256, 3, dtype=np.uint8)
    return frames


def cached_history(policy: MMEPolicy, frames: np.ndarray, exec_start: int = 0) -> CachedHistory:
    """What a cache of this whole episode would hold, encoded in one go."""
    memory = policy.require_memory()
    storage = memory.storage
    stored_frames = storage.stored_frames(len(frames))
    tokens = policy.encode_frames(frames[stored_frames])
    if tokens.dtype == torch.bfloat16:
        tokens = tokens.view(torch.uint16)
    scores = score_frames(memory.make_scorer(), dict(enumerate(frames)), storage.grid**2)
    return CachedHistory(storage, tokens.numpy(), stored_frames, len(frames), scores, exec_start)
