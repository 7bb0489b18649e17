"""Training samples: as the released pipeline makes them, deterministic, from several sources, with
their history.
"""

import json
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

from helpers.h5_files import Recorded, robomme_robot, write_file
from helpers.memory_fakes import LastFrames, encode, same
from mme_vla.config.composition import compose, resolved
from mme_vla.data.cache import VisionCache
from mme_vla.data.cache_building import ensure_cache
from mme_vla.data.convert import ConvertOptions, convert
from mme_vla.data.dataset import TrainingDataset, collate
from mme_vla.data.episodes import EpisodeSource
from mme_vla.data.hdf5 import find_files, list_episodes
from mme_vla.data.sources import split_episodes
from mme_vla.data.statistics import compute_norm_stats
from mme_vla.embodiment import ROBOMME_JOINT
from mme_vla.errors import UserError
from mme_vla.processing.base import SampleSpec
from mme_vla.processing.processor import Processor
from mme_vla.processing.prompt import SubgoalText
from mme_vla.processing.tokenizer import Tokenizer
from mme_vla.testing.small import small_policy
from mme_vla.training.data import prepare_data
from mme_vla.training.settings import DataSettings

PNG = ConvertOptions(images="png")


def make_source(
    folder: Path, task: str, lengths: list[int], videos: list[int]
) -> tuple[EpisodeSource, list[Recorded]]:
    recorded = write_file(folder / f"record_dataset_{task}.h5", lengths, videos)
    convert(list_episodes(find_files([folder / f"record_dataset_{task}.h5"])), folder / task, PNG)
    return EpisodeSource(folder / task), recorded


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> tuple[list[EpisodeSource], list[list[Recorded]]]:
    folder = tmp_path_factory.mktemp("dataset")
    made = [make_source(folder, "Alpha", [30, 12], [6, 0]), make_source(folder, "Beta", [9], [2])]
    return [source for source, _ in made], [recorded for _, recorded in made]


@pytest.fixture(scope="module")
def processor(data) -> Processor:
    return Processor(
        image_size=28, tokenizer=Tokenizer.load("sample"), stats=compute_norm_stats(data[0])
    )


@pytest.fixture(scope="module")
def caches(data, tmp_path_factory) -> list[VisionCache]:
    root = tmp_path_factory.mktemp("caches")
    return [
        ensure_cache(source, LastFrames(), encode, "abc", root=root, dtype="float32")
        for source in data[0]
    ]


@pytest.mark.slow
def test_golden_samples_are_reproduced(parity: Path, tmp_path: Path) -> None:
    golden = json.loads((parity / "pipeline_datasets.json").read_text())["policy_dataset"]
    with zipfile.ZipFile(parity / "pipeline_h5.zip") as archive:
        archive.extractall(tmp_path / "h5")
    # no pixel is compared here
    convert(list_episodes(find_files([tmp_path / "h5"])), tmp_path / "out")
    source = EpisodeSource(tmp_path / "out")
    horizon = len(golden["samples"][0]["actions"])
    dataset = TrainingDataset(
        [source],
        Processor(28, Tokenizer.load("sample"), embodiment=ROBOMME_JOINT.with_horizon(horizon)),
    )
    assert len(dataset) == golden["stats"]["execution_samples"]
    assert source.lengths.sum() == golden["stats"]["total_samples"]
    for sample in golden["samples"]:
        step = dataset.step(sample["index"])
        assert np.array_equal(step.state, np.asarray(sample["state"], np.float32))
        assert np.array_equal(step.actions, np.asarray(sample["actions"]).astype(np.float32))
        assert [step.episode] == sample["epis_idx"] and [step.index] == sample["step_idx"]
        assert [step.exec_start] == sample["exec_start_idx"]
        assert [step.index < step.exec_start] == sample["is_demo"]
        assert step.goal == sample["prompt"]
        assert (
            step.subgoals == {name: sample[name] for name in step.subgoals}
            and len(step.subgoals) == 4
        )


def test_items_are_the_execution_steps_of_all_sources_in_order(data, processor) -> None:
    dataset = TrainingDataset(data[0], processor)
    places = [dataset.locate(i) for i in range(len(dataset))]
    assert places == [
        (s, e, t)
        for s, e, start, stop in ((0, 0, 6, 30), (0, 1, 0, 12), (1, 0, 2, 9))
        for t in range(start, stop)
    ]
    for index in (-1, len(dataset)):
        with pytest.raises(IndexError):
            dataset.locate(index)


@pytest.mark.parametrize("offset", [0, 1])
def test_a_chunk_starts_at_the_offset_and_repeats_the_last_action(
    data, processor, offset: int
) -> None:
    dataset = TrainingDataset(data[0], processor, action_offset=offset, mask_padding=True)
    actions = data[1][0][0].actions.astype(np.float32)
    for index, t in ((0, 6), (23, 29)):
        step, item = dataset.step(index), dataset[index]
        rows = np.arange(t + offset, t + offset + 20)
        assert np.array_equal(step.actions, actions[np.minimum(rows, 29)])
        assert np.array_equal(item["action_mask"].numpy(), rows < 30)
        back = processor.absolute_actions(item["actions"], item["state"])
        assert np.allclose(back.numpy(), step.actions, atol=1e-5)


def test_an_item_holds_the_current_images_and_words(data, processor) -> None:
    item = TrainingDataset(data[0], processor)[10]
    frames = [data[0][0].frames(0, [16], view)[0] for view in ("front", "wrist")]
    assert (
        torch.equal(item["images"], processor.images(frames))
        and item["images"].dtype == torch.uint8
    )
    assert torch.equal(item["prompt"], processor.prompt("do task 0")[0])
    assert item["subgoals"]["grounded_subgoal"] == "pick up 4 at <1, 2>" and item["place"] == (
        0,
        0,
        16,
    )


def test_the_history_is_the_memorys_selection_up_to_the_step(data, processor, caches) -> None:
    memory = LastFrames()
    item = TrainingDataset(data[0], processor, memory, caches)[10]
    expected = encode(data[0][0].frames(0, [14, 15, 16])).flatten(0, 1)
    assert torch.allclose(item["history"].features, expected) and item["history"].mask.all()
    assert item["history"].positions[:, 0].tolist() == [14.0] * 4 + [15.0] * 4 + [16.0] * 4


def test_items_depend_on_seed_epoch_and_index_alone(data, processor, caches) -> None:
    def make(seed: int = 1, epoch: int = 0) -> TrainingDataset:
        dataset = TrainingDataset(data[0], processor, LastFrames(), caches, jitter=True, seed=seed)
        dataset.set_epoch(epoch)
        return dataset

    first = make()
    order = [20, 3, 20, 40]
    items = [first[i] for i in order]
    assert all(same(item, make()[i]) for item, i in zip(items, order, strict=True))
    assert not same(items[0], make(epoch=1)[20]) and not same(items[0], make(seed=2)[20])


def test_workers_give_the_same_batches_as_the_main_process(data, processor, caches) -> None:
    dataset = TrainingDataset(data[0], processor, LastFrames(), caches, mask_padding=True)
    dataset[0]  # files and maps are open before the workers start
    batches = [
        list(DataLoader(dataset, batch_size=8, collate_fn=collate, num_workers=workers))
        for workers in (0, 2)
    ]
    for alone, parallel in zip(*batches, strict=True):
        assert all(
            torch.equal(a, b) for a, b in zip(alone.tensors(), parallel.tensors(), strict=True)
        )
    batch = batches[0][0]
    assert (
        batch.images.shape == (8, 2, 3, 28, 28)
        and batch.image_mask.all()
        and batch.actions.shape == (8, 20, 32)
    )
    assert batch.history.features.shape == (8, 12, 6) and batch.action_mask.shape == (8, 20)
    assert batch.state.shape == (8, 8) and batch.prompt.shape == batch.prompt_mask.shape == (8, 16)


def test_an_item_decodes_its_two_current_images_only(data, processor, caches, monkeypatch) -> None:
    requests = []
    frames = EpisodeSource.frames
    monkeypatch.setattr(
        EpisodeSource,
        "frames",
        lambda self, e, i, view=None: (requests.append(i), frames(self, e, i, view))[1],
    )
    TrainingDataset(data[0], processor, LastFrames(), caches)[10]
    assert requests == [[16], [16]]


def test_subgoals_reach_the_prompt_through_the_choice(data) -> None:
    processor = Processor(
        28, Tokenizer.load("sample"), prompt="subgoal", stats=compute_norm_stats(data[0])
    )
    dataset = TrainingDataset(
        data[0], processor, subgoal=SubgoalText("simple_subgoal", online_probability=1.0)
    )
    assert torch.equal(dataset[0]["prompt"], processor.prompt("do task 0", "pick up 1 online")[0])


def test_a_memory_without_caches_is_refused(data, processor) -> None:
    with pytest.raises(UserError, match=r"mme-vla cache"):
        TrainingDataset(data[0], processor, LastFrames())
    with pytest.raises(UserError, match="action_offset=2"):
        TrainingDataset(data[0], processor, action_offset=2)


def test_splits_hold_out_full_episodes(data, processor) -> None:
    split = split_episodes(data[0], val_episodes=["Alpha/1"])
    assert [part.tolist() for part in split.train] == [[0], [0]]
    assert [part.tolist() for part in split.val] == [[1], []]
    train = TrainingDataset(data[0], processor, episodes=split.train)
    val = TrainingDataset(data[0], processor, episodes=split.val)
    assert (len(train), len(val)) == (31, 12)
    assert {val.locate(i)[:2] for i in range(len(val))} == {(0, 1)}


@pytest.mark.parametrize(("named", "held_out"), [([], set()), (["sample"], {(1, 3)})])
def test_only_the_sample_holds_out_an_episode_by_default(
    named: list[str], held_out: set, tmp_path: Path
) -> None:
    make_source(tmp_path, "Alpha", [6, 5, 4, 3], [0, 0, 0, 0])
    sources = ",".join([str(tmp_path / "Alpha"), *named])
    composed = compose("train", [f"data.sources=[{sources}]"])
    data = DataSettings.from_dict(resolved(composed)["data"])
    split = prepare_data(small_policy("pi05"), data, seed=0, say=lambda line: None)
    steps = range(0 if split.val is None else len(split.val))
    assert {split.val.locate(i)[:2] for i in steps} == held_out


def test_hashed_splits_are_stable_and_of_the_requested_size() -> None:
    class Named:
        name = "robomme"

        def __len__(self) -> int:
            return 1600

    split = split_episodes([Named()], val_fraction=0.05)  # type: ignore[list-item]
    assert 50 < len(split.val[0]) < 110 and len(split.train[0]) + len(split.val[0]) == 1600
    again = split_episodes([Named()], val_fraction=0.1)  # type: ignore[list-item]
    assert set(split.val[0]) < set(again.val[0])


def test_impossible_splits_are_refused(data) -> None:
    for options, message in (
        ({"val_episodes": ["Gamma/0"]}, "names Gamma, but the sources are Alpha, Beta"),
        ({"val_episodes": ["Beta/1"]}, r"\[1\] of Beta, which has episodes 0…0"),
        ({"val_episodes": [1]}, "several sources"),
        ({"val_fraction": 1.0}, "must lie in"),
        ({"val_episodes": ["Alpha/0", "Alpha/1", "Beta/0"]}, "no episode to train on"),
    ):
        with pytest.raises(UserError, match=message):
            split_episodes(data[0], **options)


@pytest.mark.parametrize("offset", [0, 1])
def test_full_chunks_alone_are_full_whatever_the_offset(data, processor, monkeypatch, offset):
    monkeypatch.setattr(Processor, "samples", SampleSpec(full_chunks_only=True))
    dataset = TrainingDataset(data[0], processor, action_offset=offset)
    steps = [dataset.step(index) for index in range(len(dataset))]
    # Of 30 frames, six of them of the video; the other episodes are shorter than a chunk.
    assert [step.index for step in steps] == list(range(6, 30 - 20 - offset + 1))
    assert all(step.recorded.all() for step in steps)


def test_full_chunks_of_motions_count_motions_not_the_decisions_that_were_rendered(
    tmp_path: Path, monkeypatch
) -> None:
    """Recorded at every second decision, an episode keeps the motions of them all."""
    path = tmp_path / "record_dataset_Alpha.h5"
    write_file(path, [40], poses=True)
    convert(list_episodes([path]), tmp_path / "Alpha", PNG)
    robot = robomme_robot("robomme_waypoint", "embodiment.action.horizon=4")
    source = EpisodeSource(tmp_path / "Alpha", robot=robot)
    everywhere = source.decisions(0).tolist()
    stats = compute_norm_stats([source], horizon=4, robot=robot)
    processor = Processor(28, Tokenizer.load("sample"), stats=stats, embodiment=robot)
    rendered = np.isin(np.arange(40), everywhere[::2])
    monkeypatch.setattr(source, "_rendered", dict.fromkeys(source.columns, rendered))
    monkeypatch.setattr(Processor, "samples", SampleSpec(full_chunks_only=True))
    data = TrainingDataset([source], processor)
    steps = [data.step(index) for index in range(len(data))]
    full = everywhere[: len(everywhere) - 3]
    assert [step.index for step in steps] == full[::2] and len(full) < len(everywhere)
    assert all(step.recorded.all() for step in steps)
