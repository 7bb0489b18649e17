"""The embedded sample: small, complete, and what its README says."""

from pathlib import Path

import numpy as np
import pytest

from mme_vla.cli.sample import EPISODES
from mme_vla.data.episodes import EpisodeSource
from mme_vla.data.hdf5 import EpisodeRef, RawEpisode, open_episode


def test_the_sample_holds_four_real_demonstrations() -> None:
    source = EpisodeSource("sample")
    assert source.video_cameras == ("front", "wrist") and source.fps == 20
    assert [source.task(e) for e in range(4)] == [
        "VideoUnmask",
        "PatternLock",
        "PickXtimes",
        "VideoUnmask",
    ]
    assert source.lengths.tolist() == [173, 148, 332, 263] and source.exec_starts.tolist() == [
        66,
        74,
        0,
        66,
    ]
    assert source.frames(0, [0, 172], "wrist").shape == (2, 256, 256, 3)


def test_the_first_episode_has_a_separate_image_wherever_something_changed(shared: Path) -> None:
    source = EpisodeSource("sample")
    with open_episode(
        EpisodeRef(shared / "robomme_h5_full/record_dataset_VideoUnmask.h5", 6, "VideoUnmask")
    ) as raw:
        recorded = np.stack([raw.front(k) for k in range(raw.length)])
    stored = source.frames(0, np.arange(173))
    changed = (recorded[1:] != recorded[:-1]).any(axis=(1, 2, 3))
    assert np.array_equal((stored[1:] != stored[:-1]).any(axis=(1, 2, 3)), changed)
    assert np.abs(stored.astype(np.int16) - recorded).mean() < 4  # colours at half resolution


def test_the_sample_equals_the_recorded_episodes(
    shared: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # reading them takes its time; see above
    monkeypatch.setattr(RawEpisode, "_image", lambda *_: None)
    source = EpisodeSource("sample")
    folders = {"full": shared / "robomme_h5_full", "thinned": shared / "robomme_h5"}
    for e, (folder, task, number) in enumerate(EPISODES):
        ref = EpisodeRef(folders[folder] / f"record_dataset_{task}.h5", number, task)
        with open_episode(ref) as raw:
            frames = list(raw)
            assert source.goal(e) == raw.goals[0] and source.exec_starts[e] == raw.exec_start
        assert np.array_equal(source.states(e), np.stack([frame.state for frame in frames]))
        assert np.array_equal(
            source.actions(e), np.stack([frame.action for frame in frames]).astype(np.float32)
        )
        assert source.subgoals(e, 100) == frames[100].subgoals
