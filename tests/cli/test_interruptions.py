"""Commands that are interrupted, refused by the disk, or met by a second process in
their folder.
"""

import errno
import os
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from helpers.h5_files import write_file
from mme_vla.cli.errors import Terminated, print_user_errors
from mme_vla.data.convert import ConvertOptions, convert
from mme_vla.data.hdf5 import find_files, list_episodes
from mme_vla.envs.robomme.recording.outputs import Job, RecordingPlan
from mme_vla.errors import UserError
from mme_vla.training.runs import MAY_DIFFER, SUMMARY, check_content, claim_run
from mme_vla.utils import (
    PLAN,
    FolderLock,
    claim_plan,
    draft_of,
    drop_plan,
    remove_drafts,
    write_atomically,
    write_json,
)

PNG = ConvertOptions(images="png")
CONFIG = {"train": {"steps": 3}, "seed": 1}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("number", "code", "words"), [("SIGINT", 130, "Ctrl-C"), ("SIGTERM", 143, "SIGTERM")]
)
def test_a_signal_ends_a_command_with_a_sentence_and_the_shells_code(
    number: str, code: int, words: str
) -> None:
    script = f"""
        import signal
        from mme_vla.cli.errors import print_user_errors
        signal.signal(signal.SIGINT, signal.default_int_handler)  # whatever the parent did with it
        with print_user_errors(), print_user_errors():
            signal.raise_signal(signal.{number})
    """
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(script)], capture_output=True, text=True
    )
    assert (done.returncode, "Traceback" in done.stderr) == (code, False)
    assert done.stderr.count("\n") == 1
    assert f"Stopped by {words}" in done.stderr


@pytest.mark.parametrize(
    ("stop", "code"), [(KeyboardInterrupt(), 130), (Terminated(), 143)], ids=["Ctrl-C", "SIGTERM"]
)
@pytest.mark.parametrize(
    "hidden", [AttributeError("half-made"), UserError("cannot be composed")], ids=["bug", "user"]
)
def test_a_signal_is_reported_though_a_finally_fails(
    stop: BaseException, code: int, hidden: Exception, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended, print_user_errors():
        try:
            raise stop
        finally:
            raise hidden
    assert ended.value.code == code
    assert "Stopped by" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("error", "words"),
    [
        (
            OSError(errno.ENOSPC, "No space left on device", "a/metrics.jsonl"),
            "a/metrics.jsonl cannot be written",
        ),
        (
            OSError(errno.EROFS, "Read-only file system", "b"),
            "b cannot be written or opened: Read-only file system",
        ),
        (OSError(errno.EFBIG, "File too large", "b"), "File too large"),
        (OSError(errno.EMFILE, "Too many open files", "b"), "Too many open files"),
        (PermissionError(errno.EACCES, "Permission denied", "b"), "Permission denied"),
        (
            OSError("Unable to create file (name = 'c.h5', errno = 28, error message = '…')"),
            "c.h5",
        ),
        (
            RuntimeError("I/O error: No space left on device (os error 28)"),
            "No space left on device",
        ),
        (OSError("4000 requested and 96 written"), "No space left on device"),
    ],
)
def test_what_the_disk_refuses_is_reported_in_one_sentence(
    capsys: pytest.CaptureFixture[str], error: Exception, words: str
) -> None:
    with pytest.raises(SystemExit) as ended, print_user_errors():
        raise error
    stderr = capsys.readouterr().err
    assert ended.value.code == 1
    assert words in stderr
    assert "epeat" in stderr


def test_other_errors_keep_their_traceback() -> None:
    for error in (
        ValueError("errno = 28"),
        PermissionError(errno.EACCES, "a port"),
        OSError("strange"),
    ):
        with pytest.raises(type(error)), print_user_errors():
            raise error


@pytest.mark.slow
def test_drafts_of_killed_processes_are_removed_and_those_of_others_are_not(tmp_path: Path) -> None:
    mine, other_draft = draft_of(tmp_path / "a"), tmp_path / ".a.elsewhere-1-00000000.partial"
    ended = subprocess.Popen(["true"])
    ended.wait()
    dead = tmp_path / mine.name.replace(f"-{os.getpid()}-", f"-{ended.pid}-")
    for path in (mine, other_draft, dead):
        path.touch()
    remove_drafts(tmp_path)
    assert set(tmp_path.iterdir()) == {mine, other_draft}


def test_a_second_attempt_at_a_file_removes_the_draft_of_a_killed_one(tmp_path: Path) -> None:
    ended = subprocess.Popen(["true"])
    ended.wait()
    mine = draft_of(tmp_path / "page.html")
    dead = mine.name.replace(f"-{os.getpid()}-", f"-{ended.pid}-")
    for name in (mine.name, dead, dead.replace("page.html", "other.page.html")):
        (tmp_path / name).touch()
    with write_atomically(tmp_path / "page.html") as draft:
        draft.touch()
    left = {path.name for path in tmp_path.iterdir()}
    assert left == {"page.html", mine.name, dead.replace("page.html", "other.page.html")}


def test_an_incomplete_plan_is_ignored(tmp_path: Path) -> None:
    (tmp_path / PLAN).write_text('{"epis')
    (tmp_path / "episodes").mkdir()
    assert claim_plan(tmp_path, {"a": 1})
    assert claim_plan(tmp_path, {"a": 1})
    assert not claim_plan(tmp_path, {"a": 2})
    (tmp_path / PLAN).write_text('{"epis')
    (tmp_path / "episodes" / "finished").touch()
    assert not claim_plan(tmp_path, {"a": 1}), "another run's files are there"
    drop_plan(tmp_path, "episodes/finished")
    assert list(tmp_path.iterdir()) == []


def test_a_plan_that_is_done_removes_its_own_work_and_nothing_else(tmp_path: Path) -> None:
    with FolderLock(tmp_path / "out.partial") as lock:
        work = lock.folder
        claim_plan(work, {"a": 1})
        for name in (
            "episodes/000001-Task-episode_1/part",
            "episodes/thesis.txt",
            "merged/meta",
            "notes.md",
        ):
            (work / name).parent.mkdir(parents=True, exist_ok=True)
            (work / name).write_text("mine")
        drop_plan(work, "episodes/[0-9]*-*", "merged", "writing")
    assert {path.relative_to(work).as_posix() for path in work.rglob("*")} == {
        "episodes", "episodes/thesis.txt", "notes.md",
    }  # fmt: skip


def test_a_conversion_leaves_what_somebody_put_into_its_work_folder(tmp_path: Path) -> None:
    write_file(tmp_path / "record_dataset_Alpha.h5", [4])
    refs = list_episodes(find_files([tmp_path]))
    convert(refs, tmp_path / "out", PNG)
    (tmp_path / "out.partial" / "episodes").mkdir(parents=True)
    (tmp_path / "out.partial" / "episodes" / "notes.txt").write_text("mine")
    assert convert(refs, tmp_path / "out", PNG) == 0
    assert (tmp_path / "out.partial" / "episodes" / "notes.txt").read_text() == "mine"


def test_a_conversion_notices_that_an_input_changed_at_the_same_size(tmp_path: Path) -> None:
    write_file(tmp_path / "record_dataset_Alpha.h5", [4])
    convert(list_episodes(find_files([tmp_path])), tmp_path / "out", PNG)
    import h5py

    with h5py.File(tmp_path / "record_dataset_Alpha.h5", "r+") as file:
        file["episode_0/timestep_1/action/joint_action"][0] += 1
    refs = list_episodes(find_files([tmp_path]))
    with pytest.raises(UserError, match="other content of a file"):
        convert(refs, tmp_path / "out", PNG)


def test_a_second_conversion_into_one_folder_is_refused(tmp_path: Path) -> None:
    write_file(tmp_path / "record_dataset_Alpha.h5", [4])
    refs = list_episodes(find_files([tmp_path]))
    with (
        FolderLock(tmp_path / "out.partial"),
        pytest.raises(UserError, match="in use by another conversion"),
    ):
        convert(refs, tmp_path / "out", PNG)


def test_runs_that_begin_in_one_second_take_separate_folders(tmp_path: Path) -> None:
    place = tmp_path / "2026-01-01_00-00-00"
    first, first_lock = claim_run(place, False, None, CONFIG)
    second, too = claim_run(place, False, None, CONFIG)
    assert (first.folder, second.folder) == (place, place.with_name(f"{place.name}-2"))
    with pytest.raises(UserError, match="in use by another training run"):
        claim_run(place, True, None, CONFIG)
    first_lock.release()
    too.release()
    write_json(place / SUMMARY, {})
    third, lock = claim_run(place, False, None, CONFIG)
    lock.release()
    assert third.folder == second.folder, "the first folder holds a run by now"


def test_training_data_that_changed_are_noticed(tmp_path: Path) -> None:
    checkpoint = tmp_path / "step_000001"
    checkpoint.mkdir()
    for name in ("raw.safetensors", "optimizer.safetensors"):
        (checkpoint / name).touch()
    state = {"format": "mme_vla training checkpoint 1", "step": 1, "versions": {}}
    state["config"] = {"data": {"content": ["a", "b"]}}
    write_json(checkpoint / "training_state.json", state)
    check_content(checkpoint, ["a", "b"])
    with pytest.raises(UserError, match=r"number 1 of data\.sources"):
        check_content(checkpoint, ["a", "c"])
    of_facts = {"meta/facts.csv": "1"}
    check_content(checkpoint, ["a", "b"], [{}, of_facts])  # of an earlier version
    state["config"]["data"]["side_files"] = [{}, of_facts]
    write_json(checkpoint / "training_state.json", state)
    check_content(checkpoint, ["a", "b"], [{}, of_facts])
    with pytest.raises(UserError, match=r"number 1 of data\.sources has another meta/facts\.csv"):
        check_content(checkpoint, ["a", "b"], [{}, {"meta/facts.csv": "2"}])
    assert "data.content" in MAY_DIFFER, "it is compared when the data are open, not before"


def test_a_finished_recording_is_recognised_and_others_are_not(tmp_path: Path) -> None:
    write_file(tmp_path / "record_dataset_Alpha.h5", [4], numbers=[1])
    job = Job("Alpha", 1, seed=98, difficulty="easy", recovery=None, retries=3)
    assert RecordingPlan([job], None, tmp_path).missing(PNG) == []
    (tmp_path / "empty").mkdir()
    assert RecordingPlan([job], tmp_path / "empty", None).missing(PNG) == [tmp_path / "empty"]
    other = Job("Alpha", 1, seed=101, difficulty="easy", recovery=None, retries=3)
    with pytest.raises(UserError, match="not what this command records"):
        RecordingPlan([other], None, tmp_path).missing(PNG)
    assert RecordingPlan([job], tmp_path / "dataset", None).missing(PNG) == [tmp_path / "dataset"]
