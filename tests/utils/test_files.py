"""The readers and writers every room uses: what lies in a file's place, names that lead elsewhere,
sums, locks.
"""

import errno
import json
import os
import signal
import subprocess
import sys
import tracemalloc
from pathlib import Path
from typing import Any

import pytest

from mme_vla.errors import UserError, require
from mme_vla.utils import (
    SUMS,
    FolderLock,
    Sums,
    check_sums,
    inside,
    io,
    read_bytes,
    read_json,
    read_lines,
    read_text,
    safe_name,
    to_line,
    write_atomically,
    write_json,
    write_sums,
)
from mme_vla.utils.io import disk_trouble

DEEP = "[" * 200_000


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"{", "not valid JSON"),
        (b"", "not valid JSON"),
        (DEEP.encode(), "nested too deeply"),
        (b"[1]", "an object"),
        (b'{"a": 1' + b"0" * 5000 + b"}", "not valid JSON"),
        (b'{"a": Infinity}', "Infinity is not a number"),
        (b'{"a": 1e999}', "out of range"),
        (b'{"a": "\xff"}', "not UTF-8"),
        (b'{"a": {"b": 1, "c": 2, "b": 1}}', "the key 'b' is there twice"),
    ],
    ids=["cut", "empty", "deep", "list", "digits", "infinity", "overflow", "latin", "twice"],
)
def test_damaged_json_is_one_short_sentence_that_names_the_file(
    tmp_path: Path, content: bytes, words: str
) -> None:
    file = tmp_path / "plan.json"
    file.write_bytes(content)
    with pytest.raises(UserError, match=words) as caught:
        read_json(file)
    assert str(file) in str(caught.value)
    assert len(str(caught.value)) < 1000


def test_whatever_stands_in_a_files_place_is_refused_without_waiting(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "endless").symlink_to("/dev/zero")
    (tmp_path / "folder").mkdir()
    (tmp_path / "loop").symlink_to("loop")
    (tmp_path / "large").write_bytes(b" " * 101)
    for name in ("pipe", "endless", "folder", "loop", "missing", "large", "nu\0l"):
        with pytest.raises(UserError):
            read_text(tmp_path / name, limit=100)


def test_a_file_that_is_refused_is_not_left_open(tmp_path: Path) -> None:
    (tmp_path / "large").write_bytes(b" " * 101)
    (tmp_path / "folder").mkdir()
    before = len(list(Path("/proc/self/fd").iterdir()))
    for name in ("large", "folder"):
        with pytest.raises(UserError):
            read_text(tmp_path / name, limit=100)
    assert len(list(Path("/proc/self/fd").iterdir())) == before


def named(row: dict[str, Any]) -> dict[str, Any]:
    require("name" in row, "there is no name")
    return row


def test_lines_are_read_back(tmp_path: Path) -> None:
    file, values = (
        tmp_path / "log.jsonl",
        [{"name": "\u2028", "ages": [3, 4]}, {"name": "b", "value": None}],
    )
    file.write_text("".join(f"{to_line(value)}\n" for value in values))
    assert read_lines(file, named) == values


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ('{"name"', "line 2 is not valid JSON"),
        ("{}", "line 2: there is no name"),
        ("[]", "an object"),
        ('{"name": NaN}', "NaN"),
        ('{"name": "a", "crc32": "0"}', "line 2 is not what was written"),
    ],
)
def test_damaged_line_is_reported_with_its_number(tmp_path: Path, line: str, message: str) -> None:
    file = tmp_path / "log.jsonl"
    file.write_text(f'{{"name": "a", "value": 1}}\n{line}\n')
    with pytest.raises(UserError, match=message):
        read_lines(file, named)


def test_half_written_last_line_is_ignored_with_a_warning(tmp_path: Path) -> None:
    file = tmp_path / "log.jsonl"
    file.write_text(f"{to_line({'name': 'a'})}\n{to_line({'name': 'b'})[:-2]}")
    with pytest.warns(UserWarning, match="half-written"):
        assert read_lines(file, named) == [{"name": "a"}]


def test_a_write_that_fails_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    file = tmp_path / "plan.json"
    write_json(file, {"a": 1})
    with pytest.raises(KeyboardInterrupt), write_atomically(file) as draft:
        draft.write_text("half")
        raise KeyboardInterrupt
    with pytest.raises(ValueError, match="JSON"):
        write_json(file, {"a": float("nan")})
    assert json.loads(file.read_text()) == {"a": 1}
    assert [path.name for path in tmp_path.iterdir()] == ["plan.json"]


def test_a_name_that_leads_out_of_its_folder_is_refused(tmp_path: Path) -> None:
    folder = tmp_path / "checkpoint"
    (folder / "sub").mkdir(parents=True)
    (folder / "model").write_text("")
    (folder / "link").symlink_to(tmp_path / "secret")
    (folder / "near").symlink_to("model")
    assert inside(folder, "sub/../model").is_file()
    assert inside(folder, "near").is_file()
    for name in ("../secret", "/etc/passwd", "link", "", ".", "sub/../../secret", "nu\0l"):
        with pytest.raises(UserError, match="outside"):
            inside(folder, name)


def test_a_shipped_file_may_be_a_link_to_the_cache_of_an_installer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "site-packages" / "mme_vla" / "assets" / "nano"
    folder.mkdir(parents=True)
    (tmp_path / "cached").write_text("{}")
    (folder / "config.json").symlink_to(tmp_path / "cached")
    with pytest.raises(UserError, match="outside"):
        inside(folder, "config.json")
    monkeypatch.setattr(io, "_PACKAGE", tmp_path / "site-packages" / "mme_vla")
    assert inside(folder, "config.json").read_text() == "{}"
    for name in ("../../../../cached", str(tmp_path / "cached"), ""):
        with pytest.raises(UserError, match="outside"):
            inside(folder, name)


def test_names_of_folders_hold_no_paths() -> None:
    assert safe_name("tokendrop_expert") == "tokendrop_expert"
    for name in ("../x", "/x", "a/b", "", ".hidden", "x" * 101, "a\nb"):
        with pytest.raises(UserError, match="cannot name a folder"):
            safe_name(name)


def test_a_flipped_bit_is_detected_by_its_sum(tmp_path: Path) -> None:
    (tmp_path / "weights").write_bytes(b"\0" * 64)
    (tmp_path / "config").write_text("{}")
    assert not Sums(tmp_path).there
    write_sums(tmp_path)
    (tmp_path / "note").write_text("added later")
    files = ["config", "weights"]
    assert sorted(Sums(tmp_path).table) == files
    check_sums(tmp_path, files)
    (tmp_path / "weights").write_bytes(b"\0" * 63 + b"\1")
    check_sums(tmp_path, ["config"])
    with pytest.raises(UserError, match="weights is damaged"):
        check_sums(tmp_path, files)
    (tmp_path / "weights").unlink()
    with pytest.raises(UserError, match="missing"):
        check_sums(tmp_path, files)
    (tmp_path / SUMS).write_text("nonsense\n")
    with pytest.raises(UserError, match="line 1"):
        check_sums(tmp_path, files)


def test_the_sums_are_those_of_sha256sum(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"abc")
    write_sums(tmp_path)
    known = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
    assert (tmp_path / SUMS).read_text() == f"{known}  a\n"


def test_folder_lock_holds_until_its_process_is_killed(tmp_path: Path) -> None:
    hold = "import sys; from pathlib import Path; from mme_vla.utils import FolderLock\n"
    hold += (
        "lock = FolderLock(Path(sys.argv[1])).acquire(); print('held', flush=True);"
        " sys.stdin.read()"
    )
    other = subprocess.Popen(
        [sys.executable, "-c", hold, tmp_path],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert other.stdout is not None
    assert other.stdout.readline() == "held\n"
    with pytest.raises(UserError, match=f"process {other.pid}"):
        FolderLock(tmp_path).acquire()
    other.kill()
    other.communicate()
    with FolderLock(tmp_path), pytest.raises(UserError, match="in use"):
        FolderLock(tmp_path).acquire()
    FolderLock(tmp_path).acquire().release()


FORK = """
import os, sys, time
from pathlib import Path
from mme_vla.utils import FolderLock

lock = FolderLock(Path(sys.argv[1])).acquire()
child = os.fork()
if child == 0:
    os.close(1)
    time.sleep(60)
print(child, flush=True)
os._exit(0)
"""


@pytest.mark.parametrize("is_made_again", [False, True])
@pytest.mark.parametrize("error", [None, FileNotFoundError("missing")])
def test_a_folder_that_is_removed_during_the_work_is_named(
    is_made_again: bool, error: Exception | None, tmp_path: Path
) -> None:
    folder = tmp_path / "cache"
    with (
        pytest.raises(UserError, match=r"cache was removed or moved while this build was writing"),
        FolderLock(folder, "build"),
    ):
        folder.rename(tmp_path / "elsewhere")
        if is_made_again:
            folder.mkdir()
        if error is not None:
            raise error


def test_another_error_than_of_a_removed_folder_passes(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt), FolderLock(tmp_path / "cache"):
        (tmp_path / "cache").rename(tmp_path / "elsewhere")
        raise KeyboardInterrupt


def test_forked_process_does_not_keep_the_lock(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", FORK, tmp_path], stdout=subprocess.PIPE, text=True, check=True
    )
    try:
        FolderLock(tmp_path).acquire().release()
    finally:
        os.kill(int(done.stdout), signal.SIGKILL)


def test_reading_takes_the_memory_that_a_file_needs_not_its_limit(tmp_path: Path) -> None:
    (tmp_path / "small").write_bytes(b"text")
    tracemalloc.start()
    try:
        assert read_bytes(tmp_path / "small", limit=2**28) == b"text"
        assert tracemalloc.get_traced_memory()[1] < 2**20
    finally:
        tracemalloc.stop()


def test_errors_that_cause_each_other_are_described_once() -> None:
    full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "/full/disk")
    outer = RuntimeError("cannot save")
    outer.__cause__ = full
    full.__cause__ = outer
    assert str(disk_trouble(outer)).startswith("/full/disk cannot be written or opened")


def test_a_user_without_a_home_folder_has_the_caches_that_a_variable_names(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def home() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.setattr(Path, "home", home)
    monkeypatch.setenv("MME_VLA_CACHE", str(tmp_path))
    assert io.user_cache("robots") == tmp_path / "robots"
