"""What an environment may say of itself beyond its tasks, on a small one: limits a task, images on
demand, kept scenes, the first success, cues, groupings, and errors of its own code.
"""

import json
import pickle
from collections.abc import Iterator
from pathlib import Path
from typing import Any, ClassVar

import gymnasium
import numpy as np
import pytest

import mme_vla
from helpers.rollout_fakes import FACTS, InlineEnvs, quick_policy
from mme_vla.cli.record import RecordRun, _rate
from mme_vla.envs import base
from mme_vla.envs.base import Environment, EpisodeEnv
from mme_vla.envs.episodes import choose_tasks
from mme_vla.envs.metadata import EpisodeSpec
from mme_vla.envs.observations import RenderRequest
from mme_vla.envs.vector import worker
from mme_vla.envs.vector.pool import Job, Reply, VecEnv
from mme_vla.errors import UserError, place_of, set_place, text_of
from mme_vla.evaluation.records import EpisodeRecord, check_settings
from mme_vla.evaluation.results.aggregate import aggregate
from mme_vla.evaluation.results.tables import grouping_tables
from mme_vla.evaluation.rollout.environment import ChunkCommand, ChunkEnv
from mme_vla.evaluation.rollout.runner import Rollout
from mme_vla.evaluation.rollout.settings import RolloutSettings
from mme_vla.registry import ENVS


class Corridor(gymnasium.Env):
    """The cue is shown for two steps in which nothing moves; then the robot walks. Its third step
    alone is a success.
    """

    def __init__(self) -> None:
        self.renders: list[int] = []
        self.resets = 0
        self.closed = False

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[dict, dict]:
        self.time = 0
        self.place = 0
        self.resets += 1
        return self.observe(), {"goal": "walk", "frozen": 2}

    def observe(self) -> dict[str, Any]:
        time = self.time

        def top_image() -> np.ndarray:
            assert time == self.time, "an image is rendered before the next step"
            self.renders.append(time)
            return np.full((2, 2, 3), time, np.uint8)

        return {"top": top_image, "state": np.array([self.place], np.float32)}

    def step(self, action: Any) -> tuple[dict, float, bool, bool, dict]:
        self.time += 1
        if self.time > 2:
            self.place += int(action[0])
        return self.observe(), 0.0, False, False, {"success": self.place == 3}

    def close(self) -> None:
        self.closed = True


class Corridors(Environment):
    tasks = ("Short", "Wide")
    steps: ClassVar = {"Short": 4, "Wide": 9}
    suites: ClassVar = {"Walks": ("Short", "Wide")}
    groupings: ClassVar = {
        "length": {"brief": ("Short",), "long": ("Wide",)},
        "width": {"wide": ("Wide",)},
    }
    embodiment: ClassVar = {
        "name": "corridor",
        "cameras": {"top": {}},
        "state": {"width": 1},
        "action": {"width": 1, "horizon": 4, "execute": 4},
        "fps": 10,
    }

    def make(self, spec: EpisodeSpec, render: bool = True) -> Corridor:
        return Corridor()

    def hold(self, env: Corridor) -> np.ndarray:
        return np.zeros(1)

    def demonstrate(self, env: Corridor) -> Iterator[np.ndarray]:
        while True:
            yield np.ones(1)


GO = np.ones(1)


@pytest.fixture(autouse=True)
def no_kept_scenes() -> Iterator[None]:
    base._idle.clear()
    yield
    base._idle.clear()


def steps_until_the_end(env: EpisodeEnv) -> tuple[int, str]:
    env.reset()
    for number in range(1, 50):
        _, _, terminated, truncated, info = env.step(GO)
        if terminated or truncated:
            return number, info["status"]
    raise AssertionError


def test_each_task_has_its_own_step_limit() -> None:
    source = Corridors()
    assert source.step_limit("test") == 9 and source.task_limit("Short", "test") == 4
    with pytest.raises(UserError, match=r"Corridors\.steps lacks Long: add its limit"):
        source.task_limit("Long", "test")
    assert steps_until_the_end(source.open("Short", "test", 0)) == (4, "timeout")
    assert steps_until_the_end(source.open("Wide", "test", 0)) == (9, "timeout")
    assert steps_until_the_end(source.open("Wide", "test", 0, max_steps=3)) == (3, "timeout")


def test_a_class_of_before_gives_its_limit_by_split_alone() -> None:
    class Halved(Corridors):
        steps = 9

        def step_limit(self, split: str) -> int:
            return 2 if split == "val" else 4

    assert steps_until_the_end(Halved().open("Wide", "val", 0)) == (2, "timeout")
    assert steps_until_the_end(Halved().open("Wide", "test", 0)) == (4, "timeout")


@pytest.fixture
def registered(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.setitem(ENVS._entries, "corridors", Corridors)
    yield


@pytest.mark.usefixtures("registered")
def test_settings_know_the_limit_of_each_task_unless_another_is_set() -> None:
    settings = RolloutSettings(env="corridors")
    assert settings.step_limit == 9 and settings.max_steps is None
    assert [settings.limit_of(task) for task in ("Short", "Wide")] == [4, 9]
    for limit in (6, 9):  # 9 is that of the longest task
        assert RolloutSettings(env="corridors", max_steps=limit).limit_of("Short") == limit
    assert RolloutSettings().limit_of("StopCube") == 1300


@pytest.mark.usefixtures("registered")
def test_a_suite_or_a_group_names_its_tasks_that_can_be_built(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert choose_tasks("Walks", "corridors") == ["Short", "Wide"]
    assert choose_tasks(["long", "brief"], "corridors") == ["Wide", "Short"]
    with pytest.raises(UserError, match="must name each task once"):
        choose_tasks("long,Wide", "corridors")
    monkeypatch.setattr(Corridors, "tasks", ("Short",))
    assert choose_tasks("Walks", "corridors") == ["Short"]
    with pytest.raises(UserError, match="Unknown task 'Wide'"):
        choose_tasks("wide", "corridors")


def records() -> list[EpisodeRecord]:
    source = Corridors()
    made = []
    for task in source.tasks:
        for episode in range(2):
            made.append(
                EpisodeRecord(
                    "m", 1, 7, task, episode, episode, "", "success" if episode else "fail", 3,
                    env="corridors", max_steps=source.steps[task], suite="Walks",
                    groups=source.groups_of(task),
                )
            )  # fmt: skip
    return made


def test_records_of_one_run_may_have_a_limit_of_each_task_but_not_two_of_one() -> None:
    check_settings(records())
    mixed = [*records(), EpisodeRecord("m", 1, 7, "Wide", 2, 2, "", "fail", 3, env="corridors")]
    with pytest.raises(UserError, match="mixes max_steps 9 and 1300"):
        check_settings(mixed)


def test_results_make_a_table_of_each_grouping_from_the_records_alone() -> None:
    lines = [json.loads(record.to_json()) for record in records()]
    assert lines[0]["groups"] == {"length": "brief"}
    read = [EpisodeRecord.from_json(record.to_json()) for record in records()]
    length, width = grouping_tables(aggregate(read))
    assert length.title == "Success rate (%) by length"
    assert length.columns == ["method", "brief", "long"] and width.columns == ["method", "wide"]
    assert [row[1:] for row in length.rows] != [["", ""]]


def test_images_that_are_functions_are_rendered_only_where_they_are_requested() -> None:
    env = Corridors().open("Wide", "test", 0)
    chunks = ChunkEnv(lambda: env, robot=_robot())
    request = RenderRequest({"top": frozenset({2})}, ("top",))
    chunks.reset(images=RenderRequest({}, ()))
    frames, *_, report = chunks.step(ChunkCommand(np.ones((4, 1)), images=request))
    assert env.env.renders == [2, 4], "the frame that is read, and the newest"
    assert [image is None for image in frames["top"]] == [True, False, True, False]
    assert report.rendered_s > 0
    chunks.step(ChunkCommand(np.ones((2, 1))))
    assert env.env.renders == [2, 4, 5, 6], "without a request all"


def _robot() -> Any:
    from mme_vla.embodiment import Embodiment

    return Embodiment.from_dict(Corridors.embodiment)


def test_the_cue_is_part_of_the_execution_or_a_conditioning_video() -> None:
    class WithVideo(Corridors):
        cue = "video"

    frames, _ = Corridors().open("Wide", "test", 0).reset()
    assert len(frames["state_list"]) == 1
    env = WithVideo().open("Wide", "test", 0)
    frames, _ = env.reset()
    assert [image[0, 0, 0] for image in frames["top_rgb_list"]] == [0, 1, 2]
    frames, *_ = env.step(GO)
    assert frames["state_list"][0].item() == 1, "the first action of the policy has an effect"
    demonstrated = list(WithVideo().open("Wide", "test", 0).demonstration())
    assert [visible for *_, visible in demonstrated[:4]] == [True, True, False, False]
    assert [bool(action.any()) for _, action, _ in demonstrated[:3]] == [False, False, True]


def test_with_success_once_the_first_success_ends_an_episode() -> None:
    class Once(Corridors):
        success = "once"

    assert steps_until_the_end(Corridors().open("Wide", "test", 0)) == (9, "timeout")
    assert steps_until_the_end(Once().open("Wide", "test", 0)) == (5, "success")
    env = Once().open("Wide", "test", 0)
    assert len(list(env.demonstration())) == 5 and env.success


def test_a_process_keeps_an_environment_for_the_next_episode_of_its_task() -> None:
    class Reusable(Corridors):
        reuse = True

    first = Reusable().open("Wide", "test", 0)
    scene = first.env
    steps_until_the_end(first)
    first.close()
    first.close()  # closing twice is harmless
    second = Reusable().open("Wide", "test", 1)
    beside = Reusable().open("Wide", "test", 2)
    assert second.env is scene and not scene.closed and beside.env is not scene
    assert Reusable().open("Short", "test", 1).env is not scene
    second.close()
    assert Reusable().open("Wide", "test", 1, render=False).env is not scene
    fresh = Corridors().open("Wide", "test", 0)
    fresh_scene = fresh.env
    fresh.close()
    assert fresh_scene.closed


def test_a_scene_whose_step_failed_is_not_kept() -> None:
    class Breaking(Corridors):
        reuse = True

    env = Breaking().open("Wide", "test", 0)
    scene = env.env
    env.reset()
    with pytest.raises(TypeError):
        env.step(None), env.step(None), env.step(None)
    env.close()
    assert scene.closed and not base._idle


def test_no_more_than_a_few_scenes_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    class Reusable(Corridors):
        reuse = True

    monkeypatch.setattr(base, "_MAX_IDLE", 1)
    scenes = []
    for task in ("Wide", "Short"):
        env = Reusable().open(task, "test", 0)
        scenes.append(env.env)
        env.close()
    assert [scene.closed for scene in scenes] == [True, False]


def test_a_dataset_has_the_rate_of_the_robot() -> None:
    def run(fps: int | None) -> Any:
        return RecordRun(**{**dict.fromkeys(RecordRun.__dataclass_fields__), "fps": fps})

    assert _rate(Corridors(), run(None)) == _rate(Corridors(), run(10)) == 10
    with pytest.raises(UserError, match=r"fps=20 contradicts the robot of env=.*10 frames"):
        _rate(Corridors(), run(20))

    class Timeless(Corridors):
        embodiment: ClassVar = {**Corridors.embodiment, "fps": None}

    assert [_rate(Timeless(), run(fps)) for fps in (None, 15)] == [20, 15]


# Errors of an environment's own code --------------------------------------------------------------


def break_at_reset(**_: Any) -> Any:
    """What a worker calls to make an environment whose reset is wrong."""
    return Broken()


class Broken:
    def reset(self, **_: Any) -> Any:
        return {}["missing"]  # the line that is named

    def close(self) -> None: ...


@pytest.mark.slow
def test_an_error_of_a_plugin_names_its_file_and_line() -> None:
    with VecEnv([], 1, break_at_reset) as envs:
        envs.start(0, Job("A", "test", 0))
        (reply,) = envs.recv()
    line = 1 + Path(__file__).read_text().split("\n").index(
        '        return {}["missing"]  # the line that is named'
    )
    assert type(reply.error) is KeyError
    assert text_of(reply.error) == f"'missing' (KeyError, {__file__}, line {line})"
    assert reply.info["error_message"] == f"A test episode 0: {text_of(reply.error)}"


def test_a_note_of_other_code_is_no_place() -> None:
    error = KeyError("a")
    error.add_note("hint of a library")
    assert place_of(error) is None and text_of(error) == "'a'"
    set_place(error, "KeyError, x.py, line 3")
    assert place_of(pickle.loads(pickle.dumps(error))) == "KeyError, x.py, line 3"


def test_a_folder_beside_the_library_is_no_part_of_it(tmp_path: Path) -> None:
    """Its name may begin alike: `mme_vla_own`."""
    library = Path(mme_vla.__file__).parent
    source = "def fail():\n    raise ValueError('own')\n"
    for folder, expected in ((library, False), (Path(f"{library}_own"), True)):
        namespace: dict[str, Any] = {"__name__": "outside"}
        exec(compile(source, str(folder / "scene.py"), "exec"), namespace)
        with pytest.raises(ValueError, match="own") as caught:
            namespace["fail"]()
        frame = caught.traceback[-1].frame.raw
        assert worker._is_of_plugin(frame) == expected


class Failing(InlineEnvs):
    """Each episode's step ends with the next of these errors; None succeeds."""

    errors: list[Exception | None]

    def start(self, worker: int, job: Job, **how: Any) -> None:
        error = self.errors.pop(0)
        if error is None:
            super().start(worker, job, **how)
        else:
            self._replies.append(Reply.of_failure(worker, job, True, error))


def _roll(errors: list[Exception | None], retries: int = 0) -> list[EpisodeRecord]:
    made: list[EpisodeRecord] = []
    envs = Failing(1)
    envs.errors = errors
    jobs = [Job("VideoUnmask", "test", number) for number in range(4)]
    settings = RolloutSettings(max_steps=24, flow_steps=2, retries=retries)
    Rollout(quick_policy("pi05"), envs, FACTS, settings, made.append).run(jobs)
    return made


def noted(key: str) -> KeyError:
    error = KeyError(key)
    set_place(error, "KeyError, x.py, line 3")
    return error


def test_the_second_equal_error_of_a_plugin_stops_the_run() -> None:
    same = [noted("a") for _ in range(4)]
    with pytest.raises(UserError, match=r"2 episodes in a row .* 'a' \(KeyError, x.py, line 3\)"):
        _roll(list(same))
    other = [noted(str(number)) for number in range(4)]
    assert [record.outcome for record in _roll(other)] == ["error"] * 4
    crashes: list[Exception | None] = [RuntimeError("died of signal 9") for _ in range(4)]
    assert [record.outcome for record in _roll(crashes)] == ["error"] * 4
