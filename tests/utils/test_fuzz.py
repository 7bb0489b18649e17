"""A few mutations of each kind of file, as `benchmarks/fuzz.py` makes two hundred."""

from pathlib import Path

import pytest

from benchmarks import fuzz
from mme_vla.errors import UserError


@pytest.mark.parametrize("kind", ["cache", "hdf5", "logs", "kept-answers", "answers", "rows", "metadata"])
def test_damage_raises_a_user_error_or_changes_nothing(kind: str) -> None:
    cases = fuzz.fuzz(kind, fuzz.TARGETS[kind], mutations=4, seed=1)
    assert len(cases) == 4
    assert [case for case in cases if case.outcome in fuzz.BAD] == []


def test_a_careless_reader_is_detected() -> None:
    """A reader that trusts its file, raises other errors, waits and writes long messages."""

    def read(folder: Path) -> object:
        path = folder / "text.txt"
        if path.is_fifo():
            return path.read_text()
        if path.is_dir():
            raise UserError("x" * 3000)
        return path.read_bytes() if path.exists() else 1 // 0

    target = fuzz.Target(lambda folder: (folder / "text.txt").write_text("a" * 50), read)
    outcomes = {case.outcome for case in fuzz.fuzz("careless", target, mutations=16, seed=1, seconds=1)}
    assert outcomes >= set(fuzz.BAD)
