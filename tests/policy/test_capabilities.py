"""Capabilities beside `Policy`: what a policy without any of them does, and how frames of a camera travel."""

from typing import Any

import numpy as np
import pytest
import torch

from mme_vla import Policy, UserError, build_policy
from mme_vla.evaluation.rollout.evaluation import _n_distractors
from mme_vla.policy import capabilities
from mme_vla.policy.capabilities import (
    AugmentsImages,
    CompilesSampling,
    HasVisionMemory,
    LimitsActions,
    PreparesChunks,
    SelectsFrames,
    SupportsRTC,
    with_vision_memory,
)
from mme_vla.types import FrameBatch

KINDS = (AugmentsImages, CompilesSampling, HasVisionMemory, PreparesChunks, SelectsFrames)


class BarePolicy(Policy):
    """A policy of the interface alone."""

    memory = None

    def __init__(self) -> None:
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(1))


def test_bare_policy_has_no_capability() -> None:
    bare = BarePolicy()
    kinds = (
        AugmentsImages,
        CompilesSampling,
        HasVisionMemory,
        LimitsActions,
        PreparesChunks,
        SelectsFrames,
        SupportsRTC,
    )
    assert not [kind for kind in kinds if isinstance(bare, kind)]
    assert capabilities.frames_read(bare, np.array([3]), 0) is None
    assert _n_distractors(bare) == 0
    with pytest.raises(UserError, match="BarePolicy stores no vision tokens"):
        with_vision_memory(bare)


@pytest.mark.parametrize("kind", KINDS)
def test_mme_policy_has_the_capability(kind: Any) -> None:
    assert isinstance(build_policy("framesamp_modul"), kind)


def test_frame_batch_finds_rendered_images() -> None:
    images = np.arange(3, dtype=np.uint8).repeat(12).reshape(3, 2, 2, 3)
    batch = FrameBatch.of(images, np.array([1, 4, 6]), 8)
    assert [frame for frame in range(8) if batch.image(frame) is not None] == [1, 4, 6]
    assert (batch.select(np.array([4, 6])) == images[1:]).all()
    full = FrameBatch.of(images)
    assert full.length == 3 and full.index.tolist() == [0, 1, 2]
