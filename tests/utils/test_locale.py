"""Files are UTF-8, and output never fails, whatever the locale of the machine is."""

import ast
import io
import locale
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from helpers import REPOSITORY
from mme_vla.cli.errors import print_user_errors
from mme_vla.evaluation.results.paper import paper_table
from mme_vla.testing.small import small_policy


@pytest.fixture
def _ascii_locale() -> Iterator[None]:
    """A locale whose letters are those of ASCII; `LC_ALL=en_US` has few more."""
    if sys.flags.utf8_mode:
        pytest.skip("Python runs in its UTF-8 mode, in which no locale counts")
    before = locale.setlocale(locale.LC_CTYPE)
    locale.setlocale(locale.LC_CTYPE, "C")
    yield
    locale.setlocale(locale.LC_CTYPE, before)


@pytest.mark.usefixtures("_ascii_locale")
def test_a_policy_is_saved_in_any_locale(tmp_path: Path) -> None:
    small_policy("pi05").save_pretrained(tmp_path)
    text = (tmp_path / "config.json").read_text(encoding="utf-8")
    assert not text.isascii(), "it tests nothing"


@pytest.mark.usefixtures("_ascii_locale")
def test_published_numbers_have_the_same_names_in_any_locale() -> None:
    labels = [row["label"] for row in paper_table("methods")]
    assert labels[:2] == ["π0.5", "π0.5 with past actions"]


def test_output_spells_out_letters_that_a_locale_lacks(monkeypatch: pytest.MonkeyPatch) -> None:
    output = io.BytesIO()
    monkeypatch.setattr(sys, "stdout", io.TextIOWrapper(output, encoding="ascii"))
    with print_user_errors():
        print("Loading … 1 ± 2")
    assert output.getvalue() == b"Loading \\u2026 1 \\xb1 2\n"


ENCODING_PLACE = {"read_text": 0, "write_text": 1}
"""Which argument of a path's method is the encoding, where it has no name."""


def reads_by_locale(call: ast.Call) -> bool:
    """Whether a call reads or writes text in the locale's encoding."""
    keywords = {keyword.arg for keyword in call.keywords}
    if "encoding" in keywords:
        return False
    name = getattr(call.func, "attr", getattr(call.func, "id", ""))
    if name == "open":
        modes = [a.value for a in call.args if isinstance(a, ast.Constant)]
        is_text = any(isinstance(mode, str) and set(mode) <= set("rwaxt+") for mode in modes)
        return ("newline" in keywords or is_text) and "format" not in keywords  # that is of PyAV
    is_method = isinstance(call.func, ast.Attribute)
    return is_method and ENCODING_PLACE.get(name, -1) == len(call.args)


def test_every_text_file_names_its_encoding() -> None:
    lines = []
    for file in sorted([*REPOSITORY.glob("mme_vla/**/*.py"), *REPOSITORY.glob("plugins/**/*.py")]):
        source = file.read_text(encoding="utf-8")
        if any(word in source for word in ("open(", *ENCODING_PLACE)):
            for node in ast.walk(ast.parse(source)):
                if isinstance(node, ast.Call) and reads_by_locale(node):
                    lines.append(f"{file.relative_to(REPOSITORY)}:{node.lineno}")
    assert lines == [], "give encoding='utf-8'"
