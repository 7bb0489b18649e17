"""Rollouts render what is read, and nothing changes: actions and outcomes are those of rendering
everything.
"""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from helpers.rollout_fakes import InlineEnvs, quick_policy, roll
from helpers.scripted_env import VIDEO
from helpers.union_frames import JOBS, STEPS, WatchedEnv, both_ways, make_watched_env, outcomes
from mme_vla import UserError
from mme_vla.evaluation.rollout.running import LONGEST_MOTION, RenderPlan
from mme_vla.evaluation.rollout.settings import RolloutSettings
from mme_vla.subgoal import SubgoalPredictor
from mme_vla.subgoal.background import BackgroundPredictor
from mme_vla.subgoal.base import Subgoal, SubgoalEpisode

FRAMES = [VIDEO[JOBS[0].task] + 1 + STEPS, 1 + STEPS]
MEMORIES: dict[str, dict[str, Any]] = {
    "pi05": {},
    "framesamp_modul": {"memory": {"budget": 64}},
    "tokendrop_expert": {"memory": {"budget": 64}},
    "ttt_context": {},
    "framesamp_ttt_modul": {},
}


@pytest.mark.slow
@pytest.mark.parametrize("name", MEMORIES)
def test_rendering_what_is_needed_changes_no_action(name: str) -> None:
    policy = quick_policy(name, patch_size=8 if name != "pi05" else 16, **MEMORIES[name])
    *everything, video, full = both_ways(policy)
    assert everything == [{"front": n, "wrist": n} for n in FRAMES]
    chunks = -(-STEPS // 16)
    last = STEPS % 16 > 0  # the step limit cuts the last chunk short: no policy acts on its end
    assert video["wrist"] == full["wrist"] == 1 + chunks - last
    memory = policy.memory
    if memory is None:
        assert video["front"] == full["front"] == full["wrist"]
    else:
        assert full["front"] < FRAMES[1] and video["front"] < FRAMES[0]


@pytest.mark.parametrize("name", ["present_modul", "ttt_modul", "moment_modul"])
def test_of_a_robot_that_acts_at_any_frame_few_past_frames_are_rendered(name: str) -> None:
    memory = {} if name == "present_modul" else {"every": 16}
    policy = quick_policy(name, patch_size=8, embodiment="robomme_choice_front", memory=memory)
    plan = RenderPlan(policy, None, RolloutSettings.from_config({"max_steps": 100}))
    stored = [] if name == "present_modul" else [0, *range(15, 1999, 16)]
    before = plan.before_video()
    assert before is not None and sorted(before.frames["front"]) == stored  # type: ignore[type-var]
    frames: dict[str, Any] = {"state": np.zeros((41, 8))}
    images = [None if number not in stored else np.zeros(1) for number in range(41)]
    assert plan.missing({**frames, "front": images}) is None, "the video is simulated once"
    running = SimpleNamespace(
        episode=SimpleNamespace(n_observed_frames=41), video_frames=40, unobserved=0
    )
    chunk = plan.of_chunk(running, 1)  # type: ignore[arg-type]
    assert chunk is not None and sorted(chunk.frames["front"]) == [
        f for f in stored if 41 <= f < 140 + LONGEST_MOTION
    ]  # type: ignore[type-var]
    assert chunk.now == ("front",), (
        "the frame that the policy acts on is rendered, whatever its number"
    )


class Watcher(SubgoalPredictor):
    """Says the brightness of all that it has seen, and so needs every frame of the front camera."""

    def start_episode(
        self, goal: str, video: np.ndarray | None = None, task: str = ""
    ) -> SubgoalEpisode:
        episode = Watching(goal, video, task)
        episode.total = int(episode.video.astype(np.int64).sum())
        return episode

    def predict_due(self, episodes: Any) -> list[Subgoal]:
        return [Subgoal(f"total {episode.total}", queried=True) for episode in episodes]


class Watching(SubgoalEpisode):
    total = 0

    def observe(self, frames: np.ndarray, info: Any = None) -> None:
        super().observe(frames, info)
        self.total += int(frames.astype(np.int64).sum())


def test_a_predictor_that_watches_gets_every_frame_of_its_camera() -> None:
    policy = quick_policy("simplesg")
    *_, video, full = both_ways(policy, Watcher("simple"))
    # Of the last chunk, which the step limit cuts short, nothing more is asked than of others.
    assert (video["front"], full["front"]) == tuple(FRAMES)
    assert video["wrist"] == full["wrist"] == 5


class Glancer(Watcher):
    """Reads the current image alone."""

    sees_video = sees_passing = False

    def start_episode(
        self, goal: str, video: np.ndarray | None = None, task: str = ""
    ) -> SubgoalEpisode:
        assert video is None
        return SubgoalEpisode(goal, video, task)

    def predict_due(self, episodes: Any) -> list[Subgoal]:
        return [
            Subgoal(f"{e.step} {int(e.frame.astype(np.int64).sum())}", queried=True)
            for e in episodes
        ]


@pytest.mark.parametrize("background", [False, True])
def test_a_predictor_that_reads_the_present_counts_the_frames_that_passed(background: bool) -> None:
    predictor = Glancer("simple")
    both_ways(quick_policy("simplesg"), BackgroundPredictor(predictor) if background else predictor)


def test_a_video_shows_everything_and_changes_nothing(tmp_path: Path) -> None:
    policy = quick_policy("rmt_modul", patch_size=8)
    bare = roll(
        policy, JOBS, InlineEnvs(base=make_watched_env, max_steps=STEPS - 1), max_steps=STEPS - 1
    )
    envs = InlineEnvs(base=make_watched_env, max_steps=STEPS - 1, videos=(str(tmp_path), "all"))
    recorded = roll(policy, JOBS, envs, max_steps=STEPS - 1)
    assert outcomes(recorded) == outcomes(bare)
    assert {job: env.rendered for job, env in envs.made.items()} == {
        job: {"front": n, "wrist": n} for job, n in zip(JOBS, FRAMES, strict=True)
    }
    assert all((tmp_path / record.video).stat().st_size for record in recorded)


def test_an_environment_that_does_not_repeat_its_video_is_refused() -> None:
    lengths = iter(range(5, 99))

    class Moody(WatchedEnv):
        def reset(self) -> Any:
            return self._lists([self._frame() for _ in range(next(lengths))]), self._info("ongoing")

    envs = InlineEnvs(
        base=lambda task, split, episode, max_steps: Moody(task, episode, max_steps, 1e9, 0.0, "")
    )
    with pytest.raises(UserError, match=r"video had 4 frames, and 5 when"):
        roll(quick_policy("framesamp_modul", patch_size=8, memory={"budget": 64}), JOBS[:1], envs)


def test_acting_on_a_frame_that_was_not_rendered_is_refused() -> None:
    policy = quick_policy("pi05")
    episode = policy.start_episode("pick up the cube")
    images = np.zeros((1, 64, 64, 3), np.uint8)
    rendered = {"front": np.array([0]), "wrist": np.array([0])}
    episode.observe(
        {"front": images, "wrist": images}, np.zeros((3, 8), np.float32), rendered=rendered
    )
    assert episode.n_observed_frames == 3
    with pytest.raises(UserError, match="current frame was not rendered"):
        policy.act(episode)
