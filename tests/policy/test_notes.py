"""Notes in the prompt: columns of texts in training, lines of the policy in an episode."""

from pathlib import Path

import numpy as np
import pytest
import torch

from helpers import REPOSITORY
from mme_vla import MMEPolicy, UserError, build_policy
from mme_vla.extras.probing.feed import FedPolicy, Feed
from mme_vla.testing.small import open_gates, unit_stats
from mme_vla.training.data import SplitData, prepare_data

EXAMPLE = REPOSITORY / "examples" / "scratchpad"
COLUMN = "simple_subgoal"


@pytest.fixture
def policy(monkeypatch: pytest.MonkeyPatch) -> MMEPolicy:
    monkeypatch.syspath_prepend(EXAMPLE)
    policy = build_policy("scratchpad", config_dir=EXAMPLE / "configs", backbone="tiny")
    policy.require_processor().stats = unit_stats()
    open_gates(policy)
    return policy


def prepared(policy: MMEPolicy, folder: Path, **options: object) -> SplitData:
    data = {
        "name": "sample",
        "sources": ["sample"],
        "val_fraction": 0.0,
        "val_episodes": [],
        "action_offset": 0,
        "mask_padding": False,
        "jitter": False,
        "cache": {"root": str(folder), "batch_size": 32},
        **options,
    }
    return prepare_data(policy, data, 0, say=lambda line: None)


def test_a_sample_reads_the_line_before_and_learns_its_own(
    policy: MMEPolicy, tmp_path: Path
) -> None:
    dataset = prepared(policy, tmp_path, texts={"scratchpad": COLUMN}).train
    processor, tokenizer = policy.require_processor(), policy.require_processor().tokenizer
    source, episode, frame = dataset[60]["place"]
    lines = [
        dataset.sources[source].subgoals(episode, i)[COLUMN]
        for i in (frame - processor.embodiment.action.execute, frame)
    ]
    ids = dataset[60]["prompt"][dataset[60]["prompt_mask"]].tolist()
    assert f"Notes: {lines[0]};".lower() in tokenizer.decode(ids).lower()
    target = [token for token in dataset[60]["labels"]["scratchpad"].tolist() if token]
    assert lines[1].startswith(tokenizer.decode(target).lower().strip())
    first = dataset[0]
    assert "Notes: ;" in tokenizer.decode(first["prompt"][first["prompt_mask"]].tolist())
    batch = processor.collate([dataset[60], first])
    loss, metrics = policy.train()(batch)
    loss.backward()
    assert metrics["losses/line"] > 0
    assert policy.backbone.slots.grad.abs().sum() > 0


def test_a_format_with_notes_needs_their_columns(policy: MMEPolicy, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"reads the notes scratchpad: name their columns"):
        prepared(policy, tmp_path)
    with pytest.raises(
        UserError, match=r"the column 'frame_index' of sample holds int64, no texts"
    ):
        prepared(policy, tmp_path, texts={"scratchpad": "frame_index"})


@pytest.mark.parametrize("fed", [False, True], ids=["alone", "behind a feed"])
def test_the_policy_writes_one_line_a_decision(policy: MMEPolicy, fed: bool) -> None:
    torch.nn.init.normal_(policy.backbone.slots, generator=torch.Generator().manual_seed(1))
    host = FedPolicy(policy, Feed()) if fed else policy
    episode = host.start_episode("press the button")
    prompts = []
    for i in range(3):
        images = np.random.default_rng(i).integers(0, 256, (3, 64, 64, 3), dtype=np.uint8)
        episode.observe({"front": images, "wrist": images}, np.zeros((3, 8), np.float32))
        inner = episode.inner if fed else episode
        prompts.append(inner.prompt[0].tolist())
        host.act([episode])
    assert [line["frame"] for line in episode.written] == [2, 5, 8]
    assert inner.notes == {"scratchpad": episode.written[-1]["scratchpad"]}
    assert episode.written[-1]["scratchpad"]
    assert prompts[0] != prompts[1]


def test_a_failed_chunk_writes_no_line(policy: MMEPolicy, monkeypatch: pytest.MonkeyPatch) -> None:
    episode = policy.start_episode("press the button")
    images = np.zeros((3, 64, 64, 3), np.uint8)
    episode.observe({"front": images, "wrist": images}, np.zeros((3, 8), np.float32))
    monkeypatch.setattr(policy.require_processor(), "absolute_actions", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        policy.act(episode)
    assert not episode.written
    assert not episode.notes
