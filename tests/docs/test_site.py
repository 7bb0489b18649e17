"""The site builds without a warning, and loads nothing from another host."""

import html
import re
import sys
import tomllib
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote

import config_pages
import pytest

from helpers import REPOSITORY
from mme_vla import cli
from mme_vla.cli import docs
from mme_vla.config.trees import library_files
from mme_vla.errors import UserError
from mme_vla.utils.style import css

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
            if re.match(r"[a-z]+:", address):
                continue
            target = (page.parent / unquote(address)).resolve() if address else page
            if not target.exists() or (
                anchor
                and target in pages
                and unquote(anchor) not in pages[target].anchors | {"__top"}
            ):
                broken.append(f"{page.name}: {link}")
    assert broken == []


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


def test_words_of_comments_and_outputs_of_notebooks_are_shown(site: Path) -> None:
    """Braces, links to pages, computed values, HTML of a notebook."""
    n_braces = 0
    for group in config_pages.groups():
        page = text_of(site / "reference" / "configuration" / f"{group}.html")
        for file in library_files(group).values():
            for key in config_pages.keys(file):
                for braces in re.findall(r"\{[^{}]*\}", key.comment.replace("`", "")):
                    assert braces in page, f"{file.name}: {key.name}"
                    n_braces += 1
    assert n_braces > 3
    for folder in ("api", "commands", "configuration"):
        for file in (site / "reference" / folder).glob("*.html"):
            assert re.findall(r"\bdocs/[\w/-]+\.md", text_of(file)) == [], file.name
    command = (site / "reference/commands/train.html").read_text()
    assert "docs/train/weights.md" not in command and "train/weights.html" in command
    assert "outputs/&lt;name&gt;/&lt;now&gt;" in command
    notebook = (site / "source/examples/first_hour/02_closed_loop.ipynb.html").read_text()
    assert 'src="data:image/webp;base64,' in notebook and "&lt;the video&gt;" not in notebook


def test_parameters_and_types_of_the_api_are_linked_lists(site: Path) -> None:
    page = (site / "reference/api/build_policy.html").read_text()
    for title in ("Parameters:", "Returns:", "Raises:"):
        assert title in page
    assert re.search(r'href="Policy\.html#mme_vla\.policy\.base\.Policy"', page)
    assert "second_tries" in (site / "reference/api/Task.html").read_text()


def test_the_theme_has_the_projects_name_version_and_mark(site: Path) -> None:
    page = (site / "index.html").read_text()
    version = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["project"]["version"]
    assert f"MME-VLA {version}" in page and "images/mark.svg" in page
    assert "Made with" not in page
    assert page.count("VideoUnmask") == 1, "the first table of the README"


def test_drawings_and_pages_share_one_palette(site: Path) -> None:
    assert (site / "stylesheets/colours.css").read_text() == css()
    for page in ("extend/architecture.html", "concepts/budget.html", "train/nano.html"):
        text = (site / page).read_text()
        assert "colours.css" in text
        assert re.search(r'<span class="drawing" role="img" aria-label="[^"]+"><svg', text), page


def test_help_begins_with_a_capital_letter(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["mme-vla docs", "--help"])
    with pytest.raises(SystemExit):
        docs.main()
    assert "\nBuild the documentation site" in capsys.readouterr().out


def text_of(file: Path) -> str:
    """The text of a page without its tags."""
    return html.unescape(re.sub(r"<[^>]*>", "", file.read_text()))
