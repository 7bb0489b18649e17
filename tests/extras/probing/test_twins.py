"""Twin accuracy: policies whose answer is known, in an environment of one's own and in RoboMME."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers.planted import Planted, PlantedEpisode, Rule
from mme_vla.config.plugins import import_plugins
from mme_vla.embodiment.robomme import CHOICE_SPACE, choice_action
from mme_vla.envs import make
from mme_vla.envs.base import environment
from mme_vla.envs.facts import Candidates
from mme_vla.envs.make import make_env
from mme_vla.envs.vector.pool import Job
from mme_vla.errors import SceneError, UserError
from mme_vla.evaluation.records import RunKey
from mme_vla.evaluation.rollout.evaluation import RunOptions
from mme_vla.evaluation.rollout.settings import RolloutSettings
from mme_vla.extras.probing.arms import UNPROBED
from mme_vla.extras.probing.settings import ProbeChoice
from mme_vla.extras.probing.twins import (
    FIGURES,
    LINES,
    MEMORY_OFF,
    Decision,
    NoPairError,
    TwinLine,
    Twins,
    aggregate_twins,
    check_pair,
    nearest_candidates,
    read_twins,
    run_twins,
    share_correct,
    twin_tables,
)
from mme_vla.testing.small import small_policy

REPOSITORY = Path(__file__).parents[3]
SILENT = RunOptions(show_progress=False)
FACTS = RunKey("planted", "none", 7)
SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])


# Definitions --------------------------------------------------------------------------------------


def test_the_reached_candidate_counts_and_else_the_one_whose_distance_fell_most() -> None:
    start = np.array([-1.0, -1.0])
    assert nearest_candidates(SQUARE, start, np.array([0.9, 1.1])).tolist() == [3]
    assert nearest_candidates(SQUARE, start, np.array([-0.9, -1.0])).tolist() == [1]
    # On the way past the first corner the tool has reached the last one, which lies in line.
    assert nearest_candidates(SQUARE, start, np.array([1.2, 1.2])).tolist() == [3]


def test_a_tie_counts_by_the_share_that_is_correct() -> None:
    candidates = Candidates(SQUARE.tolist(), [3])
    middle, ahead = [0.5, -1.0], [0.5, -0.6]
    assert nearest_candidates(SQUARE, np.array(middle), np.array(ahead)).tolist() == [2, 3]
    assert share_correct(candidates, middle, ahead) == 0.5
    assert share_correct(candidates, middle, middle) == 0.25, "a tool that does not move"


def test_a_pair_differs_in_what_is_correct_alone() -> None:
    first = Decision("go", Candidates(SQUARE.tolist(), [0]), np.zeros(8), {}, [])
    other = replace(first, candidates=Candidates(SQUARE[::-1].tolist(), [0]))
    check_pair(first, other)
    wrong = {
        "goal": replace(other, goal="stay"),
        "state differs by 0.02 from": replace(other, state=np.full(8, 0.02)),
        "same candidate": replace(first, candidates=Candidates(SQUARE[::-1].tolist(), [3])),
        "number": replace(first, candidates=Candidates(SQUARE[:3].tolist(), [1])),
        "elsewhere": replace(first, candidates=Candidates((SQUARE + 9).tolist(), [1])),
    }
    for reason, twin in wrong.items():
        with pytest.raises(NoPairError, match=reason):
            check_pair(first, twin)


def test_tasks_weigh_the_same_and_left_out_pairs_are_named() -> None:
    def line(task: str, episode: int, share: float) -> TwinLine:
        return TwinLine(task, episode, 4, 1 / 16, {"unprobed": share})

    lines = [line("VideoUnmask", i, 1.0) for i in range(3)]
    lines += [line("PickHighlight", 0, 0.0), TwinLine("RouteStick", 5, left_out="it has no twin")]
    twins = aggregate_twins(lines, {})
    assert twins.total["unprobed"].accuracy == 0.5 and twins.total["unprobed"].pairs == 4
    assert twins.suites["Permanence"]["unprobed"].accuracy == 1
    assert twins.tasks["VideoUnmask"]["unprobed"].low > 0.4
    assert twins.total["unprobed"].chance == 1 / 16
    assert twins.notes == ["Left out: RouteStick: it has no twin (episodes 5)."]
    (table,) = twin_tables(twins)
    assert [row[0] for row in table.rows] == [
        "VideoUnmask", "PickHighlight", "Permanence", "Reference", "all",
    ]  # fmt: skip


CONFIG: dict[str, Any] = {
    "compare": None, "card": False, "twins": False, "offline": True, "online": False,
    "recordings": None, "event": None, "server": None, "references": {}, "with": None,
    "trust_plugins": False,
}  # fmt: skip


@pytest.mark.parametrize(
    ("key", "value"), [("with", ["shuffle"]), ("recordings", "data"), ("online", True)]
)
def test_what_has_no_effect_on_twins_is_refused(key: str, value: Any) -> None:
    config = {**CONFIG, "twins": True}
    assert not ProbeChoice.from_config(config).on_recordings
    ProbeChoice.from_config(config).check()
    with pytest.raises(UserError, match=f"leave out {key}="):
        ProbeChoice.from_config({**config, key: value}).check()


def test_what_has_no_effect_on_a_card_is_refused_and_references_without_one() -> None:
    card = {**CONFIG, "card": True, "references": {"memoryless": "outputs/present"}}
    ProbeChoice.from_config(card).check()
    for key, value in {"with": ["shuffle"], "event": "pause:4"}.items():
        with pytest.raises(UserError, match=f"a report card: leave out {key}="):
            ProbeChoice.from_config({**card, key: value}).check()
    online = {**card, "card": False, "offline": False, "online": True}
    with pytest.raises(UserError, match=r"references=… stand beside .* add card=true"):
        ProbeChoice.from_config(online).check()


# An environment of one's own ----------------------------------------------------------------------


SCENES = [Job("Blink", "test", episode) for episode in range(40)]


@pytest.fixture
def blink(monkeypatch: pytest.MonkeyPatch) -> str:
    """examples/blink with twins."""
    monkeypatch.syspath_prepend(REPOSITORY / "examples" / "blink")
    import_plugins(["blink_twins"])
    return "blink_twins"


def move(side: float) -> np.ndarray:
    return np.full((4, 1), side, np.float32)


def remembered(episode: PlantedEpisode) -> np.ndarray:
    """Towards the light of the first frame."""
    columns = np.flatnonzero((episode.images[0] == (255, 220, 0)).all(-1).any(0))
    return move(1.0 if columns.mean() > 32 else -1.0)


def measure(rule: Rule, env: str, folder: Path) -> Twins:
    settings = RolloutSettings(env=env, seed=7)
    policy = Planted(small_policy("pi05", env=env), rule)
    return run_twins(policy, SCENES, folder, FACTS, settings, SILENT)


def test_planted_policies_have_their_accuracy(blink: str, tmp_path: Path) -> None:
    own_noise = np.random.default_rng(0)
    rules: dict[str, tuple[Rule, float, float]] = {
        "remembers": (remembered, 1, 1),
        "forgets what it saw": (lambda episode: move(1.0), 0, 0),
        "guesses by its noise": (lambda episode: move(episode.rng.choice([-1, 1])), 0, 0),
        "does not move": (lambda episode: move(0.0), 1 / 4, 1 / 4),
        "guesses anew": (lambda episode: move(own_noise.choice([-1, 1])), 0.1, 0.4),
    }
    for name, (rule, least, most) in rules.items():
        twins = measure(rule, blink, tmp_path / name)
        accuracy = twins.total[UNPROBED.name]
        assert accuracy.pairs == 40 and accuracy.chance == 1 / 4
        assert least <= accuracy.accuracy <= most, name
        assert accuracy.low <= accuracy.accuracy <= accuracy.high
        assert list(twins.suites) == ["Recall"]


def test_a_policy_without_its_memory_is_never_right_in_both(blink: str, tmp_path: Path) -> None:
    policy = small_policy("framesamp_modul", env=blink).eval()
    settings = RolloutSettings(env=blink, seed=7, flow_steps=2)
    twins = run_twins(policy, SCENES[:4], tmp_path, FACTS, settings, SILENT)
    assert twins.total[MEMORY_OFF].accuracy == 0 and twins.total[MEMORY_OFF].pairs == 4
    assert any("not a memoryless one" in note for note in twins.notes)


def test_a_stopped_measurement_continues(blink: str, tmp_path: Path) -> None:
    measure(remembered, blink, tmp_path)
    lines = (tmp_path / LINES).read_bytes().splitlines(keepends=True)
    (tmp_path / LINES).write_bytes(b"".join(lines[:3]) + lines[3][:9])
    with pytest.warns(UserWarning, match="half-written"):
        twins = measure(lambda episode: move(1.0), blink, tmp_path)
    assert [line.arms[UNPROBED.name] for line in read_twins(tmp_path)] == [1] * 3 + [0] * 37
    assert twins.tasks["Blink"][UNPROBED.name].accuracy == 3 / 40
    assert (tmp_path / FIGURES).is_file()


# RoboMME ------------------------------------------------------------------------------------------

TWIN_TASKS = (
    "VideoUnmask", "ButtonUnmask", "VideoUnmaskSwap", "ButtonUnmaskSwap", "VideoRepick",
    "VideoPlaceButton", "VideoPlaceOrder", "PickHighlight", "InsertPeg", "MoveCube", "PatternLock",
    "RouteStick",
)  # fmt: skip


@pytest.mark.nightly
@pytest.mark.parametrize("task", TWIN_TASKS)
def test_the_script_is_right_in_both_scenes_of_robomme(task: str, tmp_path: Path) -> None:
    check_script(task, tmp_path)


def test_the_script_is_right_in_both_scenes_of_a_task(tmp_path: Path) -> None:
    check_script("ButtonUnmask", tmp_path)


def check_script(task: str, folder: Path) -> None:
    """The script's own choice has all pairs of a task."""
    made: list[Any] = []

    def base(**scene: Any) -> Any:
        made.append(make_env(action_space="multi_choice", render=False, **scene))
        return made[-1]

    def scripted(_: PlantedEpisode) -> np.ndarray:
        choice = made[-1].oracle()
        assert choice is not None
        return choice_action(CHOICE_SPACE, choice)[None]

    policy = Planted(small_policy("pi05", embodiment="robomme_choice_front"), scripted)
    # The first two of VideoPlaceOrder are no pairs: the cube was put down turned in another way.
    jobs = [Job(task, "test", episode) for episode in range(3)]
    settings = RolloutSettings(seed=7, draw="all")
    options = replace(SILENT, base=base)
    twins = run_twins(policy, jobs, folder, FACTS, settings, options)
    assert twins.total[UNPROBED.name].accuracy == 1, twins.notes
    assert twins.total[UNPROBED.name].pairs >= 1


@pytest.mark.parametrize("robot", ["robomme_waypoint_front", "robomme_ee_pose"])
def test_a_demonstrator_leads_motions_and_poses_to_the_decision(robot: str, tmp_path: Path) -> None:
    made: list[Any] = []
    space = "waypoint" if "waypoint" in robot else "ee_pose"

    def base(**scene: Any) -> Any:
        made.append(make_env(action_space=space, render=False, **scene))
        return made[-1]

    def above_the_right_one(_: PlantedEpisode) -> np.ndarray:
        candidates = made[-1].candidates
        x, y = candidates.places[candidates.correct[0]]
        return np.tile(np.array([x, y, 0.2, np.pi, 0, 0, 1], np.float32), (16, 1))

    policy = Planted(small_policy("pi05", embodiment=robot), above_the_right_one)
    jobs = [Job("ButtonUnmask", "test", 0)]
    options = replace(SILENT, base=base)
    twins = run_twins(policy, jobs, tmp_path, FACTS, RolloutSettings(seed=7, draw="all"), options)
    assert twins.total[UNPROBED.name].accuracy == 1, twins.notes


def test_differences_of_poses_have_no_demonstration(tmp_path: Path) -> None:
    policy = Planted(small_policy("pi05", embodiment="robomme_ee_delta"), lambda _: move(0.0))
    options = replace(SILENT, base=lambda **scene: make_env(
        action_space="ee_pose", render=False, **scene
    ))  # fmt: skip
    jobs = [Job("ButtonUnmask", "test", 0)]
    twins = run_twins(policy, jobs, tmp_path, FACTS, RolloutSettings(seed=7), options)
    assert "no demonstration has the actions of robomme_ee_delta" in twins.notes[-1]


def test_a_scene_that_cannot_be_built_is_left_out_with_its_reason(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def no_place(*_: Any, **__: Any) -> None:
        raise SceneError("a cube finds no place")

    monkeypatch.setattr(make, "make_task", no_place)
    policy = Planted(small_policy("pi05", embodiment="robomme_choice_front"), lambda _: move(0.0))
    jobs = [Job("ButtonUnmask", "test", 0)]
    twins = run_twins(policy, jobs, tmp_path, FACTS, RolloutSettings(seed=7), SILENT)
    assert twins.notes[-1] == "Left out: ButtonUnmask: a cube finds no place (episodes 0)."


@pytest.mark.parametrize("task", ["PickXtimes", "SwingXtimes", "BinFill", "StopCube"])
def test_a_count_of_what_the_robot_does_has_no_twin(task: str) -> None:
    source = environment("mme_vla")
    assert source.twin(source.episode(task, "test", 0)) is None
