"""A few mutations of each kind of file, in the way of `benchmarks/fuzz.py`, which does two hundred."""

from pathlib import Path

import pytest

from benchmarks import fuzz
from benchmarks.fuzz_targets.base import Target, every_file

QUICK = ("cache", "hdf5", "logs", "kept-answers", "answers", "rows", "metadata")


@pytest.mark.parametrize("kind", QUICK)
def test_damage_is_refused_in_words_or_does_no_harm(kind: str) -> None:
    cases = fuzz.fuzz(fuzz.targets()[kind], mutations=4, seed=1)
    assert len(cases) == 4
    assert [case for case in cases if case.outcome in fuzz.BAD] == []


def test_the_fuzzer_finds_what_it_looks_for() -> None:
    """A reader that believes everything, stumbles, hangs and talks too much is found out."""

    def careless(folder: Path) -> object:
        from mme_vla.errors import UserError

        path = folder / "text.txt"
        if path.is_fifo():
            return path.read_text()
        if path.is_dir():
            raise UserError("x" * 3000)
        return path.read_bytes() if path.exists() else 1 // 0

    target = Target("careless", lambda folder: (folder / "text.txt").write_text("a" * 50), every_file, careless)
    found = {case.outcome for case in fuzz.fuzz(target, mutations=16, seed=1, seconds=1)}
    assert found >= set(fuzz.BAD)


def test_the_same_seed_damages_in_the_same_ways() -> None:
    target = fuzz.targets()["metadata"]
    assert fuzz.fuzz(target, mutations=2, seed=3) == fuzz.fuzz(target, mutations=2, seed=3)
