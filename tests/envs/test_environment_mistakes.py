"""What environments refuse in words, and what they understand, without the simulator."""

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

import mme_vla.envs
from mme_vla.cli import record
from mme_vla.config.composition import compose, resolved
from mme_vla.envs import make_env
from mme_vla.envs.base import CHOICES, Environment, EpisodeEnv
from mme_vla.envs.episodes import choose_numbers
from mme_vla.envs.metadata import EpisodeSpec, episode, episodes, step_limit
from mme_vla.envs.vector import pool
from mme_vla.errors import UserError

STEPS = 4


class Tape(gymnasium.Env):
    """Writes each observation over the one before, as many simulators do."""

    def __init__(self) -> None:
        self.observation: dict[str, np.ndarray] = {
            "top": np.zeros((2, 2, 3), np.uint8),
            "state": np.zeros(1, np.float32),
        }

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[dict, dict]:
        self.time = 0
        return self.observe(), {"goal": "wind", "frozen": 2}

    def observe(self) -> dict[str, Any]:
        for value in self.observation.values():
            value[:] = self.time
        return self.observation

    def step(self, action: Any) -> tuple[dict, float, bool, bool, dict]:
        self.time += 1
        return self.observe(), 0.0, False, False, {"success": self.time >= STEPS}


class Tapes(Environment):
    tasks = ("Tape",)
    splits = {"train": 3, "slow": 3, "fast": 3}  # noqa: RUF012
    cue = "video"

    def make(self, spec: EpisodeSpec, render: bool = True) -> Any:
        return Tape()

    def hold(self, env: Any) -> np.ndarray:
        return np.zeros(1)

    def choices(self, env: Any) -> dict[str, list[np.ndarray]]:
        return {"wind on": [np.zeros(1)] * STEPS}

    def demonstrate(self, env: Any) -> Any:
        return [np.zeros(1)] * STEPS


def opened(**options: Any) -> EpisodeEnv:
    made: EpisodeEnv = Tapes().open("Tape", "train", 0, **options)
    return made


def test_frames_have_their_values_where_an_environment_replaces_them() -> None:
    env = opened(action_space=CHOICES)
    video, _ = env.reset()
    assert [state.item() for state in video["state_list"]] == [0, 1, 2]
    assert [image.max() for image in video["top_rgb_list"]] == [0, 1, 2]
    frames, *_ = env.step({"choice": "A"})
    assert [state.item() for state in frames["state_list"]] == [3, 4, 5, 6]
    assert [image.max() for image in frames["top_rgb_list"]] == [3, 4, 5, 6]


@pytest.mark.parametrize("action", [{"choice": "z"}, {"choice": None}, {"point": [1, 2]}, [1, 2]])
def test_a_choice_that_is_not_offered_is_refused_by_name(action: Any) -> None:
    env = opened(action_space=CHOICES)
    env.reset()
    with pytest.raises(UserError, match=r"Unknown choice .* Known: a\."):
        env.step(action)


@pytest.mark.parametrize("max_steps", [0, -5, "5", 2.5])
def test_a_limit_is_a_positive_number_of_steps(max_steps: Any) -> None:
    with pytest.raises(UserError, match=r"max_steps is .*; expected a positive integer"):
        opened(max_steps=max_steps)


def test_a_closed_episode_says_so() -> None:
    env = opened()
    env.reset()
    env.close()
    with pytest.raises(UserError, match="environment is closed"):
        env.step(np.zeros(1))
    with pytest.raises(UserError, match="environment is closed"):
        env.reset()


@pytest.mark.parametrize("made", [None, Tape])
def test_what_is_no_environment_is_refused_where_it_is_made(
    made: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Tapes, "make", lambda self, spec, render=True: made)
    with pytest.raises(UserError, match=r"Tapes\.make returned .*; expected a gymnasium\.Env\."):
        opened()


@pytest.mark.parametrize("observation", [np.zeros(3, np.float32), None, ({}, {})])
def test_an_observation_is_a_dict(observation: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Tape, "observe", lambda self: observation)
    with pytest.raises(UserError, match=r"Tape: an observation is a \w+; expected a dict of an im"):
        opened().reset()


def test_a_demonstration_may_be_a_list_of_actions() -> None:
    env = opened()
    times = [frame["state"].item() for frame, _, _ in env.demonstration()]
    assert times == [0, 1, 2, 3, 4, 5] and env.success


def test_no_two_splits_share_a_seed() -> None:
    source = Tapes()
    seeds = [spec.seed for split in source.splits for spec in source.episodes("Tape", split)]
    assert len(set(seeds)) == len(seeds)
    assert seeds[3:6] == [2_000_000, 2_000_001, 2_000_002]


class ReusedTapes(Tapes):
    reuse = True

    def episodes(self, task: str, split: str) -> list[EpisodeSpec]:
        row = {"length": 9} if split == "slow" else None
        return [EpisodeSpec(task, split, 0, 0, "", row)]

    def make(self, spec: EpisodeSpec, render: bool = True) -> Any:
        tape = Tape()
        tape.row = spec.row  # type: ignore[attr-defined]
        return tape


def test_a_reused_environment_does_not_serve_a_scene_of_values() -> None:
    source = ReusedTapes()
    first = source.open("Tape", "train", 0)
    first.reset()
    first.close()
    assert source.open("Tape", "slow", 0).env.row == {"length": 9}
    assert source.open("Tape", "train", 0).env.row is None


@pytest.mark.parametrize("split", [Path("scenes.jsonl"), None, 3])
def test_a_split_is_a_text(split: Any) -> None:
    for read in (lambda: step_limit(split), lambda: episodes("StopCube", split)):
        with pytest.raises(UserError, match="is no text, such as"):
            read()


@pytest.mark.parametrize("split", ["twin", "stress:count=2"])
def test_a_seed_and_a_variant_of_a_split_are_refused_together(split: str) -> None:
    with pytest.raises(UserError, match=f"seed=3 builds a scene of no split, and split={split}"):
        make_env("StopCube", split, seed=3)


def test_numbers_of_episodes_may_be_numpys() -> None:
    two: Any = np.int64(2)
    assert episode("StopCube", "test", two) == episode("StopCube", "test", 2)
    assert Tapes().episode("Tape", "train", two).episode == 2
    assert choose_numbers(np.arange(2, 4), 50) == [2, 3]
    with pytest.raises(UserError, match="Unknown episode True"):
        episode("StopCube", "test", True)


@pytest.mark.parametrize(
    ("selection", "numbers"), [(2, [0, 1]), ("0-1,7", [0, 1, 7]), (range(3), [0, 1, 2]), ([4], [4])]
)
def test_workers_take_episodes_as_commands_do(
    monkeypatch: pytest.MonkeyPatch, selection: Any, numbers: list[int]
) -> None:
    monkeypatch.setattr("mme_vla.envs.make.require_simulator", lambda: None)
    monkeypatch.setattr(pool, "VecEnv", lambda jobs, *_: jobs)
    jobs: Any = pool.make_vec_env(["StopCube", "BinFill"], selection)
    expected = [(task, number) for task in ("StopCube", "BinFill") for number in numbers]
    assert [(job.task, job.episode) for job in jobs] == expected


def test_workers_are_not_started_for_an_unknown_reward(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("mme_vla.envs.make.require_simulator", lambda: None)
    with pytest.raises(UserError, match="Did you mean 'sparse'"):
        pool.make_vec_env("StopCube", [0], reward="sparsely")


@pytest.mark.parametrize(
    ("split", "base"), [("twin", "test"), ("twin:train", "train"), ("stress:count=2", "test")]
)
def test_variants_of_a_split_are_not_recorded_as_the_split_itself(split: str, base: str) -> None:
    words = ["task=StopCube", "episodes=1", f"split={split}", "output=somewhere"]
    run = record.RecordRun.from_config(resolved(compose("record", words)))
    with pytest.raises(UserError, match=rf"scenes as they are: record split={base}\."):
        record.plan(run)


@pytest.fixture
def simulated() -> None:
    pytest.importorskip("mani_skill", reason="the simulation needs the extra 'sim'")


@pytest.mark.usefixtures("simulated")
def test_a_finished_recording_of_a_tier_is_recognised(tmp_path: Path) -> None:
    import h5py

    from mme_vla.envs.make import make_task
    from mme_vla.envs.robomme.recording.outputs import EpisodeWriter

    words = ["task=StopCube", "episodes=1", "split=ood:xhard2", "output=somewhere"]
    run = record.RecordRun.from_config(resolved(compose("record", words)))
    (job,) = record.plan(run)
    spec = episode("StopCube", "ood:xhard2", 0)
    task = make_task("StopCube", render=False, **spec.options)
    EpisodeWriter(tmp_path / "written.h5", 0, task).close()
    task.close()
    with h5py.File(tmp_path / "written.h5") as file:
        setup = file["episode_0/setup"]
        assert job.made(int(setup["seed"][()]), setup["difficulty"].asstr()[()], None)


@pytest.mark.usefixtures("simulated")
def test_unknown_tasks_seeds_and_options_of_a_reset_are_refused() -> None:
    from mme_vla.envs import load_tasks
    from mme_vla.envs.gym import GymTask
    from mme_vla.envs.make import make_task

    with pytest.raises(UserError, match="Did you mean 'StopCube'"):
        load_tasks("StopCub")
    seeds: list[Any] = ["3", 2.5, 2**63, -1, None]
    for seed in seeds:
        with pytest.raises(UserError, match=r"expected a non-negative integer below 2\^63"):
            make_task("StopCube", render=False, seed=seed)
    with pytest.raises(UserError, match="Unknown reset options episodes"):
        GymTask("StopCube", images=False).reset(options={"episodes": 3})


def test_names_of_the_package_are_no_modules() -> None:
    folder = Path(mme_vla.envs.__file__).parent
    assert not {path.stem for path in folder.iterdir()} & set(mme_vla.envs.__all__)


@pytest.mark.usefixtures("simulated")
def test_a_seed_may_be_numpys() -> None:
    seed: Any = np.int64(4)
    env = make_env("StopCube", seed=seed, render=False)
    assert type(env.task.seed) is int and env.difficulty == "medium"
    env.close()
