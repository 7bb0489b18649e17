"""Write the table, the figure and the evidence page of nanoMME from the published rows.

    python scripts/nano_board.py                                # pages, from the committed rows
    python scripts/nano_board.py --add outputs/nano16/reserved  # add the rows of a run first

The rows are archives in mme_vla/assets/board, see scripts/published.py.
"""

import argparse
import lzma
import re
import shutil
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import published

from mme_vla.evaluation.receipts import read_receipt
from mme_vla.evaluation.results.paper import paper_methods
from mme_vla.evaluation.results.tables import Table, to_markdown
from mme_vla.evaluation.store import RECORDS
from mme_vla.extras.nano import board_page
from mme_vla.extras.nano.board import MATCHED, Board
from mme_vla.extras.nano.rows import CHOICES, FILES, SCENES, read_rows, read_training
from mme_vla.utils import read_json, with_checksum, write_json

ROOT = Path(__file__).resolve().parents[1]
_UNPACKED = TemporaryDirectory(prefix="mme-vla-board-")
PAGE, EVIDENCE, FIGURE = (
    ROOT / "docs" / name
    for name in ("train/nano.md", "evidence/nano-board.md", "images/nano16.svg")
)
BLOCK = re.compile(r"(?<=<!-- board -->\n).*?(?=<!-- /board -->)", re.DOTALL)
VARIANTS = [
    method.model for method in paper_methods().values()
    if method.model and (method.family in ("perceptual", "recurrent") or method.subgoal == "oracle")
]  # fmt: skip
EXPECTED = ["demonstrator", "oracle_frames", *VARIANTS, "pi05", MATCHED, "frequent", "random"]
"""The rows of the benchmark: ceilings, the paper's variants, floors."""


@cache
def rows_folder() -> Path:
    """The rows, unpacked, a folder for each table."""
    for name in published.BOARD_TABLES:
        published.unpack(name, Path(_UNPACKED.name))
    return Path(_UNPACKED.name) / "nano16"


def add(folder: Path) -> None:
    """Copy the rows of a run's split into the folder of their table, checked, with compressed
    records.
    """
    for place in sorted(path.parent for path in folder.rglob("trained.json")):
        training = read_training(place)
        archive = f"nano16/{training.table}"
        if archive not in published.BOARD_TABLES:
            raise SystemExit(f"Name the archive of {archive} in scripts/published.py first.")
        table = rows_folder() / training.table
        target = table / training.facts.row / str(training.facts.seed)
        target.mkdir(parents=True, exist_ok=True)
        for name in FILES:
            shutil.copyfile(place / name, target / name)
        files = sorted(place.glob("episodes*.jsonl*"))
        lines = b"".join(
            lzma.decompress(f.read_bytes()) if f.suffix == ".xz" else f.read_bytes() for f in files
        )
        (target / f"{RECORDS}.xz").write_bytes(lzma.compress(lines, preset=9))
        (target / "receipt.json").unlink(missing_ok=True)
        if (receipt := place / "receipt.json").is_file():
            copy_receipt(receipt, target / receipt.name)
        if (scenes := place.parents[1] / SCENES).is_file():
            add_scenes(scenes, table / SCENES)
        published.replace(archive, table)
        print(f"added {target.relative_to(rows_folder())}")


def add_scenes(file: Path, target: Path) -> None:
    """Add the scenes that a run tried to those of its table."""
    scenes, listed = (
        read_json(path, "the scenes of a split") if path.is_file() else {}
        for path in (file, target)
    )
    write_json(
        target,
        {**scenes, "tried": dict(sorted((scenes["tried"] | listed.get("tried", {})).items()))},
    )


def copy_receipt(receipt: Path, target: Path) -> None:
    """Copy the receipt of records, with the checkpoint's folder in its run in place of that on this
    machine.
    """
    content = read_receipt(receipt)
    for part in content["conditions"]:
        part["checkpoint"]["folder"] = content["settings"].get("source")
    write_json(target, with_checksum(content))


def boards() -> list[Board]:
    """A board for each split and action space that has rows: those of choices first, then those
    with most rows.
    """
    tables = sorted({path.parents[2] for path in rows_folder().rglob("trained.json")})
    made = [Board(read_rows([table])) for table in tables]
    return sorted(made, key=lambda board: (board.action_space != CHOICES, -len(board.rows)))


def block(board: Board | None) -> str:
    """The part of the user's page that comes from the rows."""
    if board is None:
        return f"Not run yet: {_names(EXPECTED)}.\n"
    missing = [name for name in EXPECTED if name not in {row.name for row in board.rows}]
    lines = [
        *board_page.notes(board),
        *board_page.separating(board),
        *([f"Not run yet: {_names(missing)}."] if missing else []),
    ]
    table = untitled(board_page.ranking(board, brief=True))
    figure = f"![Success of every row with its interval](../images/{FIGURE.name})"
    return "\n".join([table, figure, "", *(f"- {line}" for line in lines), ""])


def evidence(made: list[Board]) -> str:
    """The page with every table."""
    head = (
        "# nanoMME-16: the board\n\nEvery table of the [board](../train/nano.md), "
        "from the rows in `mme_vla/assets/board`, written by `python scripts/nano_board.py`.\n"
    )
    parts = [head] + ([] if made else ["Not run yet.\n"])
    for board in made:
        listed = [*board_page.notes(board), *board_page.separating(board)]
        actions = "" if board.action_space == CHOICES else f", `{board.action_space}`"
        parts.append(
            "\n".join(
                [f"## Split `{board.split}`{actions}", "", *(f"- {line}" for line in listed), ""]
            )
        )
        parts += [to_markdown(table) for table in board_page.all_tables(board)]
    return "\n".join(parts)


def untitled(table: Table) -> str:
    """A table in Markdown without its title."""
    return to_markdown(table).partition("\n\n")[2]


def pages(made: list[Board]) -> dict[Path, str]:
    """The text of each page."""
    text = block(next((board for board in made if board.action_space == CHOICES), None))
    return {PAGE: BLOCK.sub(lambda _: text, PAGE.read_text()), EVIDENCE: evidence(made)}


def _names(names: list[str]) -> str:
    return ", ".join(f"`{name}`" for name in names)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    how = "folders <output>/<split> of runs, or rows in them, to copy first"
    parser.add_argument("--add", type=Path, nargs="+", default=[], help=how)
    for folder in parser.parse_args().add:
        add(folder)
    made = boards()
    for path, text in pages(made).items():
        path.write_text(text)
    if made:
        FIGURE.write_text(board_page.success_figure(made[0]))


if __name__ == "__main__":
    main()
