"""The numbers of docs/extend/layout.md are those that are counted."""

import pytest
import reading_paths

from helpers import REPOSITORY


@pytest.mark.slow
def test_the_page_on_the_layout_has_the_counted_numbers() -> None:
    page = (REPOSITORY / "docs" / "extend" / "layout.md").read_text()
    for question, (take, _) in zip(reading_paths.QUESTIONS, reading_paths.answers(), strict=True):
        assert f"| {question} | {take} |" in page
