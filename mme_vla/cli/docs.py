"""`mme-vla docs`: build the documentation site of a clone and open it in the browser, without a network."""

import argparse
import logging
import webbrowser
from pathlib import Path

from mme_vla.errors import UserError, missing_extra

REPOSITORY = Path(__file__).resolve().parents[2]
SETTINGS = REPOSITORY / "mkdocs.yml"
MARK = ".mme-vla-site"
"""A file in every site that the command built: what is there may be replaced."""


def build_site(output: Path) -> Path:
    """Build the site into a folder, whose content is replaced, and return its start page.

    Raises:
        UserError: the extra `docs` is missing, this is no clone, or a page has a warning (a broken link, for example).
    """
    try:
        from mkdocs.commands.build import build
        from mkdocs.config import load_config
        from mkdocs.exceptions import Abort, MkDocsException
    except ImportError:
        raise missing_extra("The documentation site", "docs") from None
    check_output(output)
    if not SETTINGS.is_file():
        raise UserError(f"The pages are in the repository, not in the installed package ({SETTINGS} is missing).")
    try:
        config = load_config(str(SETTINGS), strict=True, site_dir=str(output.resolve()))
        output.mkdir(parents=True, exist_ok=True)
        (output / MARK).touch()  # first: an interrupted site is replaced too; names with a dot survive the cleaning
        config.plugins.on_startup(command="build", dirty=False)
        build(config)
        config.plugins.on_shutdown()
    except (Abort, MkDocsException) as error:
        raise UserError(f"The site was not built: {error}") from error
    return output / "index.html"


def check_output(output: Path) -> None:
    """Make sure that a folder holds nothing that building a site there would delete.

    Raises:
        UserError: it is a file, or holds anything but a site that this command built before.
    """
    if not output.exists() or (output / MARK).is_file():
        return
    if not output.is_dir() or any(output.iterdir()):
        raise UserError(
            f"--output {output} holds something else than a site of `mme-vla docs`, which building would delete. Name "
            "a folder that is new, empty, or an earlier site."
        )


def main() -> None:
    """Run `mme-vla docs`."""
    parser = argparse.ArgumentParser(prog="mme-vla docs", description=str(__doc__).partition(": ")[2])
    parser.add_argument("--output", type=Path, default=Path("outputs/site"), help="folder of the site (%(default)s)")
    parser.add_argument("--build", action="store_true", help="build only, open no browser")
    arguments = parser.parse_args()
    logging.getLogger("mkdocs").addHandler(logging.StreamHandler())  # its warnings, which are errors here
    page = build_site(arguments.output).resolve()
    print(f"The site is in {page}")
    if not arguments.build and not webbrowser.open(page.as_uri()):
        print("No browser was found: open this file in one.")
