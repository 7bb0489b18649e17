"""Frames of a memory that reads few of them are encoded when they are read, once, and give what
they always gave.
"""

import numpy as np
import pytest
import torch

from mme_vla import UserError
from mme_vla.memory.history import LazyHistory, OnlineHistory, StorageSpec
from mme_vla.policy.mme import MMEPolicy
from mme_vla.testing.small import SMALL_VISION, moving_frames, small_policy
from mme_vla.types import FrameBatch

SPEC = StorageSpec(2, keep_every=2)


def numbered(frames: np.ndarray) -> torch.Tensor:
    """Tokens [n, 4, 1] that say which frame and patch they are of."""
    return (
        torch.from_numpy(frames[:, 0, 0, :1].astype(np.float32))[:, None]
        + torch.arange(4)[:, None] / 10
    )


def numbered_images(count: int) -> np.ndarray:
    return np.arange(count, dtype=np.uint8)[:, None, None, None].repeat(3, 3)


@pytest.mark.parametrize("rendered", [None, np.array([1, 2, 3, 5])])
def test_a_lazy_history_holds_what_an_eager_one_does(rendered: np.ndarray | None) -> None:
    expected = numbered_images(6) if rendered is None else numbered_images(6)[rendered]
    encoded: list[int] = []

    def encode(frames: np.ndarray) -> torch.Tensor:
        encoded.extend(frames[:, 0, 0, 0].tolist())
        return numbered(frames)

    lazy, eager = LazyHistory(SPEC, encode), OnlineHistory(SPEC)
    batch = FrameBatch.of(expected, rendered, 6)
    lazy.take(batch, encode)
    eager.take(batch, numbered)
    assert encoded == [] and len(lazy) == len(eager) == 6
    for indices in (np.array([[3, 1], [1, 0], [3, 2]]), np.array([[5, 3], [3, 0]])):
        assert torch.equal(lazy.gather(indices), eager.gather(indices))
    assert encoded == [1, 3, 5], "each once, and none that no memory reads"
    with pytest.raises(UserError, match=r"no tokens of frames \[4\]"):
        lazy.gather(np.array([[4, 0]]))


@pytest.mark.parametrize(
    "model",
    ["ttt_expert", "rmt_context", "bank_modul", "anchors_modul", "moment_modul", "gist_modul"],
)
def test_a_policy_encodes_the_frames_it_reads_and_acts_as_ever(
    model: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy = small_policy(model, backbone={"vision": {**SMALL_VISION, "patch_size": 8}})
    frames = moving_frames(40)

    def actions(policy: MMEPolicy) -> tuple[list[np.ndarray], int]:
        n_frames, chunks = 0, []
        original = MMEPolicy.encode_frames

        def counting(self: MMEPolicy, images: np.ndarray, batch_size: int = 32) -> torch.Tensor:
            nonlocal n_frames
            n_frames += len(images)
            return original(self, images, batch_size)

        with monkeypatch.context() as patch:
            patch.setattr(MMEPolicy, "encode_frames", counting)
            episode = policy.start_episode("press the button")
            for start in (0, 1, 17, 33):
                part = frames[start : {0: 1, 1: 17, 17: 33, 33: 40}[start]]
                episode.observe(
                    {"front": part, "wrist": part}, np.zeros((len(part), 8), np.float32)
                )
                chunks.append(policy.act(episode))
        return chunks, n_frames

    lazy, few = actions(policy)
    monkeypatch.setattr(type(policy.memory), "lazy", False)
    eager, all_of_them = actions(policy)
    assert few < all_of_them / 4 and all_of_them == 40
    assert all(np.allclose(a, b, atol=1e-5) for a, b in zip(lazy, eager, strict=True))


def test_frame_batch_finds_rendered_images() -> None:
    images = np.arange(3, dtype=np.uint8).repeat(12).reshape(3, 2, 2, 3)
    batch = FrameBatch.of(images, np.array([1, 4, 6]), 8)
    assert [frame for frame in range(8) if batch.image(frame) is not None] == [1, 4, 6]
    assert (batch.select(np.array([4, 6])) == images[1:]).all()
    full = FrameBatch.of(images)
    assert full.length == 3 and full.index.tolist() == [0, 1, 2]
