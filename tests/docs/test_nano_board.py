"""The pages of nanoMME's board hold what its committed rows say."""

import lzma
from pathlib import Path

import nano_board
import published
import pytest

from helpers.nano_rows import TASKS, write_training
from helpers.published import published_folder
from mme_vla.evaluation.receipts import read_receipt, verify
from mme_vla.utils import with_checksum, write_json


@pytest.mark.nightly
def test_the_pages_are_those_of_the_committed_rows() -> None:
    made = nano_board.boards()
    for path, text in nano_board.pages(made).items():
        assert path.read_text() == text, (
            f"run `python scripts/nano_board.py`: {path.name} differs from the rows"
        )
    assert not made or nano_board.FIGURE.is_file()


def test_committed_rows_are_compressed_and_small() -> None:
    files = [path for path in nano_board.rows_folder().rglob("*") if path.is_file()]
    assert not any(path.suffix == ".jsonl" for path in files)
    assert sum(path.stat().st_size for path in files) <= 5e6


@pytest.mark.nightly
def test_receipts_of_committed_rows_fit_their_records() -> None:
    paths = [
        *nano_board.rows_folder().rglob("receipt.json"),
        *published_folder("reserved").rglob("receipt.json"),
    ]
    assert paths
    for path in paths:
        differences, *_ = verify(path)
        of_the_row = ("settings", "records", "score", "scenes")
        assert not [line for line in differences if line.startswith(of_the_row)], path
        folders = [part["checkpoint"]["folder"] or "" for part in read_receipt(path)["conditions"]]
        assert not any(folder.startswith("/") for folder in folders), path


def test_rows_of_a_run_are_added_and_reach_the_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rows that are not there yet are named, and no number is written for them."""
    assert nano_board.block(None).startswith(
        "Not run yet: `demonstrator`, "
    ) and "|" not in nano_board.block(None)
    assert len(nano_board.VARIANTS) == 14
    monkeypatch.setattr(nano_board, "rows_folder", lambda: tmp_path / "rows")
    packed_tables: list[str] = []
    monkeypatch.setattr(published, "replace", lambda name, folder: packed_tables.append(name))
    for seed, won in enumerate((3, 2)):
        write_training(tmp_path / "run", "framesamp_modul", seed, won)
    write_training(tmp_path / "run", "pi05", 0, {TASKS[0]: 1})
    write_json(
        tmp_path / "run" / "scenes.json", {"split": "further", "tried": {f"{TASKS[0]} 0": ""}}
    )
    conditions = {"checkpoint": {"folder": "/somewhere/pi05/0", "files": {}}}
    receipt = {
        "settings": {"source": "pi05/0"},
        "conditions": [conditions],
        "records": {},
        "scenes": "",
        "score": {},
    }
    write_json(tmp_path / "run" / "pi05" / "0" / "receipt.json", with_checksum(receipt))
    nano_board.add(tmp_path / "run" / "pi05")
    added = read_receipt(tmp_path / "rows" / "further" / "pi05" / "0" / "receipt.json")
    assert added["conditions"][0]["checkpoint"]["folder"] == "pi05/0"
    assert [path.name for path in sorted((tmp_path / "rows" / "further").iterdir())] == [
        "pi05",
        "scenes.json",
    ]
    packed = tmp_path / "run" / "pi05" / "0" / "episodes.jsonl"
    packed.with_suffix(".jsonl.xz").write_bytes(lzma.compress(packed.read_bytes()))
    packed.unlink()
    nano_board.add(tmp_path / "run")
    (board,) = nano_board.boards()
    text = nano_board.block(board)
    assert (
        "| framesamp_modul | 1 [1, 1] | 2 | 83.33 ± 23.57 |" in text
        and "Not run yet: `demonstrator`" in text
    )
    assert "`framesamp_modul`" not in text.partition("Not run yet")[2]
    write_training(tmp_path / "motions", "framesamp_modul", 0, 1, action_space="waypoint")
    nano_board.add(tmp_path / "motions")
    assert (
        tmp_path / "rows" / "further-waypoint" / "framesamp_modul" / "0" / "trained.json"
    ).is_file()
    assert set(packed_tables) == {"nano16/further", "nano16/further-waypoint"}
    both = nano_board.boards()
    assert [made.action_space for made in both] == ["multi_choice", "waypoint"]
    page = nano_board.evidence(both)
    assert page.count("### Success by task (%)") == 2 and "## Split `further`, `waypoint`" in page
    assert nano_board.block(both[0]) == text
