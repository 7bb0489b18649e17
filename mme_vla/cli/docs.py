"""`mme-vla docs`: build the documentation site of a clone and open it in the browser, without a
network.
"""

import logging
import tempfile
import time
import webbrowser
from pathlib import Path

from mme_vla.cli.help import argument_parser
from mme_vla.config.naming import digest
from mme_vla.errors import UserError, missing_extra, require
from mme_vla.utils import file_sum, read_json, write_json

REPOSITORY = Path(__file__).resolve().parents[2]
SETTINGS = REPOSITORY / "mkdocs.yml"
MARK = ".mme-vla-site.json"
"""Lies in a site, with the SHA-256 of all the rest of it: what a later build may remove."""


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
        write_json(draft / MARK, {"sha256": _tree_sum(draft)})
        check_site(target)  # building takes a while
        if target.exists():
            target.rename(Path(place) / "earlier")
        draft.rename(target)
    return output / "index.html"


def check_site(folder: Path) -> None:
    """Refuse a folder that holds anything but an earlier site, since building removes what is
    there.

    Raises:
        UserError: it is not exactly what was built.
    """
    require(
        not folder.exists() or folder.is_dir(),
        f"--output {folder} is a file: give a folder for the site.",
    )
    if not folder.exists() or not any(folder.iterdir()):
        return
    mark = folder / MARK
    is_site = False
    if mark.is_file():
        is_site = read_json(mark, "the digest of a site").get("sha256") == _tree_sum(folder)
    require(
        is_site,
        f"--output {folder} holds what is no site of this command, or was changed since. A new site"
        " replaces the whole folder: choose another, or remove this one yourself.",
    )


def _tree_sum(folder: Path) -> str:
    """SHA-256 of the names of all files and folders in a folder, and of what the files hold, but
    for the mark.
    """
    entries = {}
    for path in folder.rglob("*"):
        name = path.relative_to(folder).as_posix()
        if path.is_symlink() or not path.is_file():
            entries[name] = "link" if path.is_symlink() else "folder"
        elif name != MARK:
            entries[name] = file_sum(path)
    return digest(entries, 64)


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
