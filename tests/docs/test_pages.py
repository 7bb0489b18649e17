"""Sizes of the pages, their navigation, and the workflows that build and test them."""

import re
from pathlib import Path

import hooks
import pytest
import yaml

from helpers import REPOSITORY

DOCS = REPOSITORY / "docs"
MAX_WORDS, MAX_WORDS_OF_ALL = 1200, 22_000
WORKFLOWS = REPOSITORY / ".github" / "workflows"


def prose(text: str) -> str:
    """A page without code, tables and what the board of nanoMME writes."""
    text = re.sub(r"<!-- board -->.*?<!-- /board -->", " ", text, flags=re.DOTALL)
    text = re.sub(r"`[^`]*`", " x ", re.sub(r"```.*?```", " ", text, flags=re.DOTALL))
    return "\n".join(line for line in text.splitlines() if not line.lstrip().startswith("|"))


def pages() -> list[Path]:
    """Pages written for users."""
    stored = [
        page for page in sorted(DOCS.rglob("*.md")) if page.relative_to(DOCS).parts[0] != "evidence"
    ]
    return [REPOSITORY / "README.md", REPOSITORY / "CONTRIBUTING.md", *stored]


def test_pages_are_short() -> None:
    words = {
        str(page.relative_to(REPOSITORY)): len(prose(page.read_text()).split()) for page in pages()
    }
    assert {page: count for page, count in words.items() if count > MAX_WORDS} == {}
    by_hand = [n for page, n in words.items() if not page.startswith("docs/reference/")]
    assert sum(by_hand) <= MAX_WORDS_OF_ALL
    assert len((REPOSITORY / "README.md").read_text().splitlines()) <= 120


def test_pages_have_few_semicolons() -> None:
    text = "\n".join(prose(page.read_text()) for page in pages())
    assert text.count(";") <= 0.05 * len(re.findall(r"[.!?](?=\s|$)", text))


@pytest.mark.parametrize("page", pages(), ids=lambda page: page.relative_to(REPOSITORY).as_posix())
def test_a_page_begins_with_one_title_and_its_purpose(page: Path) -> None:
    text = re.sub(r"^```.*?^```", "", page.read_text(), flags=re.DOTALL | re.MULTILINE)
    assert len(re.findall(r"^# ", text, re.MULTILINE)) == 1
    title, blank, purpose, *_ = text.splitlines()
    assert title.startswith("# ") and not blank and len(purpose) > 20


def test_the_navigation_has_the_tasks_of_a_user() -> None:
    titles = [title for entry in hooks.navigation() for title in entry]
    assert titles == [
        "Start",
        "Train",
        "Evaluate",
        "Serve",
        "Probe",
        "Extend",
        "Benchmark",
        "Evidence",
        "Reference",
    ]


def test_no_page_hangs_between_groups_of_the_navigation() -> None:
    """A page without a group comes before the groups of its tab, or it seems to belong to one."""
    for tab in hooks.navigation():
        for title, entries in tab.items():
            is_group = [
                isinstance(entry, dict) and isinstance(next(iter(entry.values())), list)
                for entry in entries
            ]
            assert is_group == sorted(is_group), title


def test_no_page_has_text_art() -> None:
    for page in pages():
        blocks = re.findall(
            r"^```(\w*)[^\n]*\n(.*?)^```", page.read_text(), re.DOTALL | re.MULTILINE
        )
        for language, block in blocks:
            if language in ("", "text"):
                assert not re.search(r"[►◄▼▲]", block), page


def test_every_page_is_in_the_navigation_once() -> None:
    listed = list(leaves(hooks.navigation()))
    stored = {page.relative_to(DOCS).as_posix() for page in DOCS.rglob("*.md")}
    assert sorted(listed) == sorted(stored | set(hooks.generated()))


def test_the_documentation_workflow_builds_the_site() -> None:
    assert ".venv/bin/mme-vla docs --build" in steps("docs.yml")


def test_the_test_workflow_trains_and_runs_both_tiers() -> None:
    runs = list(steps("tests.yml"))
    assert any(run.endswith("python -m mme_vla.train model=tokendrop_expert") for run in runs)
    content = yaml.safe_load((WORKFLOWS / "tests.yml").read_text())
    assert content["jobs"]["test"]["strategy"]["matrix"]["tier"] == [
        "not slow and not nightly",
        "slow",
    ]
    assert any('pytest -m "${{ matrix.tier }}"' in run and "--dist loadfile" in run for run in runs)


@pytest.mark.parametrize("workflow", sorted(WORKFLOWS.glob("*.yml")), ids=lambda file: file.stem)
def test_a_workflow_pins_its_actions_and_has_limits(workflow: Path) -> None:
    content = yaml.safe_load(workflow.read_text())
    assert content["permissions"] == {"contents": "read"}
    assert "concurrency" in content
    for job in content["jobs"].values():
        assert "timeout-minutes" in job
        for step in job["steps"]:
            assert re.fullmatch(r"[\w/-]+@v\d+\.\d+\.\d+", step.get("uses", "run@v0.0.0"))
            if step.get("uses", "").startswith("actions/checkout@"):
                assert step["with"]["persist-credentials"] is False  # none in what tests read


def steps(workflow: str) -> list[str]:
    """The shell commands of a workflow, which runs on changes to `main` and on pull requests."""
    content = yaml.safe_load((WORKFLOWS / workflow).read_text())
    events = content[True]  # YAML reads the key `on` so
    assert events["push"] == {"branches": ["main"]} and "pull_request" in events
    return [
        step["run"] for job in content["jobs"].values() for step in job["steps"] if "run" in step
    ]


def leaves(entries: list) -> list[str]:
    """The pages below entries of the navigation."""
    match = []
    for entry in entries:
        below = next(iter(entry.values())) if isinstance(entry, dict) else entry
        match += [below] if isinstance(below, str) else leaves(below)
    return match
