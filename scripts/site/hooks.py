"""What MkDocs cannot know of the repository: generated pages, the files that pages link to, and
links between them.

A page links to a file beside `docs/` (`../../configs/train.yaml`) as it does on a forge. In the
site such a file is a page of its own, with its text as a code block, so that every link works
offline.
"""

import re
import tomllib
from collections.abc import Callable
from os.path import normpath, relpath
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote

import api_pages
import command_pages
import config_pages
import notebook_pages
import yaml
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files

from mme_vla.utils.pages import TEMPLATES
from mme_vla.utils.style import css

if TYPE_CHECKING:
    from mkdocs.config.defaults import MkDocsConfig
    from mkdocs.structure.pages import Page

ROOT = Path(__file__).resolve().parents[2]
FROM_ROOT = {
    "reference/changes.md": "CHANGELOG.md",
    "extend/contributing.md": "CONTRIBUTING.md",
}
"""Pages that are files of the repository's root."""
HOME = "index.md"
"""The landing page. A link to the README leads to it."""
GALLERY = "benchmark/gallery.md"
HEADLINE = "<!-- headline -->"
"""Where the landing page shows the first table of the README."""
BOOST = {
    "concepts/memory.md": 6.0,
    "concepts": 3.0,
    "reference/api": 2.0,
    "reference/commands": 1.2,
    "reference": 0.6,
    "evidence": 0.5,
}
"""Folder or page → weight in the search, 1 for the others."""
LINK = re.compile(r"(!?\[[^\]]*\]\()([^)#\s]+)(#[^)\s]*)?\)")
DRAWING = re.compile(r'<img alt="([^"]*)" src="([^"]*\.svg)" />')
CELL = re.compile(r"(?<=<td>).*?(?=</td>)", re.DOTALL)
VALUE = re.compile(r"<code>(?=[^<\s]{1,22}</code>)|(?<![\w.-])\d[\d.]*e-\d+(?![\w-])")
"""In a cell of a table: a short name or setting in code, and a power of ten."""
UNITS = "[KMGT]i?B|[mµ]?s|min|h|[mck]?m|px|Hz|fps"
"""Units of values on the pages, as a regular expression."""
LANGUAGES = {".py": "python", ".yaml": "yaml", ".json": "json", ".sh": "bash", ".toml": "toml"}


def on_config(config: "MkDocsConfig") -> "MkDocsConfig":
    """Take version and address of the project from `pyproject.toml`. The placeholder of an address
    is no link. Pages that are opened as files need none for an unknown address.
    """
    config.theme.static_templates.discard("404.html")
    pyproject = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    version = pyproject["project"]["version"]
    address = pyproject["tool"]["hatch"]["metadata"]["hooks"]["custom"]["repository"]
    config.extra["version_label"] = version
    config.copyright = f"{config.site_name} {version} · {config.copyright}"
    if "/OWNER/" not in address:
        config.repo_url = address
    return config


def navigation() -> list[Any]:
    """The navigation of `mkdocs.yml`."""
    return yaml.load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"), _Settings)["nav"]


class _Settings(yaml.SafeLoader):
    """Reads `mkdocs.yml`, which names a Python function."""


_Settings.add_multi_constructor("tag:yaml.org,2002:python/", lambda loader, suffix, node: suffix)


def generated() -> dict[str, str]:
    """Path under `docs/` → Markdown, of every page that is written at build time."""
    copies = {page: (ROOT / file).read_text(encoding="utf-8") for page, file in FROM_ROOT.items()}
    return {
        **copies,
        **api_pages.pages(navigation()),
        **config_pages.pages(),
        **command_pages.pages(),
    }


def on_files(files: Files, config: "MkDocsConfig") -> Files:
    """Add the generated pages, a page for each linked file outside `docs/`, and the script that
    sorts tables.
    """
    pages = generated()
    for path, text in pages.items():
        files.append(File.generated(config, path, content=text))
    files.append(
        File.generated(config, "javascripts/sort.js", content=(TEMPLATES / "sort.js").read_text())
    )
    files.append(File.generated(config, "stylesheets/colours.css", content=css()))
    texts = {**pages, **{file.src_uri: file.content_string for file in files.documentation_pages()}}
    for target in sorted(
        {target for path, text in texts.items() for target in outside(path, text)}
    ):
        files.append(File.generated(config, shown_as(target), content=source_page(target)))
    return files


def on_page_markdown(markdown: str, page: "Page", **_: object) -> str:
    """Point links to files of the repository at their pages in the site, and rank the page in the
    search.
    """
    path = page.file.src_uri
    page.meta.setdefault("search", {})["boost"] = boost_of(path)
    if path == HOME:
        page.meta |= {"template": "home.html", "hide": ["navigation", "toc", "footer"]}
        markdown = markdown.replace(HEADLINE, headline())
    if path == GALLERY:
        page.meta["hide"] = ["toc"]  # four clips beside each other
    return unbroken(relink(path, markdown))


def on_page_content(html: str, page: "Page", **_: object) -> str:
    """Put drawings into the page itself, where they follow its light and dark, and keep values of
    tables on one line.
    """

    def inline(match: re.Match[str]) -> str:
        target = target_of(page.file.src_uri, match[2])
        return match[0] if target is None else drawing(ROOT / target, match[1])

    return CELL.sub(lambda cell: VALUE.sub(whole, cell[0]), DRAWING.sub(inline, html))


def whole(value: re.Match[str]) -> str:
    """The beginning of code, or a number, with the class of values that do not break."""
    if value[0] == "<code>":
        return '<code class="value">'
    return f'<span class="value">{value[0]}</span>'


def drawing(path: Path, description: str) -> str:
    """An SVG file as an element of a page."""
    text = path.read_text(encoding="utf-8")
    element = text[text.index("<svg") :]
    return f'<span class="drawing" role="img" aria-label="{description}">{element}</span>'


def on_page_context(context: dict[str, Any], page: "Page", **_: object) -> dict[str, Any]:
    """Give a page without sections the width of the column that would list them."""
    titles = list(page.toc)
    if not titles or (len(titles) == 1 and not titles[0].children):
        page.meta.setdefault("hide", []).append("toc")
    return context


def boost_of(path: str) -> float:
    """The weight of a page in the search: its own, or that of the longest folder which is named."""
    folders = [name for name in BOOST if f"{path}/".startswith(f"{name}/")]
    return BOOST[max(folders, key=len)] if folders else 1.0


def headline() -> str:
    """The first table of the README, with links as from `docs/`."""
    rows = re.search(
        r"(?:^\|.*\n)+", (ROOT / "README.md").read_text(encoding="utf-8"), re.MULTILINE
    )
    if rows is None:
        raise PluginError("README.md has no table for the landing page.")
    return rows[0].replace("](docs/", "](")


def unbroken(text: str) -> str:
    """A page's text whose values stay on one line: `63 %`, `49.17 ± 0.48`, `16 × 16`,
    `7 GB`.
    """
    value = re.compile(rf"(?<=\d) (?=[%±×]|(?:{UNITS})\b)|(?<=[±×]) (?=\d)")

    def change(part: str) -> str:
        pieces = re.split(r"(`[^`\n]*`)", part)
        return "".join(p if p.startswith("`") else value.sub("\u00a0", p) for p in pieces)

    return outside_of_code(text, change)


def origin(path: str) -> str:
    """Where the text of a page stands in the repository, which its relative links start from."""
    if path.startswith("source/"):
        return path.removeprefix("source/").removesuffix(".md")
    return FROM_ROOT.get(path, f"docs/{path}")


def target_of(path: str, link: str) -> str | None:
    """The file of the repository that a link on a page names; None for an address."""
    if re.match(r"[a-z]+:|/", link):
        return None
    return normpath(f"{origin(path)}/../{unquote(link)}")


def shown_as(target: str) -> str:
    """The path in the site of a file of the repository."""
    copies = {"README.md": HOME} | {file: page for page, file in FROM_ROOT.items()}
    if target in copies:
        return copies[target]
    return target.removeprefix("docs/") if target.startswith("docs/") else f"source/{target}.md"


def outside(path: str, text: str) -> set[str]:
    """The files and folders that a page links to and that are neither in `docs/` nor a page of the
    site.

    Raises:
        PluginError: a link leads to no file.
    """
    targets = set()
    for _, link, _ in LINK.findall(without_code(text)):
        target = target_of(path, link)
        if target is None or not shown_as(target).startswith("source/"):
            continue
        if not (ROOT / target).exists():
            raise PluginError(f"{origin(path)} links to {link}, which does not exist.")
        targets.add(target)
    return targets


def without_code(text: str) -> str:
    return re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE)


def relink(path: str, text: str) -> str:
    """A page's text with links to files of the repository as links between pages of the site."""

    def replace(match: re.Match[str]) -> str:
        target = target_of(path, match[2])
        if target is None:
            return match[0]
        return f"{match[1]}{relpath(shown_as(target), Path(path).parent)}{match[3] or ''})"

    return outside_of_code(text, lambda part: LINK.sub(replace, part))


def outside_of_code(text: str, change: Callable[[str], str]) -> str:
    """Apply `change` to what is not in a fenced block."""
    parts = re.split(r"(^```.*?^```)", text, flags=re.DOTALL | re.MULTILINE)
    return "".join(part if part.startswith("```") else change(part) for part in parts)


def source_page(target: str) -> str:
    """A file of the repository as a page: its text, or the names of a folder's files."""
    path = ROOT / target
    if path.suffix == ".ipynb":
        return notebook_pages.page(path)
    if path.is_dir():
        names = sorted(str(file.relative_to(path)) for file in path.rglob("*") if is_source(file))
        text, language = "\n".join(names), "text"
    else:
        text, language = path.read_text(encoding="utf-8"), LANGUAGES.get(path.suffix, "text")
    # Five backticks: a file may hold fences of its own. The search finds pages, not files.
    return (
        "---\nsearch:\n  exclude: true\n---\n\n#"
        f" `{target}`\n\n`````{language}\n{text.rstrip()}\n`````\n"
    )


def is_source(file: Path) -> bool:
    return file.is_file() and not {"__pycache__", "outputs"} & set(file.parts)
