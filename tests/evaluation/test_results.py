"""The results command: the paper's tables come back, nothing incomplete is averaged, comparisons
are paired.
"""

import csv
import io
import sys
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import binomtest

from helpers.rollout_fakes import records as run_of
from helpers.rollout_fakes import save_records
from mme_vla import UserError, cli
from mme_vla.cli.results import main
from mme_vla.evaluation.records import EpisodeRecord
from mme_vla.evaluation.results import paper, plots
from mme_vla.evaluation.results.aggregate import Results, aggregate
from mme_vla.evaluation.results.compare import compare, compare_all
from mme_vla.evaluation.results.paper import demo_records
from mme_vla.evaluation.results.report import conclude, policy_facts, training_details
from mme_vla.evaluation.results.scopes import PAPER_ORDER, TASK_FACTS, Protocol, tasks_of
from mme_vla.evaluation.results.statistics import (
    estimate,
    holm,
    mean_interval,
    paired_interval,
    paired_test,
    resampled_means,
    sign_test,
    tango,
    wilson,
)
from mme_vla.evaluation.results.tables import (
    Table,
    comparison_table,
    leaderboard,
    overview,
    runs_table,
    to_csv,
    to_latex,
    to_markdown,
)
from mme_vla.evaluation.store import begin_run

# Where the paper's suite and group tables differ from the means of its own per-task table.
MISPRINTS = {
    ("pi_0.5", "Short-Horizon Video Reasoning"),
    ("RMT+Expert", "Reference"),
    ("RMT+Expert", "average"),
    ("TTT+Modul", "Permanence"),
    ("TTT+Modul", "average"),
    ("TokenDrop+Context", "Imitation"),
}
SMALL = Protocol(("BinFill", "MoveCube"), episodes=4)


def records(
    model: str, wins: dict[str, list[int]], seed: int = 7, checkpoint: int = 100, **more: object
) -> list[EpisodeRecord]:
    """One run: for each task the outcomes of its episodes."""
    return [
        EpisodeRecord(
            model, checkpoint, seed, task, e, e, "easy", "success" if won else "fail", 10, **more
        )  # type: ignore[arg-type]
        for task, outcomes in wins.items()
        for e, won in enumerate(outcomes)
    ]


def as_published(method: str) -> list[EpisodeRecord]:
    """Nine runs with as many successes in all as the paper's rates mean."""
    known = paper.paper_methods()[method]
    made = []
    for task, result in paper.per_task(method).items():
        outcomes = np.arange(450) < round(4.5 * result.mean)
        for i, run in enumerate(np.random.default_rng(0).permutation(outcomes).reshape(9, 50)):
            made += records(
                known.model or "", {task: run.tolist()}, seed=(7, 42, 0)[i % 3], checkpoint=i // 3
            )
    return made


@pytest.fixture(scope="module")
def demo() -> Results:
    return aggregate(demo_records([("framesamp_modul", None), ("groundsg", "qwenvl")]), Protocol())


# The paper


@pytest.mark.parametrize(("method", "average"), [("FrameSamp+Modul", 44.51), ("pi_0.5", 17.93)])
def test_records_with_the_papers_rates_give_the_papers_average_suites_and_groups(
    method: str, average: float
) -> None:
    (method_result,) = aggregate(as_published(method), Protocol()).methods
    assert method_result.average.mean == pytest.approx(average, abs=0.006)
    assert method_result.average.complete == 9
    for kind, table in (("suite", "suites"), ("group", "groups")):
        printed = next(row for row in paper.paper_table(table) if row["method"] == method)
        for name, figure in method_result.figures[kind].items():
            if (method, name) not in MISPRINTS:
                assert figure.mean == pytest.approx(float(printed[name]), abs=0.0101), name


def test_the_shipped_numbers_are_the_papers(shared: Path) -> None:
    for name, published in {
        "per_task": "results_per_task",
        "memory_budget": "memory_budget",
    }.items():
        assert paper.paper_table(name) == list(
            csv.DictReader((shared / "paper" / f"{published}.csv").open())
        )
    for row in csv.DictReader((shared / "paper" / "task_groups.csv").open()):
        task = TASK_FACTS[row["task"]]
        facts = (task.suite, "+".join(task.memory), task.group, str(task.steps))
        assert facts == (
            row["suite"],
            row["memory_type"],
            row["functional_group"],
            row["avg_steps"],
        )


# Statistics


def test_wilson_is_the_textbooks() -> None:
    assert wilson(0.0, 10) == pytest.approx((0.0, 0.2775), abs=1e-4)
    assert wilson(0.5, 50) == pytest.approx((0.3664, 0.6336), abs=1e-4)


def test_sign_test_and_holm_are_the_textbooks() -> None:
    assert sign_test(0, 0) == 1.0
    assert sign_test(1, 9) == pytest.approx(22 / 1024)
    assert sign_test(5, 5) == 1.0
    assert sign_test(4000, 1000) < 1e-300
    assert holm([0.01, 0.04, 0.03]) == pytest.approx([0.03, 0.06, 0.06])


def test_wilson_is_scipys_and_a_mean_over_equal_tasks_is_that_of_all_their_episodes() -> None:
    assert wilson(0.3, 10) == pytest.approx(tuple(binomtest(3, 10).proportion_ci(method="wilson")))
    tasks = [np.zeros((3, 1)), np.zeros((3, 1))]
    assert mean_interval(tasks) == pytest.approx(wilson(0, 6))


def test_the_ends_of_tangos_interval_have_the_score_of_its_level() -> None:
    assert tango(0, 0, 3) == pytest.approx((-0.5615, 0.5615), abs=1e-4)
    low, high = tango(12, 2, 50)
    for end in (low, high):  # at an end the score is the normal quantile
        b = -14 + (100 - 12 + 2) * end
        q = (np.sqrt(b * b + 8 * 50 * 2 * end * (1 - end)) - b) / 200
        score = (10 - 50 * end) / np.sqrt(50 * (2 * q + end * (1 - end)))
        assert abs(score) == pytest.approx(1.95996, abs=1e-3)


@pytest.mark.parametrize("winner", [1.0, -1.0])
@pytest.mark.parametrize(("tasks", "episodes"), [(6, 1), (10, 2), (13, 3), (16, 50)])
def test_a_side_that_solves_every_episode_of_every_task_has_an_interval(
    tasks: int, episodes: int, winner: float
) -> None:
    gaps = {str(task): np.full(episodes, winner) for task in range(tasks)}
    low, high = sorted(winner * np.array(paired_interval(gaps)))
    assert -1 <= low < high == 1.0


def test_a_task_of_few_episodes_makes_a_difference_uncertain() -> None:
    low, high = paired_interval({"a": np.zeros(1), "b": np.zeros(99)})
    assert low < -0.45 and high > 0.45
    rng, covered = np.random.default_rng(0), 0
    for _ in range(300):
        gaps = {}
        for name, count, gained in (("a", 2, 0.3), ("b", 50, 0.05)):
            sampled = rng.random(count)
            gaps[name] = (sampled < gained).astype(float) - (sampled > 0.95)
        low, high = paired_interval(gaps)
        covered += low <= (0.3 - 0.05 + 0.05 - 0.05) / 2 <= high
    assert covered / 300 >= 0.92


def test_a_test_of_a_difference_is_mcnemars_or_follows_the_mean() -> None:
    gaps = np.array([1.0] * 12 + [-1.0] * 2 + [0.0] * 30)
    assert paired_test({"a": gaps}) == sign_test(12, 2)
    # More episodes favour the first side, and the mean over tasks the second.
    assert paired_test({"a": -np.ones(2), "b": np.array([1.0] * 18 + [0.0] * 2)}) == 1.0
    assert paired_test({"a": np.zeros(5)}) == 1.0


def test_a_difference_of_trainings_is_significant_where_its_interval_has_no_zero() -> None:
    rng = np.random.default_rng(0)
    for shift in (0.0, 0.1, 0.2, 0.3, 0.5):
        trained = estimate([[rng.random((20, 3)) + shift], [-rng.random((20, 2))]])
        low, high = trained.interval()
        assert (trained.p < 0.05) == (not low <= 0 <= high)


@pytest.mark.parametrize("n_trainings", [2, 3, 5])
def test_trainings_that_differ_more_than_methods_are_no_difference(n_trainings: int) -> None:
    rng = np.random.default_rng(n_trainings)
    repeats = 400
    significant = covered = 0
    for _ in range(repeats):
        rates = rng.uniform(0.3, 0.7, (4, 25, 1))  # of four tasks and their episodes

        def outcomes(rates: np.ndarray = rates) -> list[np.ndarray]:
            trained = rates + rng.normal(0, 0.1, n_trainings)
            return list((rng.random(trained.shape) < trained).astype(float))

        first = outcomes()
        significant += estimate([first, [-values for values in outcomes()]]).p < 0.05
        low, high = estimate([first]).interval()
        covered += low <= rates.mean() <= high
    assert significant / repeats < 0.08
    # Of two trainings the degrees of freedom are themselves uncertain.
    assert covered / repeats > (0.85 if n_trainings == 2 else 0.92)


def test_one_training_and_one_episode_leave_their_variance_out() -> None:
    alone = estimate([[np.array([[1.0], [0.0]])]])
    assert alone.value == 0.5 and alone.error == pytest.approx(0.5) and alone.freedom == 1
    assert estimate([[np.ones((1, 1))]]) == (1.0, 0.0, 1.0)


@pytest.mark.parametrize("n_episodes", [2, 3, 25])
def test_resampled_means_vary_as_much_as_means_of_other_episodes_do(n_episodes: int) -> None:
    rng = np.random.default_rng(n_episodes)
    variances = []
    for seed in range(2000):
        tasks = {name: [rng.random(n_episodes)] for name in "ab"}
        variances.append(resampled_means(tasks, samples=100, seed=seed).var(ddof=1))
    # A number between 0 and 1 has the variance 1/12. Samples of all 25 episodes miss 4 %.
    assert np.mean(variances) == pytest.approx(1 / 12 / n_episodes / 2, rel=0.03)


def test_one_episode_is_its_only_sample() -> None:
    assert (resampled_means({"a": [np.array([0.25])]}, samples=20, seed=0) == 0.25).all()


def test_intervals_of_a_difference_never_contradict_the_test() -> None:
    for n in (1, 3, 5, 6, 12, 40):
        for won in range(0, n + 1, 1 + n // 8):
            for lost in range(0, n - won + 1, 1 + n // 8):
                gaps = np.array([1] * won + [-1] * lost + [0] * (n - won - lost), float)
                low, high = paired_interval({"a": gaps})
                assert -1 <= low < high <= 1, "of no width"
                assert low <= gaps.mean() <= high
                assert (low <= 0 <= high) == (paired_test({"a": gaps}) >= 0.05), (won, lost, n)
                assert paired_test({"a": gaps}) >= sign_test(won, lost)


@pytest.mark.slow
def test_an_interval_of_a_paired_difference_covers_the_truth_at_any_number_of_episodes() -> None:
    rng = np.random.default_rng(2)
    for n in (3, 20, 200):
        covered = 0
        for _ in range(100):
            gaps = rng.choice([-1.0, 0.0, 1.0], n, p=[0.1, 0.5, 0.4])
            low, high = paired_interval({"a": gaps})
            covered += low <= 0.3 <= high
        assert covered >= 90, n


# Aggregation


def test_runs_are_averaged_after_their_tasks() -> None:
    made = records("a", {"BinFill": [1, 1, 1, 1], "MoveCube": [0, 0, 0, 1]}, seed=0)
    made += records("a", {"BinFill": [1, 1, 0, 0], "MoveCube": [0, 0, 0, 0]}, seed=1)
    (method,) = aggregate(made, SMALL).methods
    rates = (62.5, 25.0)
    assert method.average.mean == pytest.approx(np.mean(rates))
    assert method.average.std == pytest.approx(np.std(rates, ddof=1))
    assert method.figures["suite"]["Imitation"].mean == pytest.approx(12.5)
    assert method.figures["task"]["BinFill"].mean == pytest.approx(75)
    assert set(method.figures["group"]) == {"Event-Salient"}


def test_an_incomplete_run_is_reported_as_incomplete_and_never_averaged() -> None:
    complete = records("a", {"BinFill": [1, 1, 0, 0], "MoveCube": [1, 0, 0, 0]}, seed=0)
    part = records("a", {"BinFill": [1, 1, 1, 1], "MoveCube": [1, 1]}, seed=1)
    results = aggregate(complete + part, SMALL)
    average = results.methods[0].average
    assert (average.mean, average.std, average.complete, average.runs) == (37.5, None, 1, 2)
    assert "(1 of 2 runs)" in overview(results).rows[0][-2]
    assert any("6 of 8 episodes" in note for note in results.notes)
    assert results.methods[0].figures["task"]["BinFill"].complete == 2  # that task is whole in both
    alone = aggregate(part, SMALL)
    assert alone.methods[0].average.mean is None
    assert overview(alone).rows[0][-2:] == ["100.0 (6 of 8)", ""]
    (board,) = leaderboard(alone.methods[0], alone)
    assert board.rows[1][1:] == ["2 of 4 episodes", "incomplete"]
    assert board.rows[-1][1:] == ["incomplete", "incomplete"]


def test_errors_are_failures_or_missing_as_requested() -> None:
    made = records("a", {"BinFill": [1, 1, 1, 1], "MoveCube": [1, 1, 1, 1]})
    made[0] = replace(made[0], outcome="error")
    results = aggregate(made, SMALL)
    assert results.methods[0].average.mean == 87.5
    assert any("1 episode ended in an error" in note for note in results.notes)
    assert aggregate(made, replace(SMALL, errors="missing")).methods[0].average.mean is None
    errors = [record for record in made if record.outcome == "error"]
    with pytest.raises(UserError, match=rf"All {len(errors)} episodes ended in an error, and err"):
        aggregate(errors, replace(SMALL, errors="missing"))


def test_difficulties_cut_across_tasks() -> None:
    made = records("a", {"BinFill": [1, 1, 0, 0], "MoveCube": [1, 0, 0, 0]})
    made = [replace(r, difficulty="hard" if r.episode > 1 else "easy") for r in made]
    figures = aggregate(made, SMALL).methods[0].figures["difficulty"]
    assert {level: figure.mean for level, figure in figures.items()} == {"easy": 75.0, "hard": 0.0}
    # Of MoveCube only easy episodes are done: what its hard ones will be is not known.
    figures = aggregate(made[:6], SMALL).methods[0].figures["difficulty"]
    assert {figure.mean for figure in figures.values()} == {None}


def test_wrong_records_are_refused() -> None:
    made = records("a", {"BinFill": [1]})
    for wrong, message in (
        ([replace(made[0], task="BinFil")], "None of the 1 records"),
        ([*made, replace(made[0], split="val")], "several splits"),
        ([*made, replace(made[0], model="b", seed=9)], "different benchmarks"),
        ([replace(made[0], episode=90)], "None of the 1 records"),
        ([], "no record"),
    ):
        with pytest.raises(UserError, match=message):
            aggregate(wrong, SMALL)
    with pytest.raises(UserError, match="each once"):
        Protocol(("BinFill", "BinFill"))
    with pytest.raises(
        UserError,
        match=r"RoboMME has no task 'BinFil', and no record is of it\. Did you mean 'BinFill'",
    ):
        aggregate(made, Protocol(("BinFill", "BinFil")))


def test_own_tasks_form_a_group_beside_the_benchmark() -> None:
    benchmark, custom = (
        records("a", {"BinFill": [1, 0]}),
        records("a", {"TwoButtons": [1, 1], "Stay": [0, 1]}),
    )
    (alone,) = aggregate(custom, Protocol(tasks_of(custom), 2)).methods
    assert (alone.average.mean, alone.figures["suite"]["Own tasks"].mean) == (75.0, 75.0)
    assert all(run.complete for run in alone.runs)
    tasks = ("BinFill", "TwoButtons", "Stay")
    both = aggregate([*benchmark, *custom], Protocol(tasks, 2))
    (method,) = both.methods
    assert (method.average.mean, method.figures["suite"]["Own tasks"].mean) == (50.0, 75.0)
    assert method.figures["task"]["TwoButtons"].mean == 100.0
    assert all(run.complete for run in method.runs)
    assert both.notes == []
    assert tasks_of([*benchmark, *custom]) == (*PAPER_ORDER, "Stay", "TwoButtons")


# Comparison


def test_a_comparison_pairs_the_episodes() -> None:
    protocol = Protocol(("BinFill",), episodes=50)
    a, b = [1] * 30 + [0] * 20, [1] * 20 + [0] * 30
    results = aggregate(records("a", {"BinFill": a}) + records("b", {"BinFill": b}), protocol)
    result = compare(*results.methods, protocol)
    assert (result.wins, result.losses, result.difference) == (10, 0, pytest.approx(20))
    assert result.p == pytest.approx(2 / 2**10)
    assert result.interval.low > 0
    assert result.verdict == "a 30 of 50 against b 20 of 50: a is significantly better (p = 0.002)"
    # The same two rates on other episodes: 30 against 20 differing pairs are no longer significant.
    shifted = aggregate(records("a", {"BinFill": a}) + records("b", {"BinFill": b[::-1]}), protocol)
    other = compare(*shifted.methods, protocol)
    assert (other.wins, other.losses) == (30, 20)
    assert not other.significant
    assert "no significant difference" in other.verdict


@pytest.mark.parametrize("first, low", [([0, 0, 0], -100.0), ([1, 1, 1], -56.15)])
def test_three_episodes_are_too_few_to_tell(first: list[int], low: float) -> None:
    protocol = Protocol(("BinFill",), episodes=3)
    made = records("a", {"BinFill": first}) + records("b", {"BinFill": [1, 1, 1]})
    (result,) = compare_all([tuple(aggregate(made, protocol).methods)], protocol)
    assert result.interval.low == pytest.approx(low, abs=0.01) and result.interval.high > 40
    assert f"a {sum(first)} of 3 against b 3 of 3: too few episodes to tell (p = " in result.verdict
    assert comparison_table([result]).rows[0][-1] == "too few episodes"


def test_six_episodes_are_enough_for_one_comparison_and_not_for_two() -> None:
    protocol = Protocol(("BinFill",), episodes=6)
    made = records("a", {"BinFill": [1] * 6}) + records("b", {"BinFill": [0] * 6})
    first, second = aggregate(made, protocol).methods
    (alone,) = compare_all([(first, second)], protocol)
    assert alone.significant and alone.interval.low > 0
    both = compare_all([(first, second), (second, first)], protocol)
    assert not any(comparison.testable for comparison in both)


@pytest.mark.slow
def test_several_comparisons_are_corrected(demo: Results) -> None:
    pair = (demo.methods[0], demo.methods[1])
    (alone,), (first, _) = (
        compare_all([pair], demo.protocol),
        compare_all([pair, pair[::-1]], demo.protocol),
    )
    assert first.corrected == pytest.approx(min(1, 2 * alone.p))
    with pytest.raises(UserError, match="with itself"):
        compare(pair[0], pair[0], demo.protocol)


# Output


def test_the_leaderboard_has_sixteen_rows_three_seeds_and_their_average(demo: Results) -> None:
    boards = leaderboard(demo.method("framesamp_modul"), demo)
    assert len(boards) == 3  # checkpoints
    assert boards[0].columns == ["Task", "Seed 7", "Seed 42", "Seed 0", "Average"]
    assert len(boards[0].rows) == 17
    for row in boards[0].rows:
        *seeds, average = map(float, row[1:])
        assert average == pytest.approx(np.mean(seeds), abs=0.011)
    assert to_markdown(boards[0]).count("\n| ") == 19  # and two lines of head


def test_csv_holds_the_figures_and_latex_escapes(demo: Results) -> None:
    rows = list(csv.DictReader(to_csv(demo).splitlines()))
    row = next(r for r in rows if (r["method"], r["kind"]) == ("framesamp_modul", "average"))
    assert float(row["mean"]) == pytest.approx(
        demo.method("framesamp_modul").average.mean, abs=1e-3
    )
    assert float(row["paper_mean"]) == pytest.approx(44.51, abs=0.005)
    assert len(rows) == 2 * (16 + 4 + 6 + 1 + 3)
    latex = to_latex(overview(demo))
    assert r"framesamp\_modul" in latex
    assert r"95 \%" in latex
    assert r"$\pm$" in latex


def test_the_command_reads_shards_and_saves_every_format(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "run"
    for shard in range(2):
        for name, wins in (("pi05", [1, 0, 0, 0]), ("ttt_modul", [1, 1, 0, 1])):
            made = records(name, {"BinFill": wins, "MoveCube": wins})
            save_records(run / f"episodes-{shard}.jsonl", made[shard::2])
    files = {
        kind: tmp_path / "out" / f"results.{kind}" for kind in ("csv", "latex", "markdown", "html")
    }
    options = [part for kind, path in files.items() for part in (f"--{kind}", str(path))]
    main([str(run), "--tasks", "BinFill", "MoveCube", "--episodes", "4", *options])
    printed = capsys.readouterr().out
    assert "75.00" in printed
    # two methods are compared unasked
    assert "pi05 2 of 8 against ttt_modul 6 of 8: no significant difference (p = 0.125)" in printed
    page = files["html"].read_text()
    assert page.count("<svg") == 1  # of the tasks; others would have their bars, or one a method
    assert '<p class="lead">pi05 2 of 8 against ttt_modul 6 of 8: no significant' in page
    assert "<script" not in page
    assert 'src="http' not in page
    assert all(path.stat().st_size > 100 for path in files.values())


def small_runs(folder: Path) -> list[str]:
    """Three episodes of one task with a memory and without, as the first hour makes them."""
    model = "framesamp_modul-every_8-grid_1"
    for name, won in ((model, True), (f"{model} · drop:all", False)):
        made = records(name, {"VideoUnmask": [won] * 6}, checkpoint="nano")
        save_records(
            folder / ("with" if won else "without"), [made[number] for number in (0, 4, 5)]
        )
    return [str(folder)]


@pytest.mark.parametrize(
    ("solved", "sentence"),
    [
        (
            (3, 3, 1),
            "a solves 75.0 % of 4 episodes of StopCube (95 % interval 30.1 to 95.4), as many as b.",
        ),
        (
            (1, 3, 2),
            "b solves 75.0 % of 4 episodes of StopCube (95 % interval 30.1 to 95.4), the"
            " most of 3 methods; next is c with 50.0 %.",
        ),
    ],
)
def test_the_best_of_several_methods_is_named_with_those_that_solve_as_many(
    solved: tuple[int, ...], sentence: str
) -> None:
    made = []
    for name, n_solved in zip("abc", solved, strict=True):
        made += records(name, {"StopCube": [number < n_solved for number in range(4)]})
    results = aggregate(made, Protocol.of_records(made))
    assert conclude(results, []) == [sentence]


def test_methods_without_all_episodes_are_not_ranked() -> None:
    every = records("a", {"StopCube": [1] * 6})
    assert conclude(aggregate([*every[:3], *records("b", {"StopCube": [0] * 6})[3:]]), []) == [
        "None of 2 methods has all its episodes yet, so none is ranked."
    ]
    made = [*every[:3]]
    for name, n_solved in (("b", 2), ("c", 1)):
        made += records(name, {"StopCube": [number < n_solved for number in range(6)]})
    (sentence,) = conclude(aggregate(made, Protocol.of_records(made)), [])
    assert sentence.startswith("b solves 33.3 % of 6 episodes")
    assert sentence.endswith("the most of 2 complete methods; next is c with 16.7 %.")


def test_step_limits_that_differ_are_noted() -> None:
    first = records("a", {"StopCube": [1, 0], "BinFill": [1, 0]})
    second = records("b", {"StopCube": [1, 0], "BinFill": [1, 0]})
    shorter = [replace(record, max_steps=20) for record in second]
    notes = aggregate([*first, *shorter], Protocol.of_records(first)).notes
    (note,) = [note for note in notes if "Step limits" in note]
    assert note.startswith("Step limits differ: 1300 in a, ") and "; 20 in b, " in note
    equal = aggregate([*first, *second], Protocol.of_records(first)).notes
    assert not any("Step limits" in note for note in equal)


def test_environments_and_action_spaces_that_differ_are_noted() -> None:
    first = records("a", {"Stack": [1, 0]}, env="lab", action_space="ee_pose")
    second = records("b", {"Stack": [1, 0]}, env="other_lab")
    notes = "\n".join(aggregate([*first, *second]).notes)
    assert "Environments differ: lab in a, " in notes and "; other_lab in b, " in notes
    assert "Action spaces differ: ee_pose in a, " in notes
    assert not any("differ: " in note for note in aggregate(first).notes)


def test_choices_beside_the_papers_numbers_are_noted() -> None:
    def has_note(space: str) -> bool:
        made = [replace(record, action_space=space) for record in records("pi05", {"BinFill": [1]})]
        notes = aggregate(made, Protocol.of_records(made)).notes
        return any(note.startswith("pi05 chose among options") for note in notes)

    assert has_note("multi_choice") and not has_note("joint_angle")


def test_a_task_of_an_environment_without_suites_has_as_many_episodes_as_recorded(
    tmp_path: Path,
) -> None:
    save_records(tmp_path, records("a", {"Stack": [1, 0]}, env="lab"))
    page = tmp_path / "page.html"
    main([str(tmp_path), "--html", str(page)])
    text = page.read_text()
    assert "1 run of Stack × 2 episodes" in text and "Pale" not in text


def test_the_curve_over_budgets_leaves_out_events_and_draws_runs_that_all_failed() -> None:
    failed = records("framesamp_modul", {"BinFill": [0] * 7})
    made = [*failed, *(replace(record, memory_budget=256) for record in failed)]
    made += [replace(record, event="pause:100", outcome="success") for record in failed]
    points = plots.budget_points(aggregate(made, Protocol.of_records(made)).methods, 512)
    (curve,) = points.values()
    assert [(budget, figure.mean) for budget, figure in curve] == [(256, 0), (512, 0)]
    assert "<svg" in plots.budget_curve(points)


def test_configurations_of_one_budget_have_a_curve_each() -> None:
    made = records("framesamp_modul", {"BinFill": [1, 0]})
    for composition in ("aaaa", "bbbb"):
        made += records(
            "framesamp_modul", {"BinFill": [1, 1]}, composition=composition, memory_budget=256
        )
    points = plots.budget_points(aggregate(made, Protocol.of_records(made)).methods, 512)
    assert {name: [budget for budget, _ in curve] for name, curve in points.items()} == {
        "framesamp_modul": [512],
        "framesamp_modul#aaaa": [256],
        "framesamp_modul#bbbb": [256],
    }


def test_every_figure_of_tasks_with_unequal_numbers_of_episodes_is_a_mean_over_tasks() -> None:
    made = records("mine", {"StopCube": [1], "BinFill": [0] * 9})
    results = aggregate(made, Protocol.of_records(made))
    assert results.methods[0].average.mean == 50
    assert runs_table(results).rows[0][-1] == "50.00"
    assert conclude(results, [])[0].startswith(
        "mine solves 50.0 % on average over 2 tasks, 10 episodes in all (95 % interval"
    )


def test_a_small_run_shows_what_it_has_within_eighty_columns(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "page.html"
    main([*small_runs(tmp_path / "runs"), "--html", str(page)])
    tables, _, sentences = capsys.readouterr().out.partition("nano 3 of 3 against")
    assert max(map(len, tables.splitlines())) <= 80
    assert "StopCube" not in tables and "paper" not in tables and " of 50" not in tables
    assert "[43.9, 100.0]" in tables and "[0.0, 56.1]" in tables
    assert sentences.startswith(" nano · drop:all 0 of 3: too few episodes to tell (p = 0.250).")
    text = page.read_text()
    assert text.count("<svg") == 1 and text.count("n=3") == 2, "one pale bar a method"
    assert "VideoUnmask, 3 of 50 episodes" in text and "framesamp_modul-every" not in text


@pytest.mark.parametrize(
    ("words", "expected"),
    [
        (["--all"], ["100.0 (3 of 800)", "StopCube"]),
        (["--tasks", "[StopCube,VideoUnmask]"], ["100.0 (3 of 53)", "StopCube"]),
        (["--episodes", "[0,4,5]"], ["100.00"]),
        (["--episodes", "0,4-5"], ["100.00"]),
        (["--tasks", "VideoUnmask", "--episodes", "5"], ["100.0 (2 of 5)"]),
        (["--episodes", "[5]"], ["100.00"]),
    ],
)
def test_tasks_and_episodes_are_named_as_everywhere(
    words: list[str], expected: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    main([*small_runs(tmp_path), *words])
    printed = capsys.readouterr().out
    for text in expected:
        assert text in printed


def test_wrong_episodes_are_refused_in_a_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for words, message in (
        ("0-x", "--episodes='0-x' is not understood"),
        ("[60]", "no episode 60"),
    ):
        with pytest.raises(SystemExit):
            main([*small_runs(tmp_path / words[:2]), "--episodes", words])
        assert message in capsys.readouterr().err
    with pytest.raises(SystemExit):
        main([*small_runs(tmp_path / "of"), "--episodes", "7-9"])
    assert "they are of VideoUnmask 0,4,5." in capsys.readouterr().err


def test_results_of_another_environment_have_nothing_of_the_paper(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # A model that the paper reports, on a task that it does not have
    made = records("framesamp_modul", {"FirstLight": [1, 0, 0]}, suite="Lights", max_steps=25)
    save_records(tmp_path, made)
    main([str(tmp_path)])
    printed = capsys.readouterr().out
    assert "paper" not in printed and "difference" not in printed
    assert "framesamp_modul solves 33.3 % of 3 episodes of FirstLight" in printed


def test_a_submission_tells_how_the_policy_was_trained(tmp_path: Path) -> None:
    wins = {"BinFill": [1, 0], "MoveCube": [1, 1]}
    config = {
        "memory": {"name": "ttt", "budget": 512},
        "integration": {"name": "expert"},
        "card": {"data": "robomme", "recipe": {"steps": 80000, "batch_size": 64, "lr": 5e-5}},
    }
    begin_run(
        tmp_path / "a", {"model": "ttt_expert", "checkpoint": 100}, {"policy": policy_facts(config)}
    )
    for folder, name in (("a", "ttt_expert"), ("b", "pi05")):
        save_records(
            tmp_path / folder, [*records(name, wins, seed=7), *records(name, wins, seed=42)]
        )
    out = tmp_path / "out.md"
    options = [
        "--tasks",
        "BinFill",
        "MoveCube",
        "--episodes",
        "2",
        "--brief",
        "--markdown",
    ]
    main([str(tmp_path / "a"), str(tmp_path / "b"), *options, str(out)])
    _, _, details = out.read_text().partition("## Training details")
    trained, unknown = details.split("**pi05")
    assert "memory ttt, 512 tokens, integration expert" in trained and "data: robomme" in trained
    assert "updates 80000, samples an update 64, peak learning rate 5e-05" in trained
    assert "joint_angle actions, at most 1300 steps, model seeds 7, 42" in trained
    assert unknown.count("state it manually") == 2


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "message"),
    [([], "Name files or folders"), (["nowhere"], "does not exist"),
     (["--demo", "--compare", "pi05", "pi06"], "pi06"),
     (["--demo", "--tasks", "Binfill"], "Did you mean 'BinFill'")],
)  # fmt: skip
def test_mistakes_end_with_a_sentence(
    arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(arguments)
    assert ended.value.code == 2
    assert message in capsys.readouterr().err


def test_a_run_without_an_ended_episode_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    empty = tmp_path / "empty" / "episodes.jsonl"
    save_records(empty, [])
    save_records(tmp_path / "there", [EpisodeRecord("m", 1, 7, "BinFill", 0, 0, "easy", "fail", 9)])
    there = str(tmp_path / "there")
    for silent in (str(empty), str(empty.parent)):
        with pytest.raises(SystemExit):
            main([silent, "--brief"])
        assert f"{silent}: no episode has ended there yet, so" in capsys.readouterr().err
    main([there, str(empty.parent), "--brief"])
    printed = capsys.readouterr()
    assert f"{empty.parent}: no episode has ended there yet" in printed.err
    assert "BinFill" in printed.out
    main([there, str(empty), "--brief"])  # as a shell lists the files of shards
    assert "BinFill" in capsys.readouterr().out


def test_two_methods_without_a_common_episode_are_listed_but_not_compared(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    save_records(
        tmp_path,
        [*records("pi05", {"BinFill": [1, 0]}), *records("ttt_modul", {"MoveCube": [1, 1]})],
    )
    options = [
        str(tmp_path),
        "--tasks",
        "BinFill",
        "MoveCube",
        "--episodes",
        "2",
        "--brief",
    ]
    main(options)
    printed = capsys.readouterr().out
    assert "50.0 (2 of 4)" in printed
    assert "pi05 and ttt_modul have no episode in common: there is nothing to pair." in printed
    with pytest.raises(SystemExit) as ended:
        main([*options, "--compare", "pi05", "ttt_modul"])
    assert ended.value.code == 2
    assert "nothing to pair" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("config", "detail"),
    [
        (
            {"memory": {"name": "ttt"}, "card": {"recipe": {"lr": "1e-4", "steps": 5}}},
            "peak learning rate 1e-4",
        ),
        ({"memory": {"budget": 64}, "card": {"recipe": {}}}, "memory without a name, 64 tokens"),
        (
            {"memory": {"name": "ttt"}, "integration": {"name": "expert"}},
            "memory ttt, integration expert",
        ),
        ({"card": {"recipe": "as released"}}, "training: as released"),
    ],
)
def test_a_submission_shows_settings_of_unusual_kinds_as_they_are(
    config: dict[str, object], detail: str
) -> None:
    methods = aggregate(
        records("a", {"BinFill": [1, 1, 1, 1], "MoveCube": [1, 1, 1, 1]}), SMALL
    ).methods
    run = {"settings": {"model": "a", "checkpoint": 100}, "notes": {"policy": policy_facts(config)}}
    assert detail in training_details(methods, [run])


def test_a_submission_knows_a_checkpoint_whose_number_was_written_as_a_text() -> None:
    methods = aggregate(records("a", {"BinFill": [1] * 4, "MoveCube": [1] * 4}), SMALL).methods
    facts = policy_facts({"memory": {"name": "ttt"}})
    run = {"settings": {"model": "a", "checkpoint": "100"}, "notes": {"policy": facts}}
    assert "policy: memory ttt" in training_details(methods, [run])
    run["notes"] = {"policy": policy_facts({"served": {"model": "a"}})}
    assert "no memory" not in training_details(methods, [run])


def test_two_models_of_one_shipped_checkpoint_are_told_apart() -> None:
    made = []
    for name in ("framesamp_modul", "mine"):
        made += records(name, {"VideoUnmask": [1]}, checkpoint="nano")
    results = aggregate(made, Protocol.of_records(made))
    assert [method.label for method in results.methods] == ["nano#framesamp_modul", "nano#mine"]
    assert results.notes[0].startswith("2 different models are called nano")


HOSTILE = "\x1b]0;title\x07\x1b[2J"


def test_escape_sequences_of_names_do_not_reach_the_terminal(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for i, name in enumerate((f"a{HOSTILE}", f"b{HOSTILE}")):
        save_records(tmp_path / f"episodes-{i}.jsonl", records(name, {"BinFill": [True, False]}))
    main([str(tmp_path), "--tasks", "BinFill", "--episodes", "2"])
    assert "\\x1b[2J" in (printed := capsys.readouterr().out)
    assert "\x1b" not in printed and "\x07" not in printed
    with pytest.raises(SystemExit):
        main([str(tmp_path / HOSTILE)])
    assert "\\x1b[2J" in (printed := capsys.readouterr().err)
    assert "\x1b" not in printed and "\x07" not in printed


@pytest.mark.parametrize("start", ["=HYPERLINK(1)", "+1", "-1", "@SUM(1)", "\t=1", "\r=1"])
def test_a_name_is_no_formula_of_a_spreadsheet(start: str) -> None:
    results = aggregate(records(start, {"BinFill": [True]}), Protocol(("BinFill",), episodes=1))
    rows = list(csv.DictReader(io.StringIO(to_csv(results), newline="")))
    assert {row["method"] for row in rows} == {f"'{start.strip()}"}
    assert {row["mean"] for row in rows} == {"100.0000"}


@pytest.mark.parametrize(
    ("name", "displayed"),
    [
        ("[x](javascript:alert(1))", "[x]\\(javascript:alert(1))"),
        ("![x][y]", "![x]\\[y]"),
        ("[x]: javascript:alert(1)", "[x]\\: javascript:alert(1)"),
        ("<script>", "\\<script>"),
        ("a\\](b)", "a\\\\]\\(b)"),
        ("a|b", "a\\|b"),
        ("a\n# b", "a # b"),
        ("[+1.0, +2.0]", "[+1.0, +2.0]"),
    ],
)
def test_a_name_is_no_link_and_no_html_of_markdown(name: str, displayed: str) -> None:
    assert (
        to_markdown(Table(name, ["method"], [[name]]))
        == f"### {displayed}\n\n| method |\n| :--- |\n| {displayed} |\n"
    )


def test_a_name_with_dollar_signs_is_text_in_the_figures(tmp_path: Path) -> None:
    save_records(tmp_path, records(r"$\nonsense$", {"BinFill": [True, False]}))
    main(
        [
            str(tmp_path),
            "--tasks",
            "BinFill",
            "--episodes",
            "2",
            "--html",
            str(tmp_path / "page.html"),
            "--brief",
        ]
    )
    assert r"$\nonsense$" in (tmp_path / "page.html").read_text()


def test_a_comparison_of_memories_names_the_baselines_that_it_lacks() -> None:
    def notes(*models: str) -> list[str]:
        made: list[EpisodeRecord] = []
        for model in models:
            made += records(model, {"BinFill": [1, 0, 0, 0], "MoveCube": [0, 0, 0, 0]})
        return [note for note in aggregate(made, SMALL).notes if "This table lacks" in note]

    assert notes("framesamp_expert", "pi05") == [
        "This table lacks present_*, a memory of the current frame alone: train"
        " present_expert to compare.",
        "This table lacks actions_*, a memory of the robot's own past actions: train"
        " actions_expert to compare.",
    ]
    assert len(notes("framesamp_modul", "present_modul")) == 1
    assert notes("framesamp_modul", "present_modul", "actions_modul") == []
    assert notes("framesamp_modul") == notes("pi05", "groundsg") == []


def test_standing_baselines_are_below_a_line_in_the_tables() -> None:
    made: list[EpisodeRecord] = []
    for model in ("present_modul", "framesamp_modul", "actions_modul", "pi05"):
        made += records(model, {"BinFill": [1, 0, 0, 0], "MoveCube": [0, 0, 0, 0]})
    table = overview(aggregate(made, SMALL))
    names = [row[0] for row in table.rows]
    assert names == ["framesamp_modul", "pi05", "present_modul", "actions_modul"]
    assert table.rules == {2}


def test_folders_with_other_settings_and_rules_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    settings = {"model": "m", "checkpoint": 1, "split": "test", "policy": "p", "execute": 16}
    for folder, seed, more in (
        ("one", 7, {"source": "here"}),
        ("same", 7, {"source": "there"}),
        ("seed", 42, {"execute": 4}),
        ("rival", 7, {"model": "rival", "execute": 8, "max_actions": 20}),
    ):
        begin_run(tmp_path / folder, {**settings, "seed": seed, **more})
        made = run_of("test", [1], str(more.get("model", "m")))
        save_records(tmp_path / folder, [replace(record, model_seed=seed) for record in made])

    def notes(*folders: str) -> str:
        main([*(str(tmp_path / folder) for folder in folders), "--brief"])
        return " ".join(capsys.readouterr().out.split())

    assert "settings" not in notes("one", "same")
    assert "m, test: its folders have other settings (execute 16 and 4)." in notes("one", "seed")
    printed = notes("one", "rival")
    assert "Rules of runs on test differ: max_actions 20 and none." in printed
    assert "settings" not in printed


def test_a_command_prints_a_warning_without_its_place_in_the_code(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    save_records(tmp_path, records("pi05", {"BinFill": [1, 0]}))
    with (tmp_path / "episodes.jsonl").open("a") as file:
        file.write('{"model": "pi')
    monkeypatch.setattr(sys, "argv", ["mme-vla", str(tmp_path), "--brief"])
    monkeypatch.setattr(warnings, "showwarning", warnings.showwarning)  # put back afterwards
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        cli.run("results")
    (line,) = [line for line in capsys.readouterr().err.splitlines() if "half-written" in line]
    assert line.startswith("Warning: ") and ".py:" not in line
