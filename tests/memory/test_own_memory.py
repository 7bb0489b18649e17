"""The worked example of docs/extend/add-a-memory.md: a memory outside the package builds, streams
and trains.
"""

import importlib
import json
import os
import re
import runpy
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from helpers import REPOSITORY
from mme_vla import Memory, MemoryTokens, UserError, build_policy, register
from mme_vla.config.composition import compose
from mme_vla.envs.rendering import render_backend
from mme_vla.evaluation.store import find_records, read_folders
from mme_vla.memory.framesamp import FrameSamp
from mme_vla.memory.history import OnlineHistory
from mme_vla.memory.tokendrop import TokenDrop
from mme_vla.testing import check_memory
from mme_vla.testing.small import moving_frames, open_gates, random_batch, unit_stats
from mme_vla.types import FrameBatch

EXAMPLE = REPOSITORY / "examples" / "last_frames"


@pytest.fixture
def policy(monkeypatch):
    monkeypatch.syspath_prepend(EXAMPLE)
    policy = build_policy("last_frames_context", config_dir=EXAMPLE / "configs")
    policy.processor.stats = unit_stats()
    open_gates(policy)
    return policy


def test_the_page_shows_the_files_that_are_tested():
    page = (REPOSITORY / "docs" / "extend" / "add-a-memory.md").read_text()
    for file in (
        "last_frames.py",
        "configs/memory/last_frames.yaml",
        "configs/model/last_frames_context.yaml",
    ):
        assert (EXAMPLE / file).read_text().strip() in page, file


def test_the_pages_memory_with_a_forward_of_its_own_passes_the_check_acts_and_learns(tmp_path):
    page = (REPOSITORY / "docs" / "extend" / "add-a-memory.md").read_text()
    block = next(
        block
        for block in re.findall(r"```python\n(.*?)```", page, re.DOTALL)
        if "FrameMeans" in block
    )
    exec(compile(block, "docs/extend/add-a-memory.md", "exec"), {})
    check_memory("frame_means", budget=6)
    (tmp_path / "memory").mkdir()
    lines = "# @package _global_\nmemory: {name: frame_means, budget: 6, grid: 4}\n"
    (tmp_path / "memory" / "frame_means.yaml").write_text(lines)
    choices = {"backbone": "tiny", "memory": "frame_means", "integration": "context"}
    policy = build_policy("pi05", config_dir=tmp_path, **choices)
    policy.processor.stats = unit_stats()
    open_gates(policy)
    episode = policy.start_episode("press the button")
    frames = moving_frames(9)
    episode.observe({"front": frames, "wrist": frames}, np.zeros((9, 8), np.float32))
    assert torch.isfinite(torch.from_numpy(policy.act([episode]))).all()
    batch = random_batch(policy, valid=32)
    batch.history.features = batch.history.features.bfloat16()
    loss, _ = policy(batch)
    loss.backward()
    assert policy.memory.project.weight.grad.any()


@pytest.fixture
def rules(monkeypatch, tmp_path):
    """The page's `rules.py`, as a module in a file."""
    page = (REPOSITORY / "docs" / "extend" / "add-a-memory.md").read_text()
    (block,) = (b for b in re.findall(r"```python\n(.*?)```", page, re.DOTALL) if "Contrast" in b)
    (tmp_path / "rules.py").write_text(block)
    monkeypatch.syspath_prepend(tmp_path)
    yield importlib.import_module("rules")
    del sys.modules["rules"]


@pytest.mark.parametrize("name", ["recent_changes", "contrast"])
def test_the_pages_rules_pass_the_check(rules, name):
    check_memory(name, budget=64, grid=4, stride=4)


def test_a_scorer_of_the_first_frame_does_not_take_the_budget_twice(rules):
    """`Contrast` scores frame 0, whose patches are kept anyway."""
    memory = rules.ContrastDrop(64, 32, budget=40, grid=4, stride=4)
    history = OnlineHistory(memory.storage, memory.make_scorer())
    history.take(FrameBatch.of(moving_frames(24)), lambda images: torch.zeros(len(images), 16, 64))
    selection = memory.select(history, 23)
    assert len(np.unique(selection, axis=0)) == len(selection) == 40


def test_a_selection_with_a_patch_twice_fails_the_check(rules, monkeypatch):
    def first_twice(*args):
        selection = TokenDrop.select(*args)
        return selection[[0, *range(len(selection) - 1)]]

    monkeypatch.setattr(rules.RecentChanges, "select", first_twice)
    with pytest.raises(AssertionError, match="select chose a patch twice"):
        check_memory("recent_changes", budget=64, grid=4, stride=4)


@pytest.mark.parametrize(
    ("method", "replacement", "message"),
    [
        ("select", lambda memory, history, step, rng=None: [(step, 0)], "step 0 it gave list"),
        ("forward", lambda memory, history: history.features, "MemoryTokens.*; got Tensor"),
        (
            "forward",
            lambda memory, history: MemoryTokens(history.features.mul_(2), history.mask),
            r"forward changed history\.features in place",
        ),
        (
            "forward",
            lambda memory, history: MemoryTokens(
                torch.ones(2, 16, 48), history.mask, ages=torch.ones(2)
            ),
            r"ages must be \(2, 16\); got \(2,\)",
        ),
        (
            "forward",
            lambda memory, history: replace(
                FrameSamp.forward(memory, history), losses={"write": torch.tensor(1.0)}
            ),
            r"one number a sample, \(2,\); write has \(\)",
        ),
        (
            "forward",
            lambda memory, history: replace(
                FrameSamp.forward(memory, history), tokens=torch.randn(2, 16, 48)
            ),
            "other tokens .* the second time",
        ),
        ("__init__", lambda memory, d_vision, width, **_: Memory.__init__(memory), "no budget"),
    ],
)
def test_a_mistake_is_named_by_the_check(method, replacement, message):
    register("memory", "mistaken")(type("Mistaken", (FrameSamp,), {method: replacement}))
    with pytest.raises(AssertionError, match=message):
        check_memory("mistaken", budget=16)


def test_more_memory_tokens_than_the_budget_are_refused(policy):
    encode = policy.memory.forward

    def twice(history):
        tokens = encode(history)
        return MemoryTokens(tokens.tokens.repeat(1, 2, 1), tokens.mask.repeat(1, 2))

    policy.memory.forward = twice
    with pytest.raises(ValueError, match="returned 512 memory tokens; its budget is 256"):
        policy(random_batch(policy))


def test_what_is_no_memory_tokens_is_refused_in_training_and_in_an_episode(policy):
    policy.memory.forward = lambda history: (history.features, history.mask)
    message = r"LastFrames.forward returned tuple; expected mme_vla.MemoryTokens"
    with pytest.raises(UserError, match=message):
        policy(random_batch(policy))
    episode = policy.start_episode("press the button")
    frames = moving_frames(8)
    episode.observe({"front": frames, "wrist": frames}, np.zeros((8, 8)))
    with pytest.raises(UserError, match=message):
        policy.act([episode])


def test_a_constructor_without_the_widths_is_named():
    register("memory", "mistaken")(lambda budget=16: FrameSamp(32, 48, budget))
    with pytest.raises(UserError, match="its constructor must take d_vision and width"):
        check_memory("mistaken")


def test_a_memory_of_first_last_and_other_frames_is_checked_with_its_defaults():
    """The synthetic episode is long enough for frames between."""
    check_memory("gist")


def test_an_unknown_memory_leads_to_plugins():
    with pytest.raises(UserError, match=r"One of your own .* that `plugins` names\."):
        check_memory("qqqq")


def test_a_new_ranking_keeps_the_cache_and_new_scores_have_their_own(rules):
    released = TokenDrop(64, 32)
    assert rules.RecentChanges(64, 32).storage == released.storage
    assert rules.ContrastDrop(64, 32).storage.scorer.startswith("contrast-grid8-stride8-")


def test_the_pages_rules_choose_other_patches(rules):
    frames = np.random.default_rng(0).integers(0, 256, (41, 64, 64, 3), dtype=np.uint8)
    frames[:] = frames[0]
    frames[3, :16] = 0  # changes most, and long ago
    frames[39, 48:, :8] = 128
    selections = []
    for kind in (TokenDrop, rules.RecentChanges, rules.ContrastDrop):
        memory = kind(64, 32, budget=20, grid=4, stride=4)
        history = OnlineHistory(memory.storage, memory.make_scorer())
        history.take(FrameBatch.of(frames), lambda images: torch.zeros(len(images), 16, 64))
        selections.append(memory.select(history, 40).tolist())
    assert selections[0] != selections[1] != selections[2] != selections[0]


def test_the_pages_words_make_a_rule_a_choice(rules):
    words = ["memory=tokendrop", "memory.name=contrast", "plugins=[rules]", "integration=modulator"]
    cfg = compose("train", words)
    assert (cfg.plugins, cfg.memory.name, cfg.memory.budget) == (["rules"], "contrast", 512)


def test_it_passes_the_check_that_the_page_names(policy):
    check_memory("last_frames", budget=64, spacing=3)


def test_its_file_makes_it_a_choice_for_any_integration_and_beside_another(monkeypatch):
    monkeypatch.chdir(EXAMPLE)
    trees = [EXAMPLE / "configs"]
    cfg = compose(
        "train",
        ["memory=last_frames", "integration=modulator", "memory.spacing=8"],
        extra_dirs=trees,
    )
    assert (cfg.plugins, cfg.memory.spacing, cfg.integration.name) == (
        ["last_frames"],
        8,
        "modulator",
    )
    joined = {
        "memory": ["last_frames", "framesamp"],
        "integration": "expert",
        "plugins": ["last_frames"],
    }
    policy = build_policy("pi05", config_dir=trees[0], device="meta", **joined)
    assert [type(member).__name__ for member in policy.memory.memories] == [
        "LastFrames",
        "FrameSamp",
    ]


@pytest.mark.nightly
def test_own_memory_trains_and_is_evaluated_on_nano(tmp_path):
    pytest.importorskip(
        "mani_skill", reason="the simulator is not installed: the extra `sim` has it"
    )
    try:
        render_backend()
    except UserError as error:
        pytest.skip(str(error))
    settings = [
        "beside=[]",
        "also=[]",
        "rendered_for=[]",
        "planner=false",
        "videos=false",
        "split=val",
        "episodes=1",
        "max_steps=1",
        "demonstrations={easy: 2, medium: 0, hard: 0}",
        "train.steps=1",
        "train.batch_size=2",
        "+memories.last_frames={budget: 4, grid: 1, spacing: 32}",
    ]
    words = ["task=VideoUnmask", "model=last_frames_context", "--config-dir", "configs", *settings]
    command = [sys.executable, "-m", "mme_vla.nano", *words, f"output={tmp_path}"]
    environment = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    done = subprocess.run(command, cwd=EXAMPLE, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    (record,) = read_folders(find_records([tmp_path]))
    assert (record.model, record.memory_budget) == ("last_frames_context", 4)
    (weights,) = tmp_path.rglob("step_*/model.safetensors")
    assert json.loads((weights.parent / "config.json").read_text())["plugins"] == ["last_frames"]


def test_custom_memory_gets_a_loss_and_acts(policy):
    batch = random_batch(policy, valid=32)
    loss, _ = policy(batch)
    loss.backward()
    assert policy.memory.encoder.project.weight.grad.abs().sum() > 0
    episode = policy.start_episode("press the button")
    frames = np.random.default_rng(0).integers(0, 256, (9, 64, 64, 3), dtype=np.uint8)
    episode.observe({"front": frames, "wrist": frames}, np.zeros((9, 8), np.float32))
    recalled = episode.gather_selection()
    assert sorted(set(recalled.positions[recalled.mask][:, 0].tolist())) == [0, 4, 8]
    assert torch.isfinite(torch.from_numpy(policy.act([episode]))).all()


def test_custom_memory_trains_through_the_same_command(tmp_path, monkeypatch):
    small = [
        "backbone.depth=1",
        "backbone.vision.depth=1",
        "backbone.vision.image_size=16",
        "backbone.vision.patch_size=1",
    ]
    brief = [
        "train.steps=2",
        "train.val_samples=2",
        "train.open_loop_chunks=1",
        "train.workers=0",
        "logger=none",
    ]
    options = ["model=last_frames_context", *small, *brief, f"hydra.run.dir={tmp_path / 'run'}"]
    # As `python -m mme_vla.train` would, in a process that has imported the large packages already.
    monkeypatch.setattr(
        sys, "argv", ["mme_vla.train", "--config-dir", str(EXAMPLE / "configs"), *options]
    )
    monkeypatch.syspath_prepend(EXAMPLE)
    monkeypatch.chdir(EXAMPLE)
    monkeypatch.delitem(sys.modules, "mme_vla.train", raising=False)
    runpy.run_module("mme_vla.train", run_name="__main__", alter_sys=True)
    assert list((tmp_path / "run").rglob("model.safetensors"))
