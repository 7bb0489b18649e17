"""The demonstration in examples/: with a memory a policy learns what only the video showed, without one it cannot."""

from functools import partial

import pytest
from conftest import REPOSITORY
from test_training import SMALL

from mme_vla.testing.small import BEYOND

GUESSING = 0.75


@pytest.fixture
def learn(monkeypatch):
    monkeypatch.syspath_prepend(REPOSITORY / "examples")
    import memory_matters

    return partial(memory_matters.learn, steps=99, episodes=32, lr=5e-3, backbone=SMALL)


def test_a_memory_learns_what_only_the_video_showed(learn):
    assert learn("framesamp_expert")["error"] < 0.5 * GUESSING


@pytest.mark.parametrize("model", [*BEYOND, "actions_context", "spacetime_modul"])
def test_so_does_each_memory_beyond_the_paper(learn, model):
    assert learn(model)["error"] < 0.5 * GUESSING


def test_without_memory_it_stays_a_guess(learn):
    assert learn("pi05")["error"] > 0.9 * GUESSING
