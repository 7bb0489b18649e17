"""The page on compatibility holds what the recorded runs say."""

from pathlib import Path

import compatibility

JUNIT = """<testsuites><testsuite tests="7" skipped="1" failures="2" errors="1"/></testsuites>"""


def test_the_page_is_that_of_the_recorded_rows() -> None:
    rows = compatibility.recorded()
    assert rows
    assert compatibility.PAGE.read_text() == compatibility.page(rows), (
        "run `python scripts/compatibility.py --page`"
    )


def test_failures_and_errors_are_not_counted_as_passed(tmp_path: Path) -> None:
    report = tmp_path / "tests.xml"
    report.write_text(JUNIT)
    assert compatibility.outcome(report) == {"passed": "3", "skipped": "1", "failed": "3"}
