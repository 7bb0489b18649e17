"""History transforms: one map of frames that training and probes share."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from helpers.memory_fakes import LastFrames, encode, same
from helpers.nano_policies import demonstration, nano
from helpers.probe_fakes import probed, reader
from mme_vla import Perturbation, UserError, register
from mme_vla.data.cache import VisionCache
from mme_vla.data.cache_building import ensure_cache
from mme_vla.data.dataset import TrainingDataset
from mme_vla.data.sources import open_sources
from mme_vla.data.statistics import compute_norm_stats
from mme_vla.extras.methods.memoryvla.groups import GroupDataset
from mme_vla.extras.nano.learning import Decisions, statistics
from mme_vla.extras.probing.arms import options_of, read_arm
from mme_vla.extras.probing.feed import Feed
from mme_vla.extras.probing.lines import MomentLine
from mme_vla.memory.history import CachedHistory, StorageSpec
from mme_vla.memory.perturbation import DropFrames, Noise, Pause, Speed, build_transforms
from mme_vla.memory.transforms import TransformedHistory, map_frames
from mme_vla.processing.processor import Processor
from mme_vla.processing.tokenizer import Tokenizer
from mme_vla.registry import PERTURBATIONS

EVERY = [Pause(16), Speed(2.0), DropFrames(0.5)]


@pytest.mark.parametrize("transform", EVERY)
def test_a_map_is_ascending_and_ends_at_the_current_frame(transform: Perturbation) -> None:
    for seed in range(20):
        rng = np.random.default_rng(seed)
        visible = map_frames([transform], 40, 10, rng, keep=[39])
        assert (np.diff(visible.real) >= 0).all() and visible.real[-1] == 39
        assert (visible.real[: visible.exec_start] < 10).all() and visible.real[
            visible.exec_start
        ] >= 10
        again = map_frames([transform], 40, 10, np.random.default_rng(seed), keep=[39])
        assert np.array_equal(visible.real, again.real)


@pytest.mark.parametrize("transform", [*EVERY, Speed(0.5)])
def test_in_a_probe_no_frame_depends_on_a_later_one(transform: Perturbation) -> None:
    full = map_frames([transform], 60, 10).real
    for length in (12, 33, 59):
        part = map_frames([transform], length, 10).real
        assert np.array_equal(part, full[full < length])


def test_transforms_have_the_lengths_they_say() -> None:
    assert len(map_frames([Pause(16)], 40, 10).real) == 56
    assert (
        len(map_frames([Speed(2.0)], 40, 0).real) == 20
        and len(map_frames([Speed(0.5)], 40, 0).real) == 80
    )
    assert len(map_frames([DropFrames(0.25)], 40, 0).real) == 30
    assert len(map_frames([Speed(2.0), Pause(16)], 40, 0).real) == 36
    assert len(map_frames([Pause(16, p=0.0)], 40, 10, np.random.default_rng(0)).real) == 40


def test_a_feed_shows_frames_as_the_map_does() -> None:
    feed = Feed((Pause(8, 2), Speed(2.0)))
    real = map_frames(feed.perturbations, 50, 5).real
    assert np.array_equal(np.repeat(np.arange(50), feed.repeats(np.arange(50), 5)), real)
    last = feed.displayed(np.arange(50), 5)
    assert all(real[n] == frame for frame, n in enumerate(last) if n >= 0) and (
        last >= 0
    ).sum() == len(set(real))
    assert feed.source_frames(np.arange(20), 5).tolist() == sorted(set(real[:20].tolist()))
    assert np.array_equal(Feed().repeats(np.arange(9), 3), np.ones(9))


def test_a_frame_without_tokens_is_replaced_by_the_newest_stored_one_before_it() -> None:
    spec, stored = StorageSpec(1, keep_every=4), np.array([0, 3, 7, 11])
    tokens = stored[:, None, None].astype(np.float32)
    visible = map_frames([Speed(0.5)], 12, 0)
    history = TransformedHistory(CachedHistory(spec, tokens, stored, 12), visible)
    frames = np.array([0, 7, 13, 15])
    assert visible.real[frames].tolist() == [0, 3, 6, 7]
    assert history.gather(np.stack([frames, np.zeros(4, int)], 1))[:, 0].tolist() == [0, 3, 3, 7]


def test_noise_perturbs_by_its_share_of_the_deviation() -> None:
    rows = torch.randn(400, 8, generator=torch.Generator().manual_seed(0)) * 3
    noise = Noise(0.1).perturb(rows, np.random.default_rng(0)) - rows
    assert float(noise.std()) == pytest.approx(0.3, rel=0.1)


def test_entries_that_are_no_transforms_are_reported() -> None:
    assert build_transforms(["repeat_frame", {"name": "speed", "factor": 4}]) == (
        Pause(),
        Speed(4),
    )
    for entries, words in (
        ("speed", "a list of names"),
        (["sped"], "Did you mean 'speed'"),
        ([{"factor": 2}], "name"),
        ([{"name": "speed", "factor": 99}], "factor=99"),
    ):
        with pytest.raises(UserError, match=words):
            build_transforms(entries)


def test_what_is_no_perturbation_is_refused_by_name() -> None:
    register("perturbation", "a_function")(lambda: None)
    with pytest.raises(UserError, match="a_function must be a class that derives from"):
        build_transforms(["a_function"])


def test_a_pause_is_written_by_the_name_that_a_probe_was_given() -> None:
    (repeated,) = options_of(read_arm("repeat_frame:16"))
    assert repeated == {"intervention": "RepeatFrame", "frames": 16, "at": None, "p": 1.0}
    (paused,) = options_of(read_arm("pause:16"))
    assert paused == {"intervention": "Pause", "frames": 16, "at": 0}


def test_a_transform_that_returns_too_few_numbers_is_reported() -> None:
    class Short(Perturbation):
        def repeats(
            self, length: int, exec_start: int, rng: np.random.Generator | None = None
        ) -> np.ndarray:
            return np.ones(2, np.int64)

    with pytest.raises(UserError, match="for each of 9 frames"):
        map_frames([Short()], 9, 0)


@pytest.fixture(scope="module")
def sample(tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, Processor, list[VisionCache]]:
    sources = open_sources(["sample"])
    processor = Processor(
        image_size=28, tokenizer=Tokenizer.load("sample"), stats=compute_norm_stats(sources)
    )
    root = tmp_path_factory.mktemp("caches")
    return (
        sources,
        processor,
        [ensure_cache(sources[0], LastFrames(), encode, "abc", root=root, dtype="float32")],
    )


def test_samples_are_transformed_by_seed_epoch_and_index(sample: Any) -> None:
    sources, processor, caches = sample
    base = TrainingDataset(sources, processor, LastFrames(), caches)
    changed = TrainingDataset(
        sources, processor, LastFrames(), caches, transforms=[Pause(32, p=1.0)]
    )
    items = [changed[60], changed[60]]
    assert same(*items) and not same(items[0]["history"], base[60]["history"])
    assert int(items[0]["history"].step) > int(base[60]["history"].step)
    for key in ("images", "state", "actions", "prompt"):
        if key in items[0]:
            assert torch.equal(items[0][key], base[60][key]), key
    changed.set_epoch(1)
    assert not same(changed[60]["history"], items[0]["history"])
    assert same(changed.observation(60), base.observation(60)), (
        "what a policy meets when acting is not transformed"
    )
    nothing = TrainingDataset(sources, processor, LastFrames(), caches, transforms=[Pause(0)])
    assert same(nothing[60]["history"], base[60]["history"])


def test_past_actions_go_through_the_map(sample: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """A repeated frame repeats the action that led to it, as in a probe."""
    sources, processor, caches = sample
    data = TrainingDataset(sources, processor, LastFrames(), caches)
    step = data.step(20)
    start, now = step.exec_start, step.index
    # Every action another one, so that each is told from its neighbours.
    numbers = np.arange(sources[0].lengths[step.episode], dtype=np.float32)
    monkeypatch.setattr(sources[0], "actions", lambda e, a, b: numbers[a:b, None])
    monkeypatch.setattr(Processor, "prompt_spec", replace(processor.prompt_spec, past_actions=4))

    def past(*transforms: Perturbation) -> list[int]:
        visible = map_frames(transforms, now + 1, start, keep=[now])
        return data.past_actions(step, visible)[:, 0].astype(int).tolist()

    assert past() == [now - 4, now - 3, now - 2, now - 1]
    assert past(Pause(2, now - start - 1)) == [now - 2, now - 2, now - 2, now - 1]
    assert past(Pause(5, now - start)) == [now - 1] * 4, "not the action that is to be predicted"
    assert past(Pause(5, 0)) == past()
    later = TrainingDataset(sources, processor, LastFrames(), caches, action_offset=1)
    visible = map_frames([Pause(5, now - start)], now + 1, start, keep=[now])
    assert later.past_actions(step, visible)[:, 0].tolist() == [now] * 4
    # No action led to the first frame of the execution, however long it is shown.
    step, now = data.step(1), start + 1
    assert past(Pause(5, 0)) == [start]


def test_the_times_of_a_group_are_transformed(sample: Any) -> None:
    sources, processor, caches = sample
    groups = [
        GroupDataset(sources, processor, LastFrames(), caches, group_size=4, transforms=t)
        for t in ((), [Speed(0.5)])
    ]
    base, slow = (group[1] for group in groups)
    assert base["place"] == slow["place"] and (slow["times"] >= base["times"]).all()
    assert slow["times"][-1] > base["times"][-1]
    assert [int(m["history"].step) for m in slow["moments"]] == slow["times"].tolist()


def test_nano_redraws_histories_each_epoch() -> None:
    policy, made = nano().eval(), demonstration()
    policy.require_processor().stats = statistics([made], policy)
    base = Decisions.of(policy, [made])
    first, again = (Decisions.of(policy, [made], transforms=[Pause(32)], seed=1) for _ in range(2))
    rows = [0, 1, 2]
    one = first.collate(rows).history
    assert (
        one is not None
        and same(one, again.collate(rows).history)
        and not same(one, base.collate(rows).history)
    )
    first.set_epoch(1)
    assert not same(first.collate(rows).history, one)
    still = Decisions.of(policy, [made], transforms=[Pause(0)], seed=1)
    assert same(still.collate(rows).history, base.collate(rows).history)


def test_a_probe_applies_the_same_objects(tmp_path: Path) -> None:
    arms = [
        read_arm(word) for word in ("repeat_frame:8", "speed:2", "drop_frames:0.5", "noise:0.5")
    ]
    assert [arm.parts for arm in arms] == [
        (Pause(8),),
        (Speed(2),),
        (DropFrames(0.5),),
        (Noise(0.5),),
    ]
    assert [arm.feed.perturbations for arm in arms[2:]] == [(DropFrames(0.5),), ()]
    assert (
        read_arm("pause:8").feed.repeats(np.arange(9), 3).tolist()
        == arms[0].feed.repeats(np.arange(9), 3).tolist()
    )
    assert arms[1].dial() == 2 and options_of(arms[1]) == [{"intervention": "Speed", "factor": 2}]
    lines = probed(
        reader(2),
        ["repeat_frame:8", "speed:2", "drop_frames:0.9", "noise:0.5", "pause:8"],
        tmp_path,
    )
    moments = [line for line in lines if isinstance(line, MomentLine)]
    changes = {
        name: sum(line.change for line in moments if line.arm == name)
        for name in {m.arm for m in moments}
    }
    assert changes["speed:2"] > 0 and changes["drop_frames:0.9"] > 0 and changes["noise:0.5"] > 0, (
        changes
    )
    assert changes["repeat_frame:8"] == changes["pause:8"]


def test_a_transform_of_ones_own_is_registered() -> None:
    @register("history_transform", "still_for_a_test")
    class Still(Perturbation):
        pass

    assert PERTURBATIONS["still_for_a_test"] is Still
    assert np.array_equal(
        map_frames(build_transforms(["still_for_a_test"]), 5, 0).real, np.arange(5)
    )
