"""Packed files are read to their end, within a limit; what is no packed file is
refused in words.
"""

import lzma
from pathlib import Path

import pytest

from mme_vla.errors import UserError
from mme_vla.utils import read_unpacked

FIRST, SECOND = b"one\n" * 1000, b"two\n" * 1000


def packed(folder: Path, data: bytes) -> Path:
    path = folder / "episodes.jsonl.xz"
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("padding", [b"", b"\0" * 4, b"\0" * 8])
def test_all_streams_of_a_file_are_read(padding: bytes, tmp_path: Path) -> None:
    path = packed(
        tmp_path, lzma.compress(FIRST) + padding + lzma.compress(SECOND) + lzma.compress(b"")
    )
    assert read_unpacked(path) == FIRST + SECOND


@pytest.mark.parametrize("rubbish", [b"rubbish", b"{}\n", lzma.compress(FIRST)[:20]])
def test_what_follows_the_last_stream_is_refused(rubbish: bytes, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"episodes\.jsonl\.xz"):
        read_unpacked(packed(tmp_path, lzma.compress(FIRST) + rubbish))


@pytest.mark.parametrize("parts", [(FIRST + SECOND,), (FIRST, SECOND), (b"", FIRST, SECOND)])
def test_the_limit_holds_for_all_streams_together(parts: tuple[bytes, ...], tmp_path: Path) -> None:
    path = packed(tmp_path, b"".join(map(lzma.compress, parts)))
    assert len(read_unpacked(path, limit=8000)) == 8000
    with pytest.raises(UserError, match="more than 7,999"):
        read_unpacked(path, limit=7999)


def test_a_stream_that_is_cut_off_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="cut off"):
        read_unpacked(packed(tmp_path, lzma.compress(FIRST)[:-10]))


def test_many_small_streams_are_read(tmp_path: Path) -> None:
    assert read_unpacked(packed(tmp_path, lzma.compress(b"one\n") * 20_000)) == b"one\n" * 20_000
