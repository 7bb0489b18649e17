"""Environments in worker processes: order, frames, crashes, hangs, closing."""

import gc
import multiprocessing
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from helpers.env_fakes import FRAME, make_light_env
from mme_vla.envs import VecEnv, make_vec_env
from mme_vla.envs.base import Environment
from mme_vla.envs.vector import pool
from mme_vla.envs.vector.pool import Job, Reply
from mme_vla.envs.vector.worker import begin, portable, settings, simulating_processes
from mme_vla.errors import SceneError, UserError


@pytest.fixture(scope="module")
def shared_envs() -> Iterator[VecEnv]:
    """Two workers for all tests, since a process takes seconds to start."""
    with VecEnv([], 2, partial(make_light_env, video=20)) as envs:
        yield envs


@pytest.fixture
def envs(shared_envs: VecEnv) -> Iterator[VecEnv]:
    """The same workers, both at the beginning of an episode."""
    shared_envs.timeout = 60.0
    for worker in range(2):
        shared_envs.start(worker, Job("StopCube", "test", 30 + worker))
    collect(shared_envs, 2)
    yield shared_envs
    shared_envs.jobs.clear()
    while shared_envs.busy:
        shared_envs.recv()


def collect(envs: VecEnv, count: int) -> dict[int, Reply]:
    """That many replies, by worker."""
    replies: list[Reply] = []
    while len(replies) < count:
        replies += envs.recv()
    assert len(replies) == count
    return {reply.worker: reply for reply in replies}


def only(replies: list[Reply]) -> Reply:
    (reply,) = replies
    return reply


@pytest.mark.slow
def test_every_episode_is_run_once_by_whoever_is_free(envs: VecEnv) -> None:
    envs.jobs.extend(Job("StopCube", "test", episode) for episode in range(5))
    begun, finished = [envs.start_next(0), envs.start_next(1)], []
    while envs.busy:
        for reply in envs.recv():
            if reply.done:
                finished.append(reply.job.episode)
                begun.append(envs.start_next(reply.worker))
            else:
                envs.send(reply.worker, "end")
    assert sorted(finished) == [0, 1, 2, 3, 4]
    assert begun[-2:] == [None, None]
    assert begun[0] == Job("StopCube", "test", 0)
    assert envs.recv() == []


def test_a_long_video_arrives_completely_and_in_order(envs: VecEnv) -> None:
    envs.start(0, Job("StopCube", "test", 7))
    reply = only(envs.recv())
    frames = reply.observation["front_rgb_list"]
    assert [int(frame[0, 0, 0]) for frame in frames] == [7 + k for k in range(21)]
    assert all(
        frame.shape == FRAME and frame.dtype == np.uint8 and frame.std() == 0 for frame in frames
    )
    assert reply.reward is None
    envs.send(0, "go")
    later = only(envs.recv())
    assert int(later.observation["front_rgb_list"][0].max()) == 1
    assert [int(frame[0, 0, 0]) for frame in frames] == [7 + k for k in range(21)], (
        "earlier frames were overwritten"
    )


def test_whoever_is_ready_comes_first(envs: VecEnv, tmp_path: Path) -> None:
    envs.send(0, tmp_path / "released")  # the step waits for this file
    envs.send(1, "go")
    assert only(envs.recv()).worker == 1
    assert envs.recv(timeout=0.05) == []
    (tmp_path / "released").touch()
    assert only(envs.recv()).worker == 0


@pytest.mark.parametrize(
    ("action", "words"), [("die", "exit code 3"), ("hang", "gave no result within 4 s")]
)
def test_a_lost_worker_is_reported_and_replaced_while_others_continue(
    envs: VecEnv, action: str, words: str
) -> None:
    envs.send(1, "go")
    envs.timeout = 4.0
    envs.send(0, action)
    replies = collect(envs, 2)
    assert replies[1].info["steps"] == 1
    lost = replies[0]
    assert lost.error is not None
    assert lost.done
    assert lost.info["status"] == "error"
    assert words in lost.info["error_message"]
    assert "StopCube test episode 30" in lost.info["error_message"]
    envs.timeout = 60.0
    envs.start(0, Job("StopCube", "test", 6))
    again = only(envs.recv())
    assert again.error is None
    assert int(again.observation["front_rgb_list"][0][0, 0, 0]) == 6


def processes() -> set[int | None]:
    return {child.pid for child in multiprocessing.active_children()}


def test_a_worker_that_dies_in_the_middle_of_a_message_is_reported(envs: VecEnv) -> None:
    envs.start(0, Job("StopCube", "test", 7))
    state = envs._workers[0]
    assert state.connection.poll(30)  # its 4 MB have begun to arrive, and no pipe holds them
    state.process.kill()
    state.process.join(30)
    lost = only(envs.recv())
    assert type(lost.error) is pool.WorkerCrash
    expected = "StopCube test episode 7: the worker process died of signal 9"
    assert lost.info["error_message"] == expected
    envs.start(0, Job("StopCube", "test", 6))
    assert only(envs.recv()).error is None


def test_large_replies_wait_until_they_are_taken(envs: VecEnv) -> None:
    for worker in range(2):
        envs.start(worker, Job("StopCube", "test", worker))
    for state in envs._workers:
        assert state.connection.poll(30)
    time.sleep(0.5)
    replies = collect(envs, 2)
    for worker, reply in replies.items():
        frames = reply.observation["front_rgb_list"]
        assert [int(frame[0, 0, 0]) for frame in frames] == [worker + k for k in range(21)]


def test_an_exception_is_reported_and_its_worker_replaced(envs: VecEnv) -> None:
    before = processes()
    envs.start(0, Job("StopCube", "test", 13))
    failed = only(envs.recv())
    assert type(failed.error) is ValueError
    assert failed.info["exception_type"] == "ValueError"
    assert "StopCube test episode 13: no scene for this seed" in failed.info["error_message"]
    assert len(processes() - before) == 1
    envs.start(0, Job("StopCube", "test", 2))
    assert not only(envs.recv()).done
    envs.send(0, "raise")
    assert "the arm fell off" in only(envs.recv()).info["error_message"]
    assert len(processes() - before) == 1


def test_a_scene_that_cannot_be_built_leaves_its_worker(envs: VecEnv) -> None:
    before = processes()
    envs.send(0, "refuse")
    failed = only(envs.recv())
    assert type(failed.error) is SceneError
    assert processes() == before
    envs.start(0, Job("StopCube", "test", 2))
    assert not only(envs.recv()).done


def test_an_exception_of_a_class_that_others_cannot_read_becomes_its_text() -> None:
    class OwnError(Exception):
        """Of a class that no other process can import."""

    for error in (UserError("no"), SceneError("no"), KeyError("no")):
        assert portable(error) is error
    text = portable(OwnError("no place"))
    assert (type(text), str(text)) == (RuntimeError, "OwnError: no place")
    undecodable = UnicodeDecodeError("utf-8", b"x", 0, 1, "bad")
    assert portable(undecodable) is undecodable


def test_misuse_is_refused(envs: VecEnv) -> None:
    envs.jobs.append(Job("StopCube", "test", 1))
    with pytest.raises(UserError, match="expected 0 to 1"):
        envs.start_next(3)
    assert len(envs.jobs) == 1
    envs.start_next(0)
    with pytest.raises(UserError, match="recv"):
        envs.send(0, "go")


@pytest.mark.slow
def test_closing_ends_all_processes_even_busy_ones() -> None:
    before = processes()
    envs = VecEnv(
        [Job("StopCube", "test", 0), Job("StopCube", "test", 1)],
        2,
        partial(make_light_env, video=20),
    )
    with pytest.raises(UserError, match="runs no episode"):
        envs.send(0, "go")
    for worker in range(2):
        envs.start_next(worker)
    ready = envs.recv()[0].worker
    envs.send(ready, "hang")
    start = time.monotonic()
    envs.close()
    envs.close()
    assert time.monotonic() - start < 20
    assert processes() <= before
    for use in (envs.recv, lambda: envs.send(0, 1), lambda: envs.start_next(0)):
        with pytest.raises(UserError, match="closed"):
            use()


def test_closing_ends_a_worker_whose_reply_nobody_took(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pool, "_CLOSING_SECONDS", 60.0)  # of a busy machine
    envs = VecEnv([Job("StopCube", "test", 0)], 1, partial(make_light_env, video=20))
    envs.start_next(0)
    assert envs._workers[0].connection.poll(60)
    start = time.monotonic()
    envs.close()
    assert time.monotonic() - start < pool._CLOSING_SECONDS, "it had to be terminated"


def test_a_script_without_a_guard_ends_with_an_error_that_names_it(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(
        "from mme_vla.envs.vector.pool import Job, VecEnv\n"
        "with VecEnv([Job('StopCube', 'test', 0)], 1, dict) as envs:\n"
        "    envs.start_next(0)\n"
        "    envs.recv()\n"
        "    print('went on')\n"
    )
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, cwd=tmp_path)
    *_, last = done.stderr.splitlines()
    assert last.startswith("mme_vla.errors.UserError: ") and "__main__" in last
    assert (done.returncode, done.stdout, "During handling" in done.stderr) == (1, "", False)


def tell(inherited: tuple[Any, Any], file: Path) -> None:
    """What a process finds when it begins."""
    begin(*inherited)
    file.write_text(
        f"{os.environ.get('SETTING')} {gc.get_freeze_count()} {'sapien' in sys.modules}"
    )


def test_processes_begin_with_the_settings_of_their_time_and_all_imports_left_out_of_collections(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("sapien", reason="needs the simulator: uv sync --inexact --extra sim")
    for value in ("first", "second"):
        monkeypatch.setenv("SETTING", value)
        process = simulating_processes().Process(target=tell, args=(settings(), tmp_path / value))
        process.start()
        process.join(60)
        setting, frozen, imported = (tmp_path / value).read_text().split()
        assert (setting, imported) == (value, "True") and int(frozen) > 100_000


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"tasks": "StopCub"}, "Did you mean 'StopCube'"),
        ({"tasks": []}, "at least one"),
        ({"tasks": "StopCube", "episodes": [50]}, "which has 50: 0 to 49"),
        ({"tasks": "StopCube", "workers": 0}, "positive integer"),
        ({"tasks": "StopCube", "timeout": 0}, "positive number"),
        ({"tasks": "StopCube", "action_space": "joints"}, "joint_angle"),
    ],
)
def test_unknown_names_are_refused_before_any_process_starts(
    monkeypatch: pytest.MonkeyPatch, arguments: dict[str, Any], words: str
) -> None:
    monkeypatch.setattr("mme_vla.envs.make.require_simulator", lambda: None)
    with pytest.raises(UserError, match=words):
        make_vec_env(**arguments)


def test_its_episodes_are_those_of_the_split() -> None:
    for scene in ({"seed": 3}, {"row": {"task": "StopCube", "spec": {}}}, {"recovery": "z"}):
        with pytest.raises(TypeError, match="unexpected keyword argument"):
            make_vec_env("StopCube", [0], **scene)  # type: ignore[arg-type]


def test_an_environment_of_ones_own_takes_no_reward(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(pool, "environment", lambda name: Environment)
    monkeypatch.setattr(Environment, "check_installed", lambda: None)
    with pytest.raises(UserError, match="env=own takes no reward and no include: they are for"):
        make_vec_env("Own", [0], env="own", reward="sparse")


def test_real_environments_run_in_workers() -> None:
    pytest.importorskip(
        "mani_skill", reason="the simulator is not installed: uv sync --inexact --extra sim"
    )
    with make_vec_env("VideoUnmask", [4], workers=1, split="train", render=False) as envs:
        envs.start_next(0)
        reply = only(envs.recv())
        assert len(reply.observation["joint_state_list"]) == 67
        assert reply.info["task_goal"] == [
            "watch the video carefully, then pick up the container hiding the blue cube"
        ]
        envs.send(0, np.append(reply.observation["joint_state_list"][-1], 1.0))
        reply = only(envs.recv())
        assert reply.info["status"] == "ongoing"
        assert float(reply.reward) == 0.0
