"""The first sentence of a probe's page: what was found, or that it is too little to tell."""

from dataclasses import replace
from pathlib import Path

import pytest

from mme_vla.evaluation.results.compare import Comparison
from mme_vla.evaluation.results.statistics import Interval, sign_test
from mme_vla.extras.probing.conclusions import conclude
from mme_vla.extras.probing.findings import Findings
from mme_vla.extras.probing.lines import EntryLine, MomentLine
from mme_vla.extras.probing.report import COLUMNS, phase_name, phases_table, write_page

LINE = MomentLine("r/0", "VideoUnmask", 20, 0, "", "drop:all", None, 4, [16], 1.0, 0.1, 0.5)
ENTRY = EntryLine("r/0", "VideoUnmask", 20, 0, "memory", 0, 4, 16, True, 0.2, 0.1)


def moments(changes: list[float], arm: str = "drop:all", entries: int = 4) -> list[MomentLine]:
    """A decision of one recorded episode for each change."""
    touched = [16] if entries and arm != "nodemo" else []
    lines = []
    for number, change in enumerate(changes):
        lines.append(
            replace(
                LINE,
                recording=f"r/{number}",
                arm=arm,
                change=change,
                entries=entries,
                touched=touched,
            )
        )
    return lines


def compared(arm: str, wins: int, losses: int, episodes: int, arms: int = 1) -> Comparison:
    p = min(1.0, arms * sign_test(wins, losses))
    smallest = min(1.0, arms * sign_test(episodes, 0))
    solved = episodes // 2
    return Comparison(
        arm,
        "unprobed",
        episodes,
        episodes,
        0.0,
        0.0,
        100 * (wins - losses) / episodes,
        Interval(-100, 0),
        wins,
        losses,
        p,
        p,
        p < 0.05,
        smallest,
        smallest < 0.05,
        first_solved=solved + wins - losses,
        second_solved=solved,
    )


@pytest.mark.parametrize(
    ("lines", "sentence"),
    [
        (
            moments([1.9, 1.9]),
            "Removing the memory changes the actions 19 times as much as noise does: this policy"
            " reads its memory (2 decisions of 2 recorded episodes).",
        ),
        (
            moments([0.0, 0.0]) + moments([0.0], "shuffle"),
            "None of the 2 interventions changes the actions: this policy does not read its memory"
            " (2 decisions of 2 recorded episodes).",
        ),
        (
            moments([0.0], "nodemo", entries=0),
            "nodemo does not change the actions: this policy acts on what it sees now"
            " alone (1 decision of 1 recorded episode).",
        ),
        (
            [*moments([0.0], "delay:64"), ENTRY],
            "The interventions leave the actions as they are, and leaving out a single entry"
            " changes them: this policy reads its memory (1 decision of 1 recorded episode).",
        ),
        (
            moments([0.3]),
            "Removing the memory changes the actions 3.0 times as much as noise does: this policy"
            " reads its memory. One recorded episode is too few to tell for others (1 decision of"
            " 1 recorded episode).",
        ),
        (
            moments([0.05, 0.35]),
            "Removing the memory changes the actions 2.0 times as much as noise does, and more than"
            " noise in 1 of 2 episodes: 2 episodes are too few to tell whether it matters more than"
            " noise (2 decisions of 2 recorded episodes).",
        ),
        (
            moments([0.05, 0.05, 0.08]),
            "Removing the memory changes the actions 0.6 times as much as noise does: what is"
            " changed matters less than noise (3 decisions of 3 recorded episodes).",
        ),
        (
            moments([0.2] * 9 + [0.05]),
            "Removing the memory changes the actions 1.8 times as much as noise does, and more than"
            " noise in 9 of 10 episodes: this policy reads its memory (10 decisions of 10 recorded"
            " episodes).",
        ),
        (
            moments([0.2, 0.2], "nodemo") + moments([0.1, 0.1], "shuffle"),
            "Of 2 interventions, nodemo changes the actions 2.0 times as much as noise does: this"
            " policy depends on what it saw before (2 decisions of 2 recorded episodes).",
        ),
        (
            [replace(line, spread=0.0) for line in moments([0.2, 0.2])],
            "Removing the memory changes the actions by 0.20 (1 is half of what the training data"
            " span), and noise changes nothing: this policy reads its memory (2 decisions of 2"
            " recorded episodes).",
        ),
    ],
)
def test_a_sentence_says_what_recorded_episodes_show(
    lines: list[MomentLine | EntryLine], sentence: str
) -> None:
    assert conclude(Findings.of(lines), []) == sentence


@pytest.mark.parametrize(
    ("comparisons", "sentence"),
    [
        (
            [compared("drop:all", 0, 2, 4)],
            "In closed loop: drop:all 0 of 4 against unprobed 2 of 4: too few episodes to tell"
            " (p = 0.500).",
        ),
        (
            [compared("drop:all", 0, 3, 6, 2), compared("shuffle", 0, 3, 6, 2)],
            "In closed loop: drop:all 0 of 6 against unprobed 3 of 6: too few episodes to tell"
            " (p = 0.500). For all of the 2 interventions in closed loop there are too few episodes"
            " to tell.",
        ),
        (
            [compared("drop:all", 0, 0, 50, 2), compared("shuffle", 0, 0, 50, 2)],
            "None of the 2 interventions in closed loop changes the outcome of any of 50 scenes.",
        ),
        (
            [compared("drop:all", 0, 10, 20, 2), compared("shuffle", 1, 2, 20, 2)],
            "Of the 2 interventions in closed loop, drop:all costs success significantly.",
        ),
        (
            [compared("swap", 0, 3, 20, 2), compared("shuffle", 1, 2, 20, 2)],
            "None of the 2 interventions in closed loop changes success significantly.",
        ),
    ],
)
def test_a_sentence_says_what_the_closed_loop_shows(
    comparisons: list[Comparison], sentence: str
) -> None:
    assert conclude(Findings([], []), comparisons) == sentence


def test_the_terminal_explains_the_columns_of_its_tables(tmp_path: Path) -> None:
    write_page(tmp_path, "nano", 100, Findings(moments([1.0, 0.9]), []))
    text = (tmp_path / "table.md").read_text()
    for name, meaning in COLUMNS:
        assert f"- `{name}`: {meaning}" in text
    assert "`significant`" not in text, "there is no closed loop"


def test_sub_tasks_are_called_by_the_words_that_their_texts_share() -> None:
    texts = ["pick up the red cube", "pick up the blue cube"]
    lines = [replace(LINE, subgoal=text) for text in texts]
    assert phase_name("VideoUnmask", 0, lines) == (
        "VideoUnmask, sub-task 1: pick up the blue/red cube"
    )
    longer = replace(LINE, subgoal="pick up the cube and wait")
    assert phase_name("VideoUnmask", 1, [*lines, longer]) == (
        "VideoUnmask, sub-task 2: pick up the …"
    )
    seconds = [replace(LINE, subgoal=f"pick it up for the {word} time") for word in ("1st", "2nd")]
    assert phase_name("", 2, seconds) == "sub-task 3: pick it up for the 1st/2nd time"
    words = ("1st", "2nd", "3rd", "4th")
    many = [replace(LINE, subgoal=f"pick it up for the {word} time") for word in words]
    assert phase_name("", 2, many) == "sub-task 3: pick it up for the … time"
    assert phase_name("", 2, [LINE]) == "sub-task 3"
    assert phases_table(Findings(lines, [])) is None, "all decisions are of one sub-task"
    both = phases_table(Findings([LINE, replace(LINE, phase=1)], []))
    assert both is not None
    assert both.rows == [["VideoUnmask, sub-task 1", "10.0×"], ["VideoUnmask, sub-task 2", "10.0×"]]
