"""The memories that decide when to write: which frames they keep, and what the write
head learns.
"""

import numpy as np
import pytest
import torch

from mme_vla import UserError
from mme_vla.data.columns import BOUNDARY, SUBTASK, label_column
from mme_vla.data.sources import open_sources
from mme_vla.memory.base import stack_history
from mme_vla.memory.extensions.anchors import Anchors
from mme_vla.memory.extensions.events import Events, peaks
from mme_vla.memory.extensions.keyframes import Keyframes, write_loss
from mme_vla.memory.extensions.pyramid import Pyramid
from mme_vla.memory.history import CachedHistory, FrameScores
from mme_vla.types import Labels

D = 16


def test_anchors_keep_the_first_frame_and_the_last_ones() -> None:
    assert Anchors(D, 8).selected_frames(100, 0).tolist() == [0, 99, 100]
    assert Anchors(D, 8, budget=64, spacing=15).selected_frames(100, 0).tolist() == [0, 70, 85, 100]
    assert [Anchors(D, 8).selected_frames(step, 0).tolist() for step in (0, 1)] == [[0], [0, 1]]
    with pytest.raises(UserError, match="at least 2: choose a multiple of 16, such as 32"):
        Anchors(D, 8, budget=16)


def test_a_pyramid_thins_with_age_and_never_takes_back_a_dropped_frame() -> None:
    memory = Pyramid(D, 8, budget=512)
    selected = memory.selected_frames(1299, 0)
    assert selected[0] == 0 and len(selected) == 32 and memory.sizes == [8, 8, 8, 7]
    ages = 1299 - selected[::-1]
    assert ages[:8].tolist() == list(range(0, 16, 2)) and ages[8:16].tolist() == list(
        range(20, 84, 8)
    )
    before: set[int] = set()
    for step in range(1500):
        now = set(memory.selected_frames(step, 0).tolist())
        assert len(now) <= 32 and now - before <= {step}, "only the new frame joins"
        before = now
    with pytest.raises(UserError, match="multiple of the one before it"):
        Pyramid(D, 8, strides=[2, 3])


def kinematic_history(memory: Events, length: int = 200) -> CachedHistory:
    """The arm moves and rests at frame 64, the gripper closes before frame 103, the image changes
    at frame 151.
    """
    stored = memory.storage.stored_frames(length)
    states = np.zeros((length, 8), np.float32)
    speed = 0.01 * np.ones(length)
    speed[49:72] = 0.002
    states[:, 0], states[100:, 7] = np.cumsum(speed), 1
    change = np.full((len(stored) - 1, memory.storage.grid**2), 0.01, np.float32)
    change[stored[1:] == 151] = 0.5
    history = CachedHistory(
        memory.storage,
        np.zeros((len(stored), 16, D), np.float32),
        stored,
        length,
        FrameScores(stored[1:], change),
    )
    history.motion, history.state_width = torch.from_numpy(states).__getitem__, 8
    return history


def test_events_keep_frames_where_something_happens() -> None:
    memory = Events(D, 8, budget=16 * 5)
    selected = np.unique(memory.select(kinematic_history(memory), 199)[:, 0])
    assert selected.tolist() == [0, 63, 103, 151, 199]
    early = np.unique(memory.select(kinematic_history(memory), 120)[:, 0])
    assert early.tolist() == [0, 63, 103, 119], "what has not happened yet is not known"
    assert peaks(np.array([0, 2, 1, 1, 3, 3, 0])).tolist() == [
        False,
        True,
        False,
        False,
        True,
        False,
        False,
    ]


def boundaries_batch(memory: Keyframes, rng: np.random.Generator):
    """Ten episodes of 40 stored frames in which a sub-task changes what the frames look like; the
    boundaries [b, t].
    """
    items, begins = [], []
    for _ in range(10):
        cuts = np.sort(rng.choice(np.arange(4, 38, 3), 3, replace=False))
        subtask = np.searchsorted(cuts, np.arange(40), side="right")
        appearances = torch.from_numpy(rng.normal(size=(4, D)).astype(np.float32))
        tokens = (appearances[subtask][:, None] + 0.1 * torch.randn(40, 16, D)).numpy()
        item = memory.gather_selection(CachedHistory(memory.storage, tokens, np.arange(40), 40), 39)
        item.labels = Labels(
            {"subtask_index": torch.from_numpy(np.repeat(subtask, 16).astype(np.float32) + 1)}
        )
        items.append(item)
        begins.append(np.diff(subtask, prepend=0) > 0)
    return stack_history(items), torch.from_numpy(np.stack(begins))


def test_the_write_head_learns_sub_task_boundaries_and_keeps_them() -> None:
    torch.manual_seed(0)
    memory, rng = (
        Keyframes(D, 8, budget=16 * 5, every=1, pool=40, hidden=32),
        np.random.default_rng(0),
    )
    optimizer = torch.optim.Adam(memory.parameters(), lr=1e-2)
    for _ in range(60):
        history, _ = boundaries_batch(memory, rng)
        optimizer.zero_grad()
        memory(history).losses["write"].mean().backward()
        optimizer.step()
    history, begins = boundaries_batch(memory, rng)
    tokens = memory(history)
    selected = 39 - tokens.ages[:, ::16].long()
    assert float(begins.gather(1, selected).float().sum() / begins.sum()) > 0.9
    assert (selected[:, 0] == 0).all() and (selected[:, -1] == 39).all(), (
        "first and newest are always there"
    )
    history.labels = Labels()
    assert not memory(history).losses, "episodes have no labels"


def test_the_write_loss_weighs_keyframes_like_all_other_frames() -> None:
    scores, subtask = torch.tensor([[2.0, -1.0, 0.5, 9.0]]), torch.tensor([[1.0, 1.0, 2.0, 0.0]])
    valid = torch.tensor([[True, True, True, False]])
    softplus = torch.nn.functional.softplus
    positive, negative = softplus(torch.tensor(-0.5)), softplus(torch.tensor([2.0, -1.0])).mean()
    assert torch.allclose(write_loss(scores, subtask, valid), (positive + negative)[None] / 2)


def test_the_label_of_sub_tasks_counts_them_from_one_in_every_episode() -> None:
    (source,) = open_sources(["sample"])
    number, begins = (label_column(source, name, "labels") for name in (SUBTASK, BOUNDARY))
    first = np.cumsum(source.lengths) - source.lengths
    assert (number[first] == 1).all()
    inside = np.setdiff1d(np.arange(len(number)), first)
    assert np.array_equal(number[inside] - number[inside - 1], begins[inside])
