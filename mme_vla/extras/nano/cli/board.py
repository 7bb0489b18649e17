"""`mme-vla nano board`: the ranking of nanoMME's rows, with rows of your own from folders or from a
new training.

Words of `mme-vla nano` train and evaluate a row first, as far as it is not there: `model=` names
it.
"""

import argparse
import sys
import tarfile
from collections import Counter
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

from mme_vla.cli.errors import print_user_errors
from mme_vla.cli.help import argument_parser
from mme_vla.config.composition import compose, resolved
from mme_vla.errors import printable, require
from mme_vla.extras.nano.settings import NanoRun
from mme_vla.utils import require_replaceable, write_text

SHIPPED = Path(__file__).resolve().parents[3] / "assets" / "board"
"""The published rows: an archive for each table."""
NO_PUBLISHED_ROWS = (
    "There are no published rows of this split and these actions. Rows of your own are ranked"
    " alone, and are not compared with the published settings."
)
EXAMPLES = (
    "", "rows=outputs/nano16/further --html board.html",
    "--config-dir configs model=mine_modul '+memories.mine={budget: 32, grid: 1}'",
)  # fmt: skip


def main(
    words: Sequence[str],
    nano: Callable[[], None],
    with_settings: Callable[[Sequence[str]], list[str]],
) -> None:
    """Train where a model is named, read the rows, print and write the board.

    nano: `mme-vla nano`, with the words of `sys.argv`.
    with_settings: these words with what they imply.
    """
    parser = argument_parser("mme-vla nano board", __doc__, EXAMPLES)
    parser.add_argument(
        "words",
        nargs="*",
        metavar="KEY=VALUE",
        help="rows=FOLDER: rows of your own, repeatable; others: of mme-vla nano",
    )
    parser.add_argument(
        "--config-dir", type=Path, help="folder of your own models, as of mme-vla nano"
    )
    parser.add_argument(
        "--html", type=Path, help="write the board as one page with sortable tables and plots"
    )
    parser.add_argument("--samples", type=int, help="of the bootstrap")
    with print_user_errors():
        args = parser.parse_intermixed_args(words)
        if args.html:
            require_replaceable(args.html, ".html", ".htm")
        words = [word for word in args.words if not word.startswith("rows=")]
        trees = [args.config_dir] if args.config_dir else []
        config = compose("nano", with_settings(words), extra_dirs=trees)
        trained: list[Path] = []
        if any(word.startswith("model=") for word in words):
            composed = compose("nano", with_settings(alone(words)), extra_dirs=trees)
            trained = row_folders(NanoRun.from_config(resolved(composed)), trees)
            sys.argv[1:] = alone(words)
            for tree in trees:
                sys.argv += ["--config-dir", str(tree)]
            nano()
        run(args, str(config.split), trained)


def row_folders(nano: NanoRun, trees: Sequence[Path]) -> list[Path]:
    """The folders of the rows that a run trains; others in its output may be unfinished.

    Raises:
        UserError: rows of these settings would not fit those of the repository.
    """
    from mme_vla.envs.episodes import choose_episodes
    from mme_vla.extras.nano.rows import TRAINED, read_training, rules_text, table_of
    from mme_vla.extras.nano.runs import compose_rows, rules_of

    rows = compose_rows(nano, trees)
    rules = rules_of(nano)
    actions = rows.robot.action.answers or rows.robot.name
    shipped = published_rows(table_of(nano.split, actions))
    trainings: list[Path] = []
    if shipped is None:
        print(NO_PUBLISHED_ROWS)
    else:
        trainings = sorted(file.parent for file in shipped.rglob(TRAINED))
    if shipped is not None and trainings:
        published = read_training(trainings[0])
        specs = choose_episodes(nano.task, nano.episodes, nano.split)
        values = {
            "episodes": dict(Counter(spec.task for spec in specs)),
            "max_steps": rules.steps,
            "rules": rules_text(actions, rules.max_choices, rules.only_possible),
        }
        expected = {
            "episodes": dict(Counter(record.task for record in published.records)),
            "max_steps": published.records[0].max_steps,
            "rules": published.rules,
        }
        for name, value in values.items():
            require(
                value == expected[name],
                f"A row with {name} {value} does not fit the published rows of {shipped.name}: they"
                f" have {expected[name]}.",
            )
    return [Path(nano.output) / nano.split / row for row in rows.composed]


def published_rows(table: str) -> Path | None:
    """The folder of a table's published rows, unpacked until the process ends; None where there are
    none.
    """
    archive = SHIPPED / f"{table}.tar.xz"
    if not archive.is_file():
        return None
    return Path(_unpacked(archive).name) / table


@cache
def _unpacked(archive: Path) -> TemporaryDirectory:
    """The files of an archive, until the process ends."""
    folder = TemporaryDirectory(prefix="mme-vla-board-")
    with tarfile.open(archive) as file:
        file.extractall(folder.name, filter="data")
    return folder


def alone(words: Sequence[str]) -> list[str]:
    """Words for the models that they name and no other rows, with one training each if they do not
    say otherwise.
    """
    typed = {word.partition("=")[0] for word in words}
    others = ("beside=[]", "planner=false", "oracle=null", "floors=false", "trainings=1")
    return [*words, *(word for word in others if word.partition("=")[0] not in typed)]


def run(args: argparse.Namespace, split: str, trained: Sequence[Path]) -> None:
    """Read the rows, print the board, and write it where a file is named. trained: folders beside
    those of `rows=`.
    """
    from rich.console import Console

    from mme_vla.evaluation.results.tables import comparison_table, print_table
    from mme_vla.extras.nano import board_page
    from mme_vla.extras.nano.board import SAMPLES, Board
    from mme_vla.extras.nano.rows import read_rows

    folders = [Path(word.removeprefix("rows=")) for word in args.words if word.startswith("rows=")]
    local = read_rows([], local=[*folders, *trained])
    table_name = split
    if local:
        table_name = next(iter(local.values()))[0].table
    shipped = published_rows(table_name)
    if shipped is not None:
        rows = read_rows([shipped], local=[*folders, *trained])
    else:
        rows = local
        print(NO_PUBLISHED_ROWS)
    board = Board(rows, samples=args.samples or SAMPLES)
    pairs = comparison_table(board.neighbours())
    console = Console()
    for table in (board_page.ranking(board, brief=True), board_page.targets(board), pairs):
        if table.rows:
            print_table(table, console.width if console.is_terminal else 160)
    for line in [
        *board_page.notes(board),
        *board_page.separating(board),
        *board_page.standing(board),
    ]:
        print(printable(line))
    if args.html:
        write_text(args.html, board_page.page(board))
        print(f"wrote {args.html}")
