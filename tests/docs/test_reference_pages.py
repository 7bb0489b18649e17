"""The generated pages: API, configuration, commands, and files that pages link to."""

import ast
import inspect
import json
import re
import sys
from pathlib import Path

import api_pages
import command_pages
import config_pages
import hooks
import notebook_pages
import pytest

from helpers import REPOSITORY
from mme_vla.cli import commands
from mme_vla.cli import help as cli_help
from mme_vla.config.trees import library_files
from mme_vla.registry import Command


def test_every_public_name_has_a_page_and_a_description() -> None:
    nav = hooks.navigation()
    pages = api_pages.pages(nav)
    for name in api_pages.public_names():
        assert f"::: {api_pages.target_of(name)}\n" in pages[f"reference/api/{name}.md"]
        assert api_pages.first_sentence(name)
    assert "| `MEMORIES` | `mme_vla.registry` |" in pages["reference/api/registries.md"]


def test_a_public_name_without_a_page_is_an_error() -> None:
    nav = [{"API": ["reference/api.md", {"Mistakes": ["reference/api/UserError.md"]}]}]
    with pytest.raises(ValueError, match="build_policy"):
        api_pages.pages(nav)


def test_the_page_of_a_module_leaves_out_the_public_names() -> None:
    page = api_pages.module_page("mme_vla.types")
    assert "- TensorStruct\n" in page and "- Batch\n" not in page


def test_each_entry_of_a_docstring_begins_a_line() -> None:
    second = re.compile(r"^\s*\w+(, \w+)*: [^`]*[.)] [a-z_]+(, [a-z_]+)*: ")
    found = []
    for path in sorted((REPOSITORY / "mme_vla").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.ClassDef | ast.FunctionDef):
                continue
            lines = (ast.get_docstring(node) or "").splitlines()
            found += [f"{path.name}: {line}" for line in lines if second.match(line)]
    assert not found


def test_docstrings_become_sections_lists_and_links() -> None:
    pytest.importorskip("griffe", reason="the extra `docs` is not installed")
    import docstrings

    names = {"tasks", "episodes", "width", "grid", "storage"}
    text = """Run it.

    Args:
        tasks, episodes: as in the command.
        grid: side of a view's
            token grid.

    >>> run(1)  # doctest: +SKIP
    """
    assert docstrings.rewritten(inspect.cleandoc(text), names) == (
        "Run it.\n\nArgs:\n    tasks: as in the command.\n    episodes: as in the command.\n"
        "    grid: side of a view's token grid.\n\n```python\n>>> run(1)\n```"
    )
    fields = "A struct.\n\nwidth: of a token.\ngrid: its side.\n    In tokens."
    assert docstrings.rewritten(fields, names) == (
        "A struct.\n\nAttributes:\n    width: of a token.\n    grid: its side. In tokens."
    )
    members = "It sets:\n    storage: what is stored.\n    other: the rest."
    assert docstrings.rewritten(members, names) == (
        "It sets:\n\n- `storage`: what is stored.\n- `other`: the rest."
    )


def test_every_file_of_the_top_level_configures_a_command() -> None:
    assert set(library_files("")) == set(cli_help.configured_commands())


def test_every_key_has_a_comment_in_one_file_of_its_group() -> None:
    """A group's other files may repeat a key without explaining it again."""
    unexplained = []
    for name in ["", *config_pages.groups()]:
        if name == "model":
            continue
        files = list(library_files(name).values())
        for group in [files] if name else [[file] for file in files]:
            rows = [
                (file, key.name, key.comment) for file in group for key in config_pages.keys(file)
            ]
            explained = {key for _, key, comment in rows if comment}
            sections = {
                key for _, key, _ in rows if any(other.startswith(f"{key}.") for other in explained)
            }
            unexplained += [
                f"{file.name}: {key}" for file, key, _ in rows if key not in explained | sections
            ]
    assert sorted(set(unexplained)) == []


def test_comments_are_rendered_completely() -> None:
    """Outside of backticks and code blocks no tag opens, and a row of a table has as many columns
    as its head.
    """
    for path, page in config_pages.pages().items():
        text = re.sub(r"```.*?```", "", page, flags=re.DOTALL)
        assert re.findall(r"<[^>\n]*>", re.sub(r"`[^`]*`", "", text)) == [], path
        for line in text.splitlines():
            if line.startswith("|"):
                assert len(re.findall(r"(?<!\\)\|", line)) in (3, 4), line


def test_comments_become_markdown() -> None:
    assert (
        config_pages.prose("train | val, `a|b` in <folder>, 2*3")
        == r"train \| val, `a\|b` in &lt;folder&gt;, 2\*3"
    )
    assert config_pages.prose("such as {vlm: 0.1}") == "such as &#123;vlm: 0.1&#125;"
    assert config_pages.prose("seed[-<split>][-x]") == r"seed\[-&lt;split&gt;]\[-x]", "no link"
    linked = config_pages.prose("see docs/train/weights.md#formats.", "reference/configuration")
    assert linked == "see [Weights](../../train/weights.md#formats)."
    assert config_pages.prose("docs/no/page.md") == "docs/no/page.md"
    assert config_pages.code("outputs/${player.name}/${now:%Y}") == "`outputs/<player.name>/<now>`"
    assert config_pages.code("${oc.env:MY_KEY,null}") == "`$MY_KEY`"


def test_generated_pages_have_links_and_words_in_place_of_paths_and_interpolations() -> None:
    for path, page in (command_pages.pages() | config_pages.pages()).items():
        text = re.sub(r"^```.*?^```", "", page, flags=re.DOTALL | re.MULTILINE)
        assert "${" not in text, path
        assert not re.search(r"(?<!/)docs/[\w/-]+\.md", text), path


def test_the_page_of_a_command_opens_with_no_sentence_and_no_link_twice() -> None:
    for path, page in command_pages.pages().items():
        opening = re.sub(r"^```.*?^```", "", page, flags=re.DOTALL | re.MULTILINE)
        opening = opening.partition("\n## ")[0]
        links = re.findall(r"\]\(([^)]+)\)", opening)
        assert len(links) == len(set(links)) > 0, path
        sentences = [part.strip() for part in re.split(r"(?<=[.?])\s", opening) if part.strip()]
        assert len(sentences) == len(set(sentences)), path


def test_values_of_pages_do_not_break() -> None:
    text = "49.17 ± 0.48, 63 %, 16 × 16, 7 GB, 5 ms, 4 steps, `1 % 2`\n\n```text\n3 %\n```"
    expected = text
    for value in ("49.17 ± 0.48", "63 %", "16 × 16", "7 GB", "5 ms"):
        expected = expected.replace(value, value.replace(" ", "\u00a0"))
    assert hooks.unbroken(text) == expected


def test_the_landing_page_has_the_first_table_of_the_readme() -> None:
    table = hooks.headline()
    assert table.startswith("| task |") and "](docs/" not in table
    assert hooks.HEADLINE in (REPOSITORY / "docs" / "index.md").read_text()


def test_each_command_has_a_page_with_its_options() -> None:
    pages = command_pages.pages()
    assert set(pages) == {f"reference/commands/{command}.md" for command in commands()}
    assert "| `max_steps` |" in pages["reference/commands/evaluate.md"]
    assert "| `port` | `8002`{ .value } |" in pages["reference/commands/play.md"]
    assert "| [`model`](../configuration/model.md) |" in pages["reference/commands/train.md"]
    assert "--compare" in pages["reference/commands/results.md"]
    for command in commands():
        page = pages[f"reference/commands/{command}.md"]
        assert "```bash" in page, f"{command} has no example"


def test_a_command_without_a_guide_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    known = commands() | {"dance": Command("dance", "dance")}
    monkeypatch.setattr(command_pages, "commands", lambda: known)
    with pytest.raises(ValueError, match="dance"):
        command_pages.pages()


def test_a_command_without_its_extra_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "mme_vla.serving.harness", raising=False)
    monkeypatch.setitem(sys.modules, "vla_eval.specs", None)  # importing it raises ImportError
    assert "uv sync --inexact --extra harness" in command_pages.help_text("harness")


def test_links_beside_the_pages_lead_to_pages_of_the_site() -> None:
    page = "See [a](../../configs/train.yaml), [b](models.md#x), [c](../../README.md) and [d](https://x.y).\n"
    assert hooks.outside("train/data.md", page) == {"configs/train.yaml"}
    linked = hooks.relink("train/data.md", page + "```text\n[a](../../configs/train.yaml)\n```\n")
    assert "[a](../source/configs/train.yaml.md)" in linked
    assert (
        "[b](models.md#x)" in linked
        and "[c](../index.md)" in linked
        and "[d](https://x.y)" in linked
    )
    assert linked.endswith("```text\n[a](../../configs/train.yaml)\n```\n")
    with pytest.raises(Exception, match=r"no\.yaml, which does not exist"):
        hooks.outside("train/data.md", "[a](../../configs/no.yaml)")


def test_a_notebook_is_shown_with_its_outputs(tmp_path: Path) -> None:
    cells = [
        {"cell_type": "markdown", "source": ["# Title"]},
        {
            "cell_type": "code",
            "source": ["print(1)"],
            "outputs": [
                {"text": ["\x1b[1m1\x1b[0m\n"]},
                {"data": {"image/png": "QUJD\n", "text/plain": ["<Figure>"]}},
                {"data": {"text/html": ["<video src='a'>\n\n</video>"], "text/plain": "<v>"}},
                {"data": {"text/markdown": ["| a |"], "text/plain": "<table>"}},
                {"data": {"image/svg+xml": ["<svg/>"], "text/plain": "<s>"}},
            ],
        },
    ]
    file = tmp_path / "a.ipynb"
    file.write_text(json.dumps({"cells": cells}))
    page = notebook_pages.page(file)
    assert "# Title\n\n```python\nprint(1)\n```\n\n```text\n1\n```" in page
    assert 'src="data:image/png;base64,QUJD"' in page and "Figure" not in page
    assert "<div class=\"output\"><video src='a'>\n</video></div>" in page
    assert "| a |" in page and "data:image/svg+xml;base64,PHN2Zy8+" in page
    assert "<v>" not in page and "<table>" not in page
