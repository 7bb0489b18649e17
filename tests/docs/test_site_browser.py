"""The site as a reader sees it, opened from files: search, links, anchors, widths."""

from collections.abc import Iterator
from pathlib import Path
from urllib.parse import unquote

import pytest

from helpers.browser import Browser

pytestmark = pytest.mark.nightly

FIRST_RESULTS = {
    "--trust-plugins": ("reference/", "extend/", "train/"),
    "embodiment.cameras": ("reference/",),
    "Ctrl-C": ("evaluate/", "serve/", "start/"),
    "from_pretrained": ("reference/api/",),
    "tokendrop": ("concepts/memory.html",),
    "TokenDrop": ("concepts/memory.html",),
}
"""What is typed → where the first page is."""
PAGES = [
    "index.html",
    "reference/api.html",
    "reference/api/Policy.html",
    "reference/api/build_policy.html",
    "reference/configuration/train.html",
    "reference/commands/train.html",
    "reference/commands/results.html",
    "benchmark/gallery.html",
    "compare/memories.html",
    "evidence/nano-board.html",
    "extend/architecture.html",
    "start/first-hour.html",
    "source/examples/first_hour/02_closed_loop.ipynb.html",
]
BROKEN_VALUES = r"""(() => {
  const broken = [];
  const article = document.querySelector('article');
  const walk = document.createTreeWalker(article, NodeFilter.SHOW_TEXT);
  while (walk.nextNode()) {
    const node = walk.currentNode;
    if (!node.parentElement.closest('td')) continue;
    const values = new RegExp([
      String.raw`\d[\d.,]*\s(?:%|[±×]\s\d[\d.]*|(?:GB|GiB|ms|s)\b)`,
      String.raw`\d{4,}`, String.raw`\b(?:bfloat16|\d[\d.]*e-\d+)`,
    ].join('|'), 'g');
    for (const match of node.data.matchAll(values)) {
      const range = document.createRange();
      range.setStart(node, match.index);
      range.setEnd(node, match.index + match[0].length);
      const lines = new Set([...range.getClientRects()].map(box => Math.round(box.top)));
      if (lines.size > 1) broken.push(match[0]);
    }
  }
  return broken;
})()"""
"""Values of tables whose text is on more than one line."""
INPUT = "document.querySelector('.md-search__input')"
LINKS = "[...document.querySelectorAll('.md-search-result__link')].map(a => a.href)"


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with Browser(tmp_path_factory.mktemp("profile"), (1440, 900)) as browser:
        yield browser


@pytest.fixture(scope="module")
def phone(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with Browser(tmp_path_factory.mktemp("profile"), (400, 800)) as browser:
        yield browser


def search_results(browser: Browser, site: Path, words: str) -> list[str]:
    """Addresses of the sections that a search finds, the best first."""
    browser.open((site / "start" / "install.html").as_uri())
    browser.run(f"{INPUT}.focus()")
    browser.call("Input.insertText", text=words)
    browser.press("ArrowRight")
    browser.wait(
        "/matching|No matching/.test(document.querySelector('.md-search-result__meta').textContent)"
    )
    return [link.partition("?")[0].removeprefix(f"{site.as_uri()}/") for link in browser.run(LINKS)]


@pytest.mark.parametrize("words", FIRST_RESULTS)
def test_a_search_finds_what_was_typed(browser: Browser, site: Path, words: str) -> None:
    first = search_results(browser, site, words)[0]
    assert first.startswith(FIRST_RESULTS[words])
    page = (site / unquote(first.partition("#")[0])).read_text().replace("&#x27;", "'")
    assert words.lower() in page.lower()
    assert browser.problems == []


def test_every_result_has_the_exact_words(browser: Browser, site: Path) -> None:
    results = search_results(browser, site, "--trust-plugins")
    assert len(results) > 3
    for result in results:
        assert "--trust-plugins" in (site / unquote(result.partition("#")[0])).read_text()


def test_nothing_is_found_for_nonsense(browser: Browser, site: Path) -> None:
    assert search_results(browser, site, "qwxzvk") == []


def test_a_result_leads_to_its_section(browser: Browser, site: Path) -> None:
    first = search_results(browser, site, "from_pretrained")[0]
    browser.run("document.querySelector('.md-search-result__link').click()")
    name = first.partition("#")[0]
    browser.wait(f"location.pathname.endsWith({name!r}) && document.readyState === 'complete'")
    assert "from_pretrained" in browser.text("article")


@pytest.mark.parametrize("page", PAGES)
def test_a_page_does_not_scroll_sideways(phone: Browser, site: Path, page: str) -> None:
    phone.open((site / page).as_uri())
    assert phone.run("document.documentElement.scrollWidth") <= 400
    wide = phone.run(
        "[...document.querySelectorAll('article pre > code, .md-typeset__scrollwrap')]"
        ".filter(e => e.scrollWidth > e.clientWidth + 1"
        " && !(['auto', 'scroll'].includes(getComputedStyle(e).overflowX)"
        "      && getComputedStyle(e).backgroundImage.includes('gradient'))).length"
    )
    assert wide == 0, "code or a table is cut and does not scroll, or has no shade that says so"
    assert phone.problems == []


@pytest.mark.parametrize(
    "page",
    [
        "evidence/benchmark.html",
        "evidence/hardware.html",
        "evidence/parity.html",
        "reference/configuration/train.html",
        "start/troubleshooting.html",
    ],
)
def test_values_in_tables_stay_on_one_line(phone: Browser, site: Path, page: str) -> None:
    phone.open((site / page).as_uri())
    assert phone.run(BROKEN_VALUES) == []


@pytest.mark.parametrize("page", PAGES)
def test_links_within_a_page_lead_to_elements(browser: Browser, site: Path, page: str) -> None:
    browser.open((site / page).as_uri())
    missing = browser.run(
        "[...document.querySelectorAll('a[href^=\"#\"]')].map(a => a.getAttribute('href').slice(1))"
        ".filter(id => id && id !== '__skip' && !document.getElementById(decodeURIComponent(id)))"
    )
    assert missing == []
    assert (
        browser.run("[...document.images].filter(i => i.complete && !i.naturalWidth).length") == 0
    )


def test_clips_of_the_gallery_are_large_and_side_by_side(browser: Browser, site: Path) -> None:
    browser.open((site / "benchmark" / "gallery.html").as_uri())
    boxes = browser.run(
        "[...document.querySelectorAll('.clips img')].map(i => i.getBoundingClientRect())"
        ".map(b => [b.width, b.y])"
    )
    assert len(boxes) == 16 and min(width for width, _ in boxes) > 192
    assert len({round(y) for _, y in boxes}) < 16


def test_the_text_uses_the_screen(browser: Browser, site: Path) -> None:
    for page in ("concepts/memory.html", "evidence/nano-board.html"):
        browser.open((site / page).as_uri())
        assert browser.run("document.querySelector('article').clientWidth") > 900
