"""The numbers of docs/extend/layout.md are those that are counted."""

import pytest
import reading_paths

from helpers import REPOSITORY


@pytest.mark.slow
def test_the_page_on_the_layout_has_the_counted_numbers() -> None:
    page = (REPOSITORY / "docs" / "extend" / "layout.md").read_text()
    for question, (take, _) in zip(reading_paths.QUESTIONS, reading_paths.answers(), strict=True):
        assert f"| {question} | {take} |" in page


def test_the_path_of_an_episode_passes_the_simulation_and_the_policy() -> None:
    for call in (
        ("envs/vector/pool.py", "serve"),
        ("envs/interface.py", "step"),
        ("policy/episode.py", "observe"),
        reading_paths.SAMPLING[0],
        ("evaluation/records.py", "append"),
    ):
        assert call in reading_paths.EVALUATION
    assert len(reading_paths.defining(reading_paths.EVALUATION)) <= 12
