"""`mme-vla nano board`: the ranking of nanoMME's rows, with rows of your own from folders or from a new training.

Words of `mme-vla nano` train and evaluate a row first, as far as it is not there: `model=` names it.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from mme_vla.cli.errors import print_user_errors
from mme_vla.cli.help import argument_parser
from mme_vla.errors import printable

SHIPPED = Path(__file__).resolve().parents[2] / "benchmarks" / "nano16"
"""The rows of the repository, a folder for each split."""
EXAMPLES = (
    "", "rows=outputs/nano16/reserved --html board.html",
    "--config-dir configs model=mine_modul '+memories.mine={budget: 32, grid: 1}'",
)  # fmt: skip


def main(words: Sequence[str]) -> None:
    """Train where a model is named, read the rows, print and write the board."""
    parser = argument_parser("mme-vla nano board", __doc__, EXAMPLES)
    parser.add_argument("words", nargs="*", metavar="KEY=VALUE",
                        help="rows=FOLDER: rows of your own, repeatable; others: of mme-vla nano")  # fmt: skip
    parser.add_argument("--config-dir", type=Path, help="folder of your own models, as of mme-vla nano")
    parser.add_argument("--html", type=Path, help="write the board as one page with sortable tables and plots")
    parser.add_argument("--samples", type=int, help="of the bootstrap")
    with print_user_errors():
        run(parser.parse_intermixed_args(words))


def run(args: argparse.Namespace) -> None:
    """Do what the parsed command line says."""
    from mme_vla.evaluation.results.tables import comparison_table, print_table
    from mme_vla.nano import board_page
    from mme_vla.nano.board import SAMPLES, Board
    from mme_vla.nano.rows import read_rows

    folders = [Path(word.removeprefix("rows=")) for word in args.words if word.startswith("rows=")]
    split, trained = train_row([word for word in args.words if not word.startswith("rows=")], args.config_dir)
    rows = read_rows([SHIPPED / split] if (SHIPPED / split).is_dir() else [], own=[*folders, *trained])
    board = Board(rows, samples=args.samples or SAMPLES)
    pairs = board.neighbours()
    tables = [board_page.ranking(board, brief=True), board_page.targets(board)]
    for table in [*tables, *([comparison_table(pairs)] if pairs else [])]:
        print_table(table, 120)
    for line in [*board_page.notes(board), *board_page.separating(board), *board_page.standing(board)]:
        print(printable(line))
    if args.html:
        args.html.parent.mkdir(parents=True, exist_ok=True)
        args.html.write_text(board_page.page(board), encoding="utf-8")
        print(f"wrote {args.html}")


def train_row(words: Sequence[str], config_dir: Path | None) -> tuple[str, list[Path]]:
    """Run `mme-vla nano` with these words where they name a model; the split, and the folders of rows it made."""
    from mme_vla.cli import nano
    from mme_vla.config.composition import compose

    if not any(word.startswith("model=") for word in words):
        return str(compose("nano", nano.with_settings(words)).split), []
    alone = [word for word in ("beside=[]", "references=[]") if not any(w.startswith(word[:-2]) for w in words)]
    words = [*words, *alone]
    config = compose("nano", nano.with_settings(words), extra_dirs=[config_dir] if config_dir else [])
    sys.argv[1:] = [*(["--config-dir", str(config_dir)] if config_dir else []), *words]
    nano.main()
    return str(config.split), [Path(config.output) / config.split]
