"""Damaged logs, replies, prompts and states: one sentence each, never a traceback."""

import json
from pathlib import Path

import numpy as np
import pytest

from helpers import artefacts
from mme_vla.errors import UserError
from mme_vla.evaluation.store import RECORDS, read_records, read_run
from mme_vla.processing.normalise import QuantileStats, check_reach


def test_a_digit_that_changed_in_a_record_is_detected(tmp_path: Path) -> None:
    artefacts.write_logs(tmp_path)
    path = tmp_path / RECORDS
    assert len(read_records(path)) == 5
    path.write_text(path.read_text().replace('"steps":302', '"steps":312'))
    with pytest.raises(UserError, match=r"line 3.* is not what was written"):
        read_records(path)


@pytest.mark.parametrize("value", ['"x"', "1e999", "true", "[1]", "9" * 400])
def test_seconds_that_are_no_seconds_are_refused(tmp_path: Path, value: str) -> None:
    artefacts.write_logs(tmp_path)
    line = json.loads((tmp_path / RECORDS).read_text().splitlines()[0])
    del line["crc32"]
    line["seconds"]["sim"] = "HERE"
    (tmp_path / RECORDS).write_text(json.dumps(line).replace('"HERE"', value) + "\n")
    with pytest.raises(UserError, match=r"line 1.*seconds.sim"):
        read_records(tmp_path / RECORDS)


def test_an_endless_device_in_a_logs_place_is_refused(tmp_path: Path) -> None:
    artefacts.write_logs(tmp_path)
    for name in (RECORDS, "run.json"):
        (tmp_path / name).unlink()
        (tmp_path / name).symlink_to("/dev/zero")
    with pytest.raises(UserError, match="not a file"):
        read_records(tmp_path / RECORDS)
    with pytest.raises(UserError, match="not a file"):
        read_run(tmp_path)


@pytest.mark.parametrize(
    "damage", ['{"text": "a", "input_tokens": Infinity, "output_tokens": 1}', "null"]
)
def test_a_damaged_reply_is_requested_again(tmp_path: Path, damage: str, caplog) -> None:
    artefacts.write_answers(tmp_path)
    cached = next((tmp_path / "answers").rglob("*.json"))
    cached.write_text(damage)
    assert artefacts.read_answers(tmp_path) == ("pick up the cube at <1, 2>", 12, 7)
    assert "asked again" in caplog.text
    cached.unlink()
    cached.mkdir()
    assert artefacts.read_answers(tmp_path) == ("pick up the cube at <1, 2>", 12, 7)


def test_states_well_beyond_the_statistics_are_a_broken_driver() -> None:
    ones = np.ones(8)
    stats = QuantileStats(mean=0 * ones, std=ones, q01=-ones, q99=ones)
    check_reach(np.full((3, 8), 100, np.float32), stats, "a state")
    with pytest.raises(UserError, match=r"1e\+30 for number 2 of 8.*within -1 and 1"):
        check_reach(np.array([[0, 1e30, 0, 0, 0, 0, 0, 0]], np.float32), stats, "a state")


def test_states_in_degrees_are_named_where_training_had_radians(
    recwarn: pytest.WarningsRecorder,
) -> None:
    ones = np.ones(8)
    stats = QuantileStats(mean=0 * ones, std=ones, q01=-3 * ones, q99=2 * ones)
    radians = np.array([[0, 1, -1.5, 2, 0.001, 2.9, -2, 1]], np.float32)
    check_reach(np.concatenate([radians, 2 * radians]), stats, "a state")
    assert not recwarn
    for _ in range(2):
        check_reach(np.rad2deg(radians), stats, "a state")
    (warning,) = recwarn
    assert "6 of 8 numbers" in str(warning.message)
    assert "up to 55 times" in str(warning.message)


@pytest.mark.parametrize("goal", [None, b"pick", "pick \udfff"])
def test_an_episode_begins_with_a_goal_in_words(goal: object) -> None:
    from mme_vla.testing.small import small_policy

    policy = small_policy("pi05")
    with pytest.raises(UserError, match="the goal"):
        policy.start_episode(goal)
