"""`mme-vla docs`: build the documentation site of a clone and open it in the browser, without a
network.
"""

import logging
import shutil
import tempfile
import time
import webbrowser
from pathlib import Path

from mme_vla.cli.help import argument_parser
from mme_vla.errors import UserError, listed, missing_extra, require
from mme_vla.utils import file_sum, read_json, write_json

REPOSITORY = Path(__file__).resolve().parents[2]
SETTINGS = REPOSITORY / "mkdocs.yml"
FILES = ".mme-vla-site.json"
"""Lies in a site, with the SHA-256 of each other file of it: what a later build may remove."""


def build_site(output: Path) -> Path:
    """Build the site into a folder, in place of an earlier site, and return its start page.

    Raises:
        UserError: the folder holds anything but an earlier site, the extra `docs` is missing, this
            is no clone, or a page has a warning (a broken link, for example). Then the folder is as
            it was.
    """
    require(
        SETTINGS.is_file(),
        f"The pages are in the repository, not in the installed package ({SETTINGS} is missing).",
    )
    try:
        from mkdocs.commands.build import build
        from mkdocs.config import load_config
        from mkdocs.exceptions import Abort, MkDocsException
    except ImportError:
        raise missing_extra("The documentation site", "docs") from None
    target = output.resolve()
    check_site(target)
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".mme-vla-site-", dir=target.parent) as place:
        draft = Path(place) / "site"
        try:
            config = load_config(str(SETTINGS), strict=True, site_dir=str(draft))
            config.plugins.on_startup(command="build", dirty=False)
            build(config)
            config.plugins.on_shutdown()
        except (Abort, MkDocsException) as error:
            raise UserError(f"The site was not built: {error}") from error
        sums = {}
        for path in draft.rglob("*"):
            if path.is_file():
                sums[path.relative_to(draft).as_posix()] = file_sum(path)
        write_json(draft / FILES, sums)
        check_site(target)  # building takes a while
        _replace(draft, target)
    return output / "index.html"


def check_site(folder: Path) -> None:
    """Refuse a folder that holds anything but an earlier site, since building removes what is
    there.

    Raises:
        UserError: files or folders in it are not of a site that was built here, or were changed
            since.
    """
    require(
        not folder.exists() or folder.is_dir(),
        f"--output {folder} is a file: give a folder for the site.",
    )
    record = folder / FILES
    sums = read_json(record, "the files of a site") if record.is_file() else {}
    folders: set[str] = set()
    for name in sums:
        folders.update(parent.as_posix() for parent in Path(name).parents)
    other_files: list[str] = []
    for path in folder.rglob("*"):
        name = path.relative_to(folder).as_posix()
        if path.is_symlink():
            is_generated = False
        elif path.is_dir():
            is_generated = name in folders
        else:
            is_generated = name == FILES or (name in sums and file_sum(path) == sums[name])
        if not is_generated:
            other_files.append(path.name)
        if len(other_files) == 5:  # not all of them: the folder may be a home folder
            break
    require(
        not other_files,
        f"--output {folder} holds what is no site of this command, or was changed since, such as"
        f" {listed(sorted(other_files))}. A new site replaces the whole folder: choose another, or"
        " remove this one yourself.",
    )


def _replace(draft: Path, target: Path) -> None:
    """Move a built site into the folder of an earlier one; at each moment its list names all that
    is there.
    """
    target.mkdir(exist_ok=True)
    for path in sorted(target.iterdir(), key=lambda path: path.name == FILES):
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink()
    for path in sorted(draft.iterdir(), key=lambda path: path.name != FILES):
        shutil.move(path, target / path.name)


def main() -> None:
    """Run `mme-vla docs`."""
    purpose = str(__doc__).partition(": ")[2]
    parser = argument_parser(
        "mme-vla docs", purpose[0].upper() + purpose[1:], ("", "--build --output outputs/site")
    )
    parser.add_argument(
        "--output",
        type=Path,
        default=Path("outputs/site"),
        help="folder of the site, new or with an earlier site, which is replaced (%(default)s)",
    )
    parser.add_argument("--build", action="store_true", help="build only, open no browser")
    arguments = parser.parse_args()
    # its warnings, which are errors here
    logging.getLogger("mkdocs").addHandler(logging.StreamHandler())
    check_site(arguments.output.resolve())
    print("Building the site: some 400 pages, about half a minute …", flush=True)
    start = time.monotonic()
    page = build_site(arguments.output).resolve()
    print(f"The site is in {page} ({time.monotonic() - start:.0f} s).")
    if not arguments.build and not webbrowser.open(page.as_uri()):
        print("No browser was found: open this file in one.")
