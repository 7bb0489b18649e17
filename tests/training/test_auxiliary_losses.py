"""Auxiliary losses, their labels from dataset columns, and sample weights."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import torch

from helpers import REPOSITORY
from helpers.lerobot_tables import custom_robot, write_dataset
from mme_vla import MMEPolicy, UserError, build_policy
from mme_vla.data.columns import (
    BOUNDARY,
    FACT,
    FACT_VISIBLE,
    SUBTASK,
    label_column,
    text_column,
    weight_column,
)
from mme_vla.data.dataset import TrainingDataset
from mme_vla.data.episodes import EpisodeSource
from mme_vla.data.lerobot_files import FACTS, SAMPLE
from mme_vla.envs.facts import Fact, write_facts
from mme_vla.memory.base import stack_history
from mme_vla.processing.images import augmentation_draws
from mme_vla.testing.small import open_gates, random_batch, small_policy, unit_stats
from mme_vla.training.data import SplitData, prepare_data
from mme_vla.training.settings import DataSettings, TrainSettings
from mme_vla.types import Batch, Labels, ReadsLabels

EXAMPLE = REPOSITORY / "examples" / "write_head"
TABLE = "data/chunk-000/file-000.parquet"


@pytest.fixture
def policy(monkeypatch: pytest.MonkeyPatch) -> MMEPolicy:
    monkeypatch.syspath_prepend(EXAMPLE)
    policy = build_policy("write_head_modul", config_dir=EXAMPLE / "configs", memory={"budget": 64})
    policy.require_processor().stats = unit_stats()
    open_gates(policy)
    return policy.train()


def labelled(policy: MMEPolicy) -> Batch:
    batch = random_batch(policy, batch=2, valid=32)
    labels = Labels({BOUNDARY: (batch.history.positions[..., 0] % 2).float() * batch.history.mask})
    return replace(batch, history=replace(batch.history, labels=labels))


def loss_of(
    policy: MMEPolicy, batch: Batch, **weights: float
) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
    policy.loss_weights = weights
    policy.zero_grad()
    noise = policy.training_noise(2, torch.Generator().manual_seed(3))
    changes = augmentation_draws(2, torch.Generator().manual_seed(4))
    loss, metrics = policy(batch, noise | {"changes": changes})
    loss.backward()
    return loss.detach(), metrics


def split(policy: MMEPolicy, folder: Path, **options: object) -> SplitData:
    data = {
        "name": "sample",
        "sources": ["sample"],
        "val_fraction": 0.0,
        "val_episodes": [],
        "action_offset": 0,
        "mask_padding": False,
        "jitter": False,
        "cache": {"root": str(folder), "batch_size": 32, "max_build_frames": 5000},
        **options,
    }
    return prepare_data(policy, DataSettings.from_dict(data), 0, say=lambda line: None)


def prepared(policy: MMEPolicy, folder: Path, **options: object) -> TrainingDataset:
    dataset = split(policy, folder, **options).train
    assert isinstance(dataset, TrainingDataset)
    return dataset


def gradients(policy: MMEPolicy) -> dict[str, torch.Tensor]:
    return {name: p.grad.clone() for name, p in policy.named_parameters() if p.grad is not None}


def test_the_auxiliary_loss_is_weighed_and_logged(policy: MMEPolicy) -> None:
    batch = labelled(policy)
    loss, metrics = loss_of(policy, batch, write=0.5)
    assert torch.equal(loss, metrics["losses/action"] + 0.5 * metrics["losses/write"])
    assert metrics["losses/write"] > 0
    assert policy.memory.write.weight.grad.abs().sum() > 0
    assert loss_of(policy, batch)[0] == metrics["losses/action"] + metrics["losses/write"]


def test_weight_zero_leaves_loss_and_gradients_bitwise_equal(policy: MMEPolicy) -> None:
    batch = labelled(policy)
    loss, _ = loss_of(policy, batch, write=0.0)
    weighed = gradients(policy)
    base, metrics = loss_of(policy, replace(batch, history=replace(batch.history, labels=Labels())))
    assert torch.equal(loss, base)
    assert "losses/write" not in metrics
    assert all(torch.equal(weighed[name], value) for name, value in gradients(policy).items())


def test_evaluation_has_no_auxiliary_loss(policy: MMEPolicy) -> None:
    noise = policy.training_noise(2, torch.Generator().manual_seed(3))
    policy.eval()
    loss, metrics = policy(labelled(policy), noise)
    assert set(metrics) == {"loss"}
    assert torch.equal(
        loss,
        policy(replace(labelled(policy), history=random_batch(policy, valid=32).history), noise)[0],
    )


def test_an_unknown_name_in_the_weights_is_an_error(policy: MMEPolicy) -> None:
    with pytest.raises(UserError, match="Did you mean 'write'"):
        loss_of(policy, labelled(policy), writes=1.0)
    with pytest.raises(UserError, match=r"train.losses.write=-1 must be a number, 0 or more"):
        TrainSettings.from_dict({"steps": 1, "batch_size": 1, "lr": 1.0, "losses": {"write": -1}})


def test_weights_multiply_a_samples_loss_after_its_mean() -> None:
    policy = small_policy("framesamp_modul").train()
    batch = random_batch(policy, batch=2, valid=32)
    both = loss_of(policy, replace(batch, weight=torch.ones(2)))[0]
    first = loss_of(policy, replace(batch, weight=torch.tensor([2.0, 0.0])))[0]
    second = loss_of(policy, replace(batch, weight=torch.tensor([0.0, 2.0])))[0]
    torch.testing.assert_close(both, loss_of(policy, batch)[0])
    torch.testing.assert_close((first + second) / 2, both)
    assert first != second


def test_a_backbone_has_the_labels_of_the_current_frame(tmp_path: Path) -> None:
    policy = small_policy("pi05")
    kind = type(policy.backbone)
    policy.backbone.__class__ = type(
        "Reader", (kind, ReadsLabels), {"reads_labels": ("frame_index",)}
    )
    items = [prepared(policy, tmp_path)[index] for index in (10, 150)]
    batch = policy.require_processor().collate(items)
    assert batch.labels["frame_index"].tolist() == [item["place"][2] for item in items]


@pytest.mark.slow
def test_labels_lie_at_the_frames_of_the_tokens(policy: MMEPolicy, tmp_path: Path) -> None:
    dataset = prepared(policy, tmp_path, weights="frame_index")
    item = dataset[150]
    source, episode, frame = item["place"]
    texts = [
        dataset.sources[source].subgoals(episode, i)["simple_subgoal"] for i in range(frame + 1)
    ]
    begins = [float(i == 0 or texts[i] != texts[i - 1]) for i in range(frame + 1)]
    history = item["history"]
    frames = history.positions[:, 0].long().tolist()
    expected = [
        begins[f] if valid else 0.0 for f, valid in zip(frames, history.mask.tolist(), strict=True)
    ]
    assert history.labels[BOUNDARY].tolist() == expected
    assert item["weight"] == frame
    batch = policy.require_processor().collate([item, dataset[10]])
    assert batch.history.labels[BOUNDARY].shape == batch.history.mask.shape
    assert batch.weight.tolist() == [frame, dataset[10]["weight"]]
    assert stack_history([history]).rows(slice(0, 1)).labels[BOUNDARY].shape == (1, 64)


def test_joined_memories_read_labels_and_return_losses(policy: MMEPolicy) -> None:
    joined = build_policy(
        "pi05", memory=[{"name": "write_head", "budget": 32}, {"name": "framesamp", "budget": 32}],
        integration="modulator", config_dir=EXAMPLE / "configs",
    )  # fmt: skip
    joined.require_processor().stats = unit_stats()
    assert joined.memory.reads_labels == (BOUNDARY,)
    assert "losses/write_head/write" in loss_of(joined.train(), labelled(joined))[1]


def sample_with(folder: Path, *facts: tuple[int, Fact]) -> Path:
    """A copy of the sample with facts of episodes."""
    root = folder / "sample"
    shutil.copytree(SAMPLE, root)
    (root / "SHA256SUMS").unlink(missing_ok=True)
    source = EpisodeSource(root)
    tables = [(episode, source.task(episode), [fact]) for episode, fact in facts]
    write_facts(root / FACTS, tables)
    return root


def test_labels_of_facts_count_them_in_their_episode_and_mark_their_frames(tmp_path: Path) -> None:
    facts = [
        (0, Fact("light 1", "red", (0, 3), (40,))),
        (1, Fact("light 2", "blue", (20, 30), (40,))),
        (1, Fact("light 1", "red", (8, 12), (40,), changed=20)),
    ]
    source = EpisodeSource(sample_with(tmp_path, *facts))
    count = label_column(source, FACT, "labels")
    is_visible = label_column(source, FACT_VISIBLE, "labels")
    first, second, others = np.split(count, np.cumsum(source.lengths[:2]))
    assert set(first) == {1} and not others.any()
    frames = np.arange(len(second))
    assert second.tolist() == ((frames >= 8).astype(int) + (frames >= 20)).tolist()
    visible = np.split(is_visible, np.cumsum(source.lengths[:2]))
    assert [np.flatnonzero(part).tolist() for part in visible] == [
        [0, 1, 2, 3],
        [*range(8, 13), *range(20, 31)],
        [],
    ]


def test_keyframes_learn_from_facts(tmp_path: Path) -> None:
    fact = Fact("light", "red", (20, 30), (40,))
    root = sample_with(tmp_path, (0, fact))
    policy = small_policy("keyframes_modul", memory={"label": FACT, "budget": 64})
    dataset = prepared(policy, tmp_path, sources=[str(root)])
    item = dataset[100]
    assert item["place"][:2] == (0, 0)
    frames = item["history"].positions[:, 0]
    assert torch.equal(item["history"].labels[FACT], (frames >= 20).float() * item["history"].mask)
    batch = policy.require_processor().collate([item])
    noise = policy.training_noise(1, torch.Generator().manual_seed(0))
    assert policy.train()(batch, noise)[1]["losses/write"] > 0


def test_side_files_that_are_read_count_as_data_and_no_others(tmp_path: Path) -> None:
    root = sample_with(tmp_path, (0, Fact("light", "red", (20, 30), (40,))))
    starts = tmp_path / "starts.json"
    expected = EpisodeSource(root).exec_starts.tolist()
    starts.write_text(json.dumps(dict(enumerate(expected))))
    entry = {"root": str(root), "exec_starts": str(starts)}
    blind = small_policy("framesamp_modul", memory={"budget": 64})
    counting = small_policy("keyframes_modul", memory={"label": FACT, "budget": 64})
    assert split(blind, tmp_path, sources=[str(root)]).side_files == [{}]
    before = split(counting, tmp_path, sources=[entry])
    assert before.side_files[0].keys() == {FACTS, "exec_starts"}
    weighed = split(blind, tmp_path, sources=[str(root)], weights=FACT_VISIBLE)
    assert weighed.side_files == [{FACTS: before.side_files[0][FACTS]}]

    text = (root / FACTS).read_text()
    (root / FACTS).write_text(text.replace("20", "21"))
    after = split(counting, tmp_path, sources=[entry])
    assert after.content == before.content
    changed = after.side_files[0].items() ^ before.side_files[0].items()
    assert {name for name, _ in changed} == {FACTS}


HEADER, OF_0 = "episode,task,fact,from,to\n", "VideoUnmask,red"


@pytest.mark.parametrize(
    ("table", "problem"),
    [
        (None, r"sample has no meta/facts.csv. `mme-vla record` writes it"),
        ("episode,from\n0,1\n", "is no table of facts"),
        (f"{HEADER}0,{OF_0},first,2\n", "is no table of facts"),
        (f"{HEADER}0,{OF_0},,2\n", "is no table of facts"),
        (
            f"{HEADER}0,{OF_0},1,2\n99,{OF_0},1,2\n",
            "line 3 of .* frames 1 to 2 of episode 99, which",
        ),
        (f"{HEADER}0,{OF_0},1,9999\n", "line 2 of .* frames 1 to 9999 of episode 0, which"),
        (f"{HEADER}0,{OF_0},2,1\n", "line 2 of .* frames 2 to 1 of episode 0, which"),
        (f"{HEADER}1,{OF_0},1,2\n", "line 2 of .* is of the task 'VideoUnmask'; episode 1 .*Lock"),
        (f"{HEADER}0,{OF_0},1,4\n0,{OF_0},4,9\n", "line 3 of .* the fact 'red' at frames 4 to 9"),
    ],
)
def test_facts_that_contradict_the_dataset_are_reported(
    table: str | None, problem: str, tmp_path: Path
) -> None:
    root = sample_with(tmp_path)
    (root / FACTS).unlink()
    if table is not None:
        (root / FACTS).write_text(table)
    with pytest.raises(UserError, match=f"The policy's labels: .*{problem}"):
        label_column(EpisodeSource(root), FACT, "The policy's labels")


CASES: list[tuple[str, Callable[[np.ndarray], pa.Array], str]] = [
    (
        "missing",
        lambda v: pa.array([None if i == 400 else x for i, x in enumerate(v.tolist())]),
        "has no value",
    ),
    (
        "infinite",
        lambda v: pa.array(np.where(np.arange(len(v)) == 400, np.inf, v)),
        "is missing or not finite",
    ),
    (
        "ragged",
        lambda v: pa.array([[x] * (3 if i == 400 else 2) for i, x in enumerate(v)]),
        "does not hold 2 numbers",
    ),
    ("empty", lambda v: pa.array([[]] * len(v), pa.list_(pa.float32())), "does not hold 1 num"),
    (
        "too large",
        lambda v: pa.array(np.where(np.arange(len(v)) == 400, 2**24 + 1, 7)),
        r"holds a whole number that float32 cannot \(beyond 2\*\*24\)",
    ),
]


@pytest.mark.parametrize(("name", "change", "problem"), CASES, ids=[case[0] for case in CASES])
def test_a_bad_label_names_column_and_episode(
    name: str, change: Any, problem: str, tmp_path: Path
) -> None:
    root = tmp_path / "sample"
    shutil.copytree(SAMPLE, root)
    (root / "SHA256SUMS").unlink(missing_ok=True)
    table = pq.read_table(root / TABLE)
    pq.write_table(
        table.append_column("reward", change(np.arange(len(table), dtype=np.float64))), root / TABLE
    )
    source = EpisodeSource(root)
    episode, frame = source.locate(0 if name == "empty" else 400)
    with pytest.raises(
        UserError, match=rf"'reward' of sample {problem}.* at frame {frame} of episode {episode} "
    ):
        label_column(source, "reward", "data.weights")


def labelled_dataset(root: Path, values: list[Any], more: list[Any]) -> EpisodeSource:
    """A small dataset of two files, whose column `extra` has these values."""
    write_dataset(root)
    rows = pq.ParquetFile(root / TABLE).read()
    for number, column in enumerate((values, more)):
        part = rows.slice(5 * number, len(column)).append_column("extra", pa.array(column))
        pq.write_table(part, root / TABLE.replace("file-000", f"file-00{number}"))
    return EpisodeSource(root, robot=custom_robot())


def test_a_label_has_one_type_in_all_files(tmp_path: Path) -> None:
    source = labelled_dataset(tmp_path, [1] * 5, [0.5] * 4)
    with pytest.raises(UserError, match=r"'extra' of .* holds double and int64 in different files"):
        label_column(source, "extra", "data.weights")


def test_weights_that_leave_nothing_to_learn_are_refused(tmp_path: Path) -> None:
    source = labelled_dataset(tmp_path, [0.0] * 5, [1e-60] * 4)
    with pytest.raises(UserError, match=r"'extra' of .* is 0 at every frame"):
        weight_column(source, "extra")


@pytest.mark.parametrize("text", ["", "  \n", None])
def test_a_text_that_says_nothing_is_refused(tmp_path: Path, text: str | None) -> None:
    source = labelled_dataset(tmp_path, ["push"] * 5, ["pull", "pull", text, "pull"])
    with pytest.raises(UserError, match=r"has no text at frame 2 of episode 1 "):
        text_column(source, "extra", "subgoal_text")
    source = labelled_dataset(tmp_path, [1] * 5, [2] * 4)
    with pytest.raises(UserError, match=r"holds int64, no texts"):
        text_column(source, "extra", "subgoal_text")


def test_training_with_subgoals_reads_their_columns_when_it_begins(tmp_path: Path) -> None:
    root = sample_with(tmp_path)
    table = pq.read_table(root / TABLE)
    texts = table["simple_subgoal_online"].to_pylist()
    texts[400] = ""
    table = table.drop_columns(["simple_subgoal_online"])
    table = table.append_column("simple_subgoal_online", pa.array(texts))
    pq.write_table(table, root / TABLE)
    with pytest.raises(UserError, match=r"'simple_subgoal_online' of sample has no text at frame"):
        prepared(small_policy("simplesg"), tmp_path, sources=[str(root)])


def test_an_absent_column_is_reported() -> None:
    with pytest.raises(
        UserError,
        match=r"Unknown column of sample \(data.weights\) 'step_id'. Did you mean 'step_idx'",
    ):
        label_column(EpisodeSource("sample"), "step_id", "data.weights")


def test_the_start_of_a_sub_task_names_the_column_that_it_needs(tmp_path: Path) -> None:
    root = sample_with(tmp_path)
    pq.write_table(pq.read_table(root / TABLE).drop_columns(["simple_subgoal"]), root / TABLE)
    info = json.loads((root / "meta" / "info.json").read_text())
    del info["features"]["simple_subgoal"]
    (root / "meta" / "info.json").write_text(json.dumps(info))
    with pytest.raises(
        UserError, match=rf"\(the label {SUBTASK}\) 'simple_subgoal'.*memory.label=fact_index"
    ):
        label_column(EpisodeSource(root), SUBTASK, "The policy's labels")
    (root / FACTS).unlink()
    with pytest.raises(UserError, match=rf"\(the label {BOUNDARY}\) 'simple_subgoal'") as caught:
        label_column(EpisodeSource(root), BOUNDARY, "The policy's labels")
    assert FACT not in str(caught.value)
