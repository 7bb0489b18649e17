"""The generated pages: API, configuration, commands, and files that pages link to."""

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

from mme_vla.cli import commands
from mme_vla.cli import help as cli_help
from mme_vla.config.trees import library_files
from mme_vla.registry import Command


def test_every_public_name_has_a_description() -> None:
    pytest.importorskip(
        "gymnasium", reason="the environments' signatures: uv sync --inexact --extra sim"
    )
    page = api_pages.page()
    names = [name for names in api_pages.GROUPS.values() for name in names]
    assert [name for name in names if f"### `{name}`" not in page] == []
    import mme_vla

    assert [name for name in names if not api_pages.text_of(getattr(mme_vla, name))] == []


def test_a_public_name_without_a_group_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(api_pages, "GROUPS", {**api_pages.GROUPS, "Mistakes": []})
    with pytest.raises(ValueError, match="UserError"):
        api_pages.page()


def test_a_long_signature_has_a_line_for_each_argument() -> None:
    call = (
        "evaluate(policy: Policy, tasks: tuple[str, ...] = (), *, seed: int = 42, output: Path |"
        " None = None) -> Run"
    )
    assert api_pages.wrapped(call).splitlines() == [
        "evaluate(",
        "    policy: Policy,",
        "    tasks: tuple[str, ...] = (),",
        "    *,",
        "    seed: int = 42,",
        "    output: Path | None = None",
        ") -> Run",
    ]
    assert api_pages.wrapped("act(episode: Episode)") == "act(episode: Episode)"


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


def test_each_command_has_a_page_with_its_options() -> None:
    pages = command_pages.pages()
    assert set(pages) == {f"reference/commands/{command}.md" for command in commands()}
    assert "| `max_steps` |" in pages["reference/commands/evaluate.md"]
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
            ],
        },
    ]
    file = tmp_path / "a.ipynb"
    file.write_text(json.dumps({"cells": cells}))
    page = notebook_pages.page(file)
    assert "# Title\n\n```python\nprint(1)\n```\n\n```text\n1\n```" in page
    assert 'src="data:image/png;base64,QUJD"' in page and "Figure" not in page
