"""Data for many processes: read ahead within bounds, files held open, rows on pages; and what is
computed again.
"""

import resource
import threading
from pathlib import Path

import numpy as np
import pytest
import torch

from helpers.trainings import policy
from mme_vla.config.composition import compose
from mme_vla.data.cache_building import PAGE, ahead, save_aligned
from mme_vla.errors import UserError
from mme_vla.memory.history import FrameScores
from mme_vla.memory.tokendrop import FIRST_FRAME_SCORE, THRESHOLD, ranked_patches
from mme_vla.policy.finetune import apply_finetuning, cast_frozen
from mme_vla.speed import SAVED_OPS
from mme_vla.training.order import readers
from mme_vla.utils import files_to_hold


def test_reading_ahead_is_bounded_in_bytes() -> None:
    assert readers(8, 10**6, 8e9) == (8, 4)
    assert readers(8, 400 * 10**6, 8e9) == (8, 2)  # 20 batches fit
    assert readers(8, 10**9, 5e9) == (5, 1)  # fewer read
    assert readers(8, 10**12, 8e9) == (1, 1)  # one batch there must be


def test_things_are_made_ahead_and_no_further() -> None:
    made: list[int] = []
    third = threading.Event()

    def things():
        for i in range(5):
            made.append(i)
            if i == 2:
                third.set()
            yield i

    items = ahead(things(), 1)
    assert next(items) == 0
    assert third.wait(10)  # one is held, one waits to be held
    assert made[:3] == [0, 1, 2] and len(made) <= 3
    assert list(items) == [1, 2, 3, 4]


def test_what_goes_wrong_ahead_is_raised_where_it_is_used() -> None:
    def things():
        yield 1
        raise UserError("broken image")

    items = ahead(things(), 2)
    assert next(items) == 1
    with pytest.raises(UserError, match="broken image"):
        next(items)


def test_leaving_early_ends_the_thread() -> None:
    items = ahead(iter(range(10**6)), 1)
    next(items)
    items.close()
    assert not [thread for thread in threading.enumerate() if thread.name == "ahead"]


@pytest.mark.parametrize("shape", [(3, 64, 2048), (1, 4, 8)])
def test_rows_of_a_cache_begin_on_pages(tmp_path: Path, shape: tuple[int, ...]) -> None:
    tokens = np.random.default_rng(0).integers(0, 2**16, shape).astype(np.uint16)
    path = tmp_path / "tokens.npy"
    with path.open("wb") as file:
        save_aligned(file, tokens)
    mapped = np.load(path, mmap_mode="r")
    assert np.array_equal(mapped, tokens)
    assert mapped.offset == PAGE


def test_as_many_files_are_open_as_the_system_allows(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[tuple[int, int]] = []
    monkeypatch.setattr(resource, "getrlimit", lambda what: (1024, 4096))
    monkeypatch.setattr(resource, "setrlimit", lambda what, limits: calls.append(limits))
    assert files_to_hold(100) == 100 and calls == []
    assert files_to_hold(2000) == 2000 and calls == [(2256, 4096)]
    assert files_to_hold(10**6) == 4096 - 256


@pytest.mark.parametrize("limit", [64, 65, 100, 512, 2048])
def test_ranking_no_more_than_can_stay_changes_no_choice(limit: int) -> None:
    rng = np.random.default_rng(limit)
    # many ties
    values = rng.choice([0.0, THRESHOLD / 2, 0.1, 0.2, 0.3, 0.5], (40, 64)).astype(np.float32)
    scores = FrameScores(np.arange(7, 320, 8), values)
    rows, patches = np.nonzero(values >= THRESHOLD)
    every = [(FIRST_FRAME_SCORE, 0, patch) for patch in range(64)]
    every += [
        (values[row, patch], scores.frames[row], patch)
        for row, patch in zip(rows, patches, strict=True)
    ]
    expected = [(frame, patch) for _, frame, patch in sorted(every)[-limit:]]
    assert ranked_patches(scores, 64, limit).tolist() == [list(map(int, pair)) for pair in expected]


def gradients(recompute: bool | str) -> dict[str, torch.Tensor]:
    built = policy("framesamp_modul", policy={"augment": False}).train()
    built.recompute(recompute)
    batch = built.full_batch()
    built(batch, built.training_noise(1, torch.Generator().manual_seed(0)))[0].backward()
    return {name: p.grad for name, p in built.named_parameters() if p.grad is not None}


def test_selective_recomputation_changes_no_gradient_and_keeps_products() -> None:
    baseline, selective = gradients(False), gradients("selective")
    assert baseline.keys() == selective.keys()
    for name, gradient in baseline.items():
        torch.testing.assert_close(gradient, selective[name], msg=name)
    counts = {how: _products(how) for how in (False, True, "selective")}
    assert counts["selective"] == counts[False] < counts[True]


def _products(how: bool | str) -> int:
    """Matrix products of a forward and a backward pass."""
    from torch.utils._python_dispatch import TorchDispatchMode

    class Count(TorchDispatchMode):
        n_products = 0

        def __torch_dispatch__(self, func, types, args=(), kwargs=None):
            self.n_products += func in SAVED_OPS
            return func(*args, **(kwargs or {}))

    built = policy(policy={"augment": False}).train()
    built.recompute(how)
    draws = built.training_noise(1, torch.Generator().manual_seed(0))
    with Count() as count:
        built(built.full_batch(), draws)[0].backward()
    return count.n_products


def test_what_does_not_learn_may_be_stored_in_bfloat16() -> None:
    built = policy("framesamp_modul", policy={"compute_dtype": "bfloat16"})
    apply_finetuning(built, "expert_only", frozen_dtype="bfloat16")
    for name, parameter in built.named_parameters():
        assert parameter.dtype == (torch.float32 if parameter.requires_grad else torch.bfloat16), (
            name
        )
    loss, _ = built.train()(built.full_batch())
    loss.backward()
    with pytest.raises(UserError, match=r"policy\.compute_dtype=bfloat16 too"):
        apply_finetuning(policy(), frozen_dtype="bfloat16")
    with pytest.raises(UserError, match=r"finetune\.frozen_dtype='half'"):
        apply_finetuning(policy(), frozen_dtype="half")
    cast_frozen(built, None)
    assert compose("train", ["finetune=lora"]).finetune.frozen_dtype is None
