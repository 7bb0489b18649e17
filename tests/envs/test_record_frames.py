"""Demonstrations rendered at a list of frames: which these are, what is stored, and which memories
may read it.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from omegaconf import OmegaConf

pytest.importorskip("mani_skill", reason="needs the simulator: uv sync --inexact --extra sim")

from mme_vla.cli.record import record_episode
from mme_vla.config.composition import compose
from mme_vla.data.convert import ConvertOptions, convert
from mme_vla.data.episodes import EpisodeSource
from mme_vla.data.hdf5 import EpisodeRef, open_episode
from mme_vla.embodiment import Embodiment
from mme_vla.envs.make import make_task
from mme_vla.envs.observations import RenderRequest
from mme_vla.envs.robomme.recording.frames import FrameChoice
from mme_vla.envs.robomme.recording.outputs import Job
from mme_vla.envs.robomme.recording.recorder import RecordedStep, Recorder
from mme_vla.errors import UserError

POSES = [np.full(7, float(i), np.float32) for i in range(3)]


def step(
    video: bool, waypoint: np.ndarray, begins: bool = False, completed: bool = False
) -> RecordedStep:
    action = {
        "waypoint_action": waypoint,
        "eef_action": POSES[2],
        "choice_action": '{"choice": "B", "point": []}',
    }
    return RecordedStep(
        {},
        action,
        {"is_video_demo": video, "is_subgoal_boundary": begins, "is_completed": completed},
    )


STEPS = [
    *[step(True, POSES[2])] * 20,
    *[step(False, POSES[0], begins=k in (0, 16)) for k in range(30)],
    *[step(False, POSES[1], begins=k in (5, 8), completed=k >= 8) for k in range(10)],
]


@pytest.mark.parametrize(
    ("choice", "front", "wrist"),
    [
        (FrameChoice("decisions"), [20, 49], [20, 49]),
        (FrameChoice("choices"), [20, 35, 54], [20, 35, 54]),
        (FrameChoice(16), [20, 36, 52], [20, 36, 52]),
        (FrameChoice(["0-2", 59, "70-80"]), [0, 1, 2, 59], [0, 1, 2, 59]),
        (
            FrameChoice("decisions", {"name": "tokendrop", "stride": 16}),
            [0, 15, 20, 31, 47, 49], [20, 49],
        ),
        (
            FrameChoice([40], {"name": "framesamp", "budget": 64}),
            [0, 13, 26, 40], [40],
        ),
        (
            FrameChoice([52], {"name": "ttt"}),
            [0, 8, 16, 20, 36, 52], [52],
        ),
    ],
)  # fmt: skip
def test_a_choice_says_what_each_camera_shows(
    choice: FrameChoice, front: list[int], wrist: list[int]
) -> None:
    render_request = choice.render_request(STEPS)
    selection = {
        name: [k for k in range(len(STEPS)) if name in render_request.cameras(k, False)]
        for name in ("front", "wrist")
    }
    assert selection == {"front": front, "wrist": wrist}


@pytest.mark.parametrize(
    ("at", "memory"),
    [("decision", None), (0, None), (True, None), (["5-3"], None), (4, {"name": "framesam"})],
)
def test_what_is_no_choice_of_frames_is_refused(at: Any, memory: Any) -> None:
    with pytest.raises(UserError, match=r"frames=|Did you mean 'framesamp'"):
        FrameChoice(at, memory)


@pytest.fixture(scope="module")
def recorded(renderer: str, tmp_path_factory: pytest.TempPathFactory) -> EpisodeRef:
    """The shortest demonstration, rendered at its decisions and at the frames that the memory then
    reads.
    """
    folder = tmp_path_factory.mktemp("frames")
    choice = FrameChoice("decisions", {"name": "framesamp", "budget": 64})
    job = Job("PatternLock", 0, seed=0, difficulty="easy", recovery=None, retries=3, frames=choice)
    record_episode(job, folder)
    return EpisodeRef(folder / f"{job.name}.h5", 0, "PatternLock")


def test_what_is_rendered_is_what_a_full_recording_shows(recorded: EpisodeRef) -> None:
    with open_episode(recorded) as episode:
        frames, rendered, seed, choice = (
            list(episode),
            episode.rendered,
            episode.seed,
            episode.frames,
        )
        with pytest.raises(
            UserError, match=r"front was not rendered at step 1; .* frames=decisions"
        ):
            episode.front(1)
    assert choice == {"at": "decisions", "memory": {"name": "framesamp", "budget": 64}}
    # What of a whole recording is compared, and the steps before, whose images these would be if
    # any were stale.
    more = {
        int(k) + d for steps in rendered.values() for k in np.flatnonzero(steps) for d in (-1, 0)
    }
    task = make_task("PatternLock", render=True, seed=seed, difficulty="easy")
    reference = (
        Recorder(task, render_request=RenderRequest({"front": more, "wrist": more})).record().frames
    )
    task.close()
    assert len(frames) == len(reference)
    assert 0 < rendered["wrist"].sum() < rendered["front"].sum() < len(frames)
    for frame, full, k in zip(frames, reference, range(len(reference)), strict=True):
        assert np.array_equal(frame.state[:7], full.obs["joint_state"])
        assert np.array_equal(frame.action[:7], full.action["joint_action"][:7])
        assert (
            frame.subgoals["grounded_subgoal_online"]
            == full.info["grounded_subgoal_online"].lower()
        )
        for camera in ("front", "wrist"):
            assert rendered[camera][k] == (camera in frame.rendered)
            if rendered[camera][k]:
                assert np.array_equal(getattr(frame, camera), full.obs[f"{camera}_rgb"])


@pytest.mark.slow
def test_a_dataset_of_it_is_read_where_it_was_rendered_and_nowhere_else(
    recorded: EpisodeRef, tmp_path: Path
) -> None:
    convert([recorded], tmp_path / "data", ConvertOptions())
    section: Any = OmegaConf.to_container(
        compose("policy", ["embodiment=robomme_waypoint"]).embodiment, resolve=True
    )
    waypoints = EpisodeSource(tmp_path / "data", robot=Embodiment.from_dict(section))
    joints = EpisodeSource(tmp_path / "data")
    rendered = joints.rendered(0, "wrist")
    assert (
        list(waypoints.decisions(0))
        == list(joints.decisions(0))
        == np.flatnonzero(rendered).tolist()
    )
    with open_episode(recorded) as episode:
        first = int(np.flatnonzero(rendered)[0])
        assert np.abs(joints.frames(0, [first])[0].astype(int) - episode.front(first)).max() <= 3
    unseen = int(np.flatnonzero(~joints.rendered(0))[0])
    with pytest.raises(UserError, match=rf"front was not rendered at frames \[{unseen}\]"):
        joints.frames(0, [first, unseen])
