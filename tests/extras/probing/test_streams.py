"""Interventions on the stream: what a server is sent under each arm, beside the plain run."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers import REPOSITORY
from helpers.probe_fakes import MadeUpSource, made_up
from helpers.rollout_fakes import quick_policy, use_inline_envs
from helpers.scripted_env import make_moving_env
from mme_vla import UserError
from mme_vla.embodiment import ROBOMME_JOINT
from mme_vla.envs.vector.pool import Job
from mme_vla.evaluation.rollout.evaluation import RunOptions, facts_of
from mme_vla.evaluation.rollout.settings import RolloutSettings
from mme_vla.extras.probing.arms import read_arm
from mme_vla.extras.probing.probed import ProbedPolicy
from mme_vla.extras.probing.recordings import all_recordings
from mme_vla.extras.probing.run import ProbePlan, run_probe
from mme_vla.extras.probing.settings import OfflineSettings
from mme_vla.policy.base import Policy
from mme_vla.policy.episode import Episode
from mme_vla.serving.remote.policy import RemotePolicy
from mme_vla.serving.remote.settings import ConnectionSettings, ServerChoice

VIDEO = 5  # frames, of PatternLock
JOB = Job("PatternLock", "test", 0)


@pytest.fixture
def stubs(monkeypatch: pytest.MonkeyPatch) -> Any:
    use_inline_envs(monkeypatch)
    monkeypatch.syspath_prepend(REPOSITORY / "examples" / "servers")
    import stub_servers

    return stub_servers


def probe(policy: Policy, folder: Path, arms: list[str], **plan: Any) -> Any:
    """The arms in closed loop, on one scene of two chunks."""
    settings = RolloutSettings(max_steps=24, workers=1, max_batch=1)
    facts = facts_of(policy, None, None, settings, None)
    options = RunOptions(base=make_moving_env, show_progress=False)
    whole = ProbePlan(arms, lend=made_up(), jobs=[JOB], **plan)
    return run_probe(policy, whole, folder, facts, settings, options)


def numbers(request: dict[str, Any]) -> list[int]:
    """Which frames of the episode a request shows: their brightness says it. A donor's frames lack
    the square at the joints' place, and are −1.
    """
    shown = []
    for image in request["front_rgb_list"]:
        is_donor = image[0, 9, 0] == image[-1, -1, 0]
        shown.append(-1 if is_donor else int(image[-1, -1, 0]) // 7)
    return shown


def sent(stubs: Any, folder: Path, arm: str) -> tuple[list[list[int]], list[dict[str, Any]]]:
    """The frames of each request of an episode under an arm, and the requests."""
    stub = stubs.Stub()
    with stubs.serving("challenge", stub) as url:
        choice = ServerChoice(url, "challenge", ConnectionSettings(timeout_s=5, open_s=2))
        policy = RemotePolicy(choice, ROBOMME_JOINT)
        probe(policy, folder, [arm])
        policy.close()
    requests = [request for request in stub.requests if "task_goal" in request]
    plain = [numbers(request) for request in requests[:2]]
    assert plain == [list(range(VIDEO + 1)), list(range(VIDEO + 1, VIDEO + 17))]
    return [numbers(request) for request in requests[2:]], requests[2:]


FIRST, SECOND = list(range(VIDEO + 1)), list(range(VIDEO + 1, VIDEO + 17))
OTHER = [-1] * 60  # an episode of the donors


@pytest.mark.parametrize(
    ("arm", "frames"),
    [
        ("nodemo", [[5], SECOND]),
        ("forget", [[5], [21]]),
        ("replay", [FIRST, FIRST + SECOND]),
        ("linger:2", [[*FIRST, 5, 5], [*SECOND, 21, 21]]),
        ("late:3", [FIRST, [5, 5, 5, *range(6, 19)]]),
        ("late:20", [FIRST, [5] * 16]),
        ("drop_frames:0.5", [[0, 2, 4, 5], [*range(6, 22, 2), 21]]),
        ("pause:3", [[*FIRST, 5, 5, 5], SECOND]),
        ("swap_frames", [[-1] * 5 + [5], [-1] * 15 + [21]]),
        ("nodemo+linger:1", [[5, 5], [*SECOND, 21]]),
        ("forget+late:3", [[5], [18]]),
        ("late:3+forget", [[5], [18]]),
        ("distract:1+replay", [[*OTHER, *FIRST], [*OTHER, *FIRST, *SECOND]]),
        ("distract:1+forget", [[*OTHER, 5], [*OTHER, 21]]),
    ],
)
def test_a_server_is_sent_what_the_arm_says(
    arm: str, frames: list[list[int]], stubs: Any, tmp_path: Path
) -> None:
    assert sent(stubs, tmp_path, arm)[0] == frames


def test_shuffled_frames_are_the_same_frames_and_the_current_one_stays(
    stubs: Any, tmp_path: Path
) -> None:
    frames, _ = sent(stubs, tmp_path, "shuffle_frames")
    assert frames[0] != FIRST and frames[1] != SECOND
    assert sorted(frames[0][:-1]) == FIRST[:-1] and frames[0][-1] == FIRST[-1]
    assert sorted(frames[1][:-1]) == SECOND[:-1] and frames[1][-1] == SECOND[-1]


def test_the_goal_of_another_episode_and_a_state_that_stays(stubs: Any, tmp_path: Path) -> None:
    frames, requests = sent(stubs, tmp_path / "goal", "goal_swap")
    assert frames == [FIRST, SECOND]
    assert {request["task_goal"][0] for request in requests} <= {
        f"pick up the cube number {episode}" for episode in range(3)
    }
    _, moving = sent(stubs, tmp_path / "moving", "linger:1")
    _, frozen = sent(stubs, tmp_path / "frozen", "freeze_state")
    start = frozen[0]["joint_state_list"][-1]
    assert all(np.array_equal(state, start) for state in frozen[1]["joint_state_list"])
    assert len(moving) == len(frozen)


def test_an_episode_that_begins_anew_does_so_on_the_server(stubs: Any, tmp_path: Path) -> None:
    _, requests = sent(stubs, tmp_path, "forget")
    assert [request["is_first_step"] for request in requests] == [True, True]
    _, requests = sent(stubs, tmp_path / "other", "late:3")
    assert [request["is_first_step"] for request in requests] == [True, False]


@pytest.mark.parametrize("arm", ["replay", "shuffle_frames", "swap_frames", "forget"])
def test_a_policy_that_is_loaded_here_takes_the_same_arms(
    arm: str, stubs: Any, tmp_path: Path
) -> None:
    policy = quick_policy("framesamp_modul", 8).eval()
    result = probe(policy, tmp_path, [arm])
    (comparison,) = result.comparisons
    assert comparison.episodes == 1
    records = {path.parent.name: path.read_text() for path in tmp_path.rglob("episodes.jsonl")}
    digests = {name: text.split('"actions_sha256":"')[1][:16] for name, text in records.items()}
    # All frames are shown again: a memory of frames acts alike. Anything else changes it.
    assert (digests[arm] == digests["unprobed"]) == (arm == "replay")


@pytest.mark.parametrize(
    ("arm", "expected"),
    [
        ("replay", [(5, None), (8, [1.0]), (10, [1.0, 2.0])]),
        ("forget", [(1, None), (1, None), (1, None)]),
        ("linger:2", [(7, None), (5, [1.0]), (4, [2.0])]),
    ],
)
def test_motions_of_any_length_come_with_the_frames_at_their_end(
    arm: str, expected: list[tuple[int, list[float] | None]], monkeypatch: pytest.MonkeyPatch
) -> None:
    policy = quick_policy("framesamp_modul", 8, embodiment="robomme_choice_front").eval()
    observed = []

    def note(
        episode: Episode, frames: Any, states: np.ndarray, demo: Any, actions: Any = None
    ) -> None:
        first_numbers = None
        if actions is not None:
            first_numbers = actions[:, 0].tolist()
        observed.append((len(states), first_numbers))

    monkeypatch.setattr(Episode, "observe", note)
    episode = ProbedPolicy(policy, read_arm(arm)).start_episode("pick up the cube")
    for number, count in enumerate((5, 3, 2)):
        demo = np.zeros(count, bool)
        actions = np.full((1, 10), float(number))
        if number == 0:
            demo[:4] = True
            actions = None
        images = {"front": np.zeros((count, 64, 64, 3), np.uint8)}
        episode.observe(images, np.zeros((count, 8), np.float32), demo, actions)
        episode.show_collected()
    assert observed == expected


def test_late_images_are_of_the_execution_where_frames_are_left_out(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    policy = quick_policy("framesamp_modul", 8).eval()
    pixels: list[list[int]] = []

    def note(episode: Episode, frames: Any, *_: Any) -> None:
        pixels.append(frames["front"][:, 0, 0, 0].tolist())

    monkeypatch.setattr(Episode, "observe", note)
    arm = read_arm("drop_frames:0.5+late:20")
    episode = ProbedPolicy(policy, arm).start_episode("pick up the cube")
    for start, stop in ((0, 11), (11, 19), (19, 27)):
        numbers = np.arange(start, stop, dtype=np.uint8)
        view = np.broadcast_to(numbers[:, None, None, None], (len(numbers), 64, 64, 3))
        states = np.zeros((len(numbers), 8), np.float32)
        episode.observe({"front": view, "wrist": view}, states, numbers < 10)
        episode.show_collected()
    assert pixels[0] == [0, 2, 4, 6, 8, 10]
    assert {*pixels[1], *pixels[2]} == {10}


def test_what_acts_in_episodes_is_not_probed_at_recorded_steps(stubs: Any, tmp_path: Path) -> None:
    policy = quick_policy("framesamp_modul", 8).eval()
    offline = OfflineSettings(1, 2, 1, False, 2)
    settings = RolloutSettings(max_steps=24, workers=1, max_batch=1)
    facts = facts_of(policy, None, None, settings, None)
    plan = ProbePlan(["forget"], made_up()[:1], made_up(), offline=offline)
    with pytest.raises(UserError, match="with=forget acts in closed loop: set online=true"):
        run_probe(policy, plan, tmp_path, facts, settings, RunOptions(show_progress=False))


def test_goals_are_exchanged_only_where_they_differ(stubs: Any, tmp_path: Path) -> None:
    class OneGoal(MadeUpSource):
        def goal(self, episode: int) -> str:
            return "pick up the red cube"

    policy = quick_policy("pi05", 8).eval()
    settings = RolloutSettings(max_steps=24, workers=1, max_batch=1)
    facts = facts_of(policy, None, None, settings, None)
    plan = ProbePlan(["goal_swap"], lend=all_recordings([OneGoal()]), jobs=[JOB])
    options = RunOptions(base=make_moving_env, show_progress=False)
    with pytest.raises(UserError, match="recorded episodes with several goals"):
        run_probe(policy, plan, tmp_path, facts, settings, options)
