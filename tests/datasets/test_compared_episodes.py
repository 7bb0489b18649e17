"""Episodes of one or several datasets are compared with each other: what trains another policy than
was recorded is reported by name.
"""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from helpers.lerobot_tables import custom_robot, write_dataset
from mme_vla.data.episodes import EpisodeSource
from mme_vla.data.sources import compare_episodes, open_sources
from mme_vla.errors import UserError

LENGTH = 60


def recorded(seed: int = 0, episodes: int = 3) -> tuple[np.ndarray, np.ndarray]:
    """States and actions of episodes: two joints that follow their targets two frames later, and a
    gripper of −1 or 1.
    """
    rng = np.random.default_rng(seed)
    times = np.linspace(0, 1, LENGTH + 2)[:, None]
    states, actions = [], []
    for _ in range(episodes):
        numbers = np.sin(times * rng.uniform(4, 9, 3) + rng.uniform(0, 6, 3))
        numbers[:, 2] = np.where(np.arange(LENGTH + 2) % 20 < 10, -1, 1)
        states.append(numbers[:-2])
        actions.append(numbers[2:])
    return np.concatenate(states), np.concatenate(actions)


def write(root: Path, states: np.ndarray, actions: np.ndarray) -> Path:
    lengths = [LENGTH] * (len(states) // LENGTH)
    tasks = [f"task {i}" for i in range(len(lengths))]
    return write_dataset(root, lengths, tasks, states=states, actions=actions)


def test_ordinary_episodes_are_opened_without_a_word(tmp_path: Path, caplog) -> None:
    roots = [write(tmp_path / str(seed), *recorded(seed)) for seed in (1, 2)]
    open_sources(list(map(str, roots)), custom_robot(relative=[0, 1]))
    assert not caplog.text


def test_official_demonstrations_are_opened_without_a_word(caplog) -> None:
    open_sources("sample")
    assert not caplog.text


def repeat_episode(states: np.ndarray, actions: np.ndarray) -> None:
    for numbers in (states, actions):
        numbers[-LENGTH:] = numbers[:LENGTH]


def use_degrees(states: np.ndarray, actions: np.ndarray) -> None:
    for numbers in (states, actions):
        numbers[LENGTH : 2 * LENGTH, :2] *= 180 / np.pi


def rescale_gripper(states: np.ndarray, actions: np.ndarray) -> None:
    actions[-LENGTH:, 2] = actions[-LENGTH:, 2] > 0


def delay_actions(states: np.ndarray, actions: np.ndarray) -> None:
    actions[LENGTH : 2 * LENGTH] = np.roll(actions[LENGTH : 2 * LENGTH], 8, axis=0)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (repeat_episode, "hold the same states and actions, .* delete one: data/2 as data/0"),
        (use_degrees, "have other units than in episode data/0 .*: convert one: data/1"),
        (
            rescale_gripper,
            "number 3 of the action is -1 or 1 in data/0 and 0 or 1 in data/2",
        ),
        (delay_actions, "Actions fit other states .* one clock: data/1 those -6 frames away"),
    ],
)
def test_an_episode_unlike_the_others_is_named(
    tmp_path: Path, caplog, damage: Callable[[np.ndarray, np.ndarray], None], message: str
) -> None:
    states, actions = recorded()
    damage(states, actions)
    root = write(tmp_path / "data", states, actions)
    source = EpisodeSource(root, robot=custom_robot(relative=[0, 1]))
    assert not caplog.text
    compare_episodes([source])
    (record,) = caplog.records
    assert re.search(message, record.getMessage())


def test_grippers_of_two_scales_in_two_sources_are_named(tmp_path: Path, caplog) -> None:
    write(tmp_path / "one", *recorded(1))
    states, actions = recorded(2)
    actions[:, 2] = actions[:, 2] > 0
    write(tmp_path / "two", states, actions)
    open_sources([str(tmp_path / name) for name in ("one", "two")], custom_robot())
    assert "number 3 of the action is -1 or 1 in one/0 and 0 or 1 in two/0" in caplog.text


def test_numbers_of_many_values_may_have_other_ranges(tmp_path: Path, caplog) -> None:
    states, actions = recorded()
    actions[:, 2] = np.random.default_rng(0).integers(0, 4096, len(actions))  # ticks of a servo
    write(tmp_path / "ticks", states, actions)
    widths = actions.copy()
    widths[:, 2] = np.where(widths[:, 2] > 2000, 0.08, np.repeat([0.01, 0.02, 0.03], LENGTH))
    write(tmp_path / "widths", states + 0.01, widths)
    for name in ("ticks", "widths"):
        open_sources(str(tmp_path / name), custom_robot())
    assert not caplog.text


@pytest.mark.parametrize("factor", [180 / np.pi, 1 / 1000])
def test_actions_relative_to_states_of_another_unit_are_refused(
    tmp_path: Path, factor: float
) -> None:
    states, actions = recorded()
    states[:, :2] *= factor
    write(tmp_path, states, actions)
    assert len(EpisodeSource(tmp_path, robot=custom_robot())) == 3
    with pytest.raises(UserError, match=r"numbers 1, 2 reach .* embodiment.action.relative=\[\]"):
        EpisodeSource(tmp_path, robot=custom_robot(relative=[0, 1]))


def test_inspecting_names_what_is_unlike(tmp_path: Path, caplog) -> None:
    from rich.console import Console

    from mme_vla.cli.inspect import show_dataset

    states, actions = recorded()
    repeat_episode(states, actions)
    root = write(tmp_path / "data", states, actions)
    show_dataset(EpisodeSource(root, robot=custom_robot()), Console(quiet=True))
    assert "data/2 as data/0" in caplog.text
