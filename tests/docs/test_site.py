"""The site: builds without a warning, loads nothing from another host, and finds pages from a file
in the browser.
"""

import re
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote

import config_pages
import pytest

from helpers import commands
from helpers.browser import Browser
from mme_vla import cli
from mme_vla.cli import docs
from mme_vla.errors import UserError

pytestmark = pytest.mark.slow


class Page(HTMLParser):
    """What a page loads, links to, and is linked by."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.loaded: list[str] = []
        self.links: list[str] = []
        self.anchors: set[str] = set()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = {name: value or "" for name, value in attrs}
        self.anchors |= {values["id"]} if "id" in values else set()
        self.loaded += [values["src"]] if "src" in values else []
        if tag == "link" and values.get("rel") not in ("canonical", "next", "prev"):
            self.loaded.append(values["href"])
        if tag == "a" and "href" in values:
            self.links.append(values["href"])


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, built by the command, which stops at a warning."""
    pytest.importorskip("material", reason="the extra `docs` is not installed")
    folder = tmp_path_factory.mktemp("docs") / "site"
    done = commands.run("mme_vla", "docs", "--build", "--output", str(folder))
    assert done.returncode == 0, done.stderr
    assert "WARNING" not in done.stderr
    assert str(folder / "index.html") in done.stdout
    return folder


@pytest.fixture(scope="module")
def pages(site: Path) -> dict[Path, Page]:
    return {file: Page(file.read_text()) for file in site.rglob("*.html")}


def test_each_command_and_group_has_a_page(site: Path) -> None:
    assert {file.stem for file in (site / "reference" / "commands").iterdir()} == set(
        cli.commands()
    )
    groups = set(config_pages.groups())
    assert {file.stem for file in (site / "reference" / "configuration").iterdir()} == groups


def test_the_site_loads_nothing_from_another_host(site: Path, pages: dict[Path, Page]) -> None:
    assert len(pages) > 60
    foreign = {
        (page.name, address)
        for page, read in pages.items()
        for address in read.loaded
        if "//" in address
    }
    assert {
        (page, address) for page, address in foreign if not address.startswith("data:")
    } == set()
    for style in site.rglob("*.css"):
        assert re.findall(r"url\([\"']?(?:https?:)?//|@import", style.read_text()) == [], style


def test_links_and_anchors_resolve(pages: dict[Path, Page]) -> None:
    broken = []
    for page, read in pages.items():
        for link in read.links:
            address, _, anchor = link.partition("#")
            if page.name == "404.html" or re.match(r"[a-z]+:", address):
                continue
            target = (page.parent / unquote(address)).resolve() if address else page
            if not target.exists() or (
                anchor
                and target in pages
                and unquote(anchor) not in pages[target].anchors | {"__top"}
            ):
                broken.append(f"{page.name}: {link}")
    assert broken == []


def test_a_search_leads_to_a_page(site: Path, tmp_path: Path) -> None:
    with Browser(tmp_path) as browser:
        browser.open((site / "index.html").as_uri())
        browser.run("document.querySelector('.md-search__input').focus()")
        browser.call("Input.insertText", text="TokenDrop")
        results = "[...document.querySelectorAll('.md-search-result__link')]"
        browser.wait(f"{results}.length > 3")
        first = browser.run(f"{results}[0].href")
        browser.run(f"{results}[0].click()")
        browser.wait(
            f"location.href.split('?')[0] === {first.split('?')[0]!r} && document.readyState ==="
            " 'complete'"
        )
        assert "tokendrop" in browser.text("article").lower()
        assert browser.problems == []


def test_a_broken_link_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("material", reason="the extra `docs` is not installed")
    (tmp_path / "docs").mkdir()
    (tmp_path / "docs" / "index.md").write_text("# Title\n\n[nowhere](nowhere.md)\n")
    (tmp_path / "mkdocs.yml").write_text("site_name: x\nvalidation: {links: {not_found: warn}}\n")
    monkeypatch.setattr(docs, "SETTINGS", tmp_path / "mkdocs.yml")
    with pytest.raises(UserError, match="not built"):
        docs.build_site(tmp_path / "site")


def test_an_installed_package_without_pages_is_an_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("material", reason="the extra `docs` is not installed")
    monkeypatch.setattr(docs, "SETTINGS", tmp_path / "mkdocs.yml")
    with pytest.raises(UserError, match="in the repository"):
        docs.build_site(tmp_path / "site")
