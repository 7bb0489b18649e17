"""What a newcomer meets between the first training and the first table."""

import io
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from mme_vla import cli
from mme_vla.cli import train as train_command
from mme_vla.config.composition import compose
from mme_vla.errors import UserError
from mme_vla.evaluation.records import EpisodeRecord
from mme_vla.evaluation.results.aggregate import aggregate
from mme_vla.evaluation.results.scopes import Protocol
from mme_vla.evaluation.results.tables import Table, print_table
from mme_vla.policy.run_folders import find_run, resolve_checkpoint
from mme_vla.training.runs import weights_to_start_from


def test_latest_is_the_run_that_wrote_a_checkpoint_last(tmp_path: Path) -> None:
    for age, run in enumerate(("b", "a", "unfinished")):
        step = tmp_path / run / "checkpoints" / "step_000010"
        step.mkdir(parents=True)
        if run != "unfinished":
            (step / "training_state.json").write_text("{}")
        os.utime(step, (1000 + age, 1000 + age))
    assert find_run(tmp_path / "latest") == tmp_path / "a"
    assert resolve_checkpoint(tmp_path / "latest") == tmp_path / "a" / "checkpoints" / "step_000010"


def test_the_papers_recipe_asks_for_the_weights_it_starts_from() -> None:
    start = compose("train", ["experiment=robomme"]).init_from
    with pytest.raises(UserError, match="init_from=none"):
        weights_to_start_from(start)
    assert (
        weights_to_start_from(compose("train", ["experiment=robomme", "init_from=none"]).init_from)
        is None
    )
    assert (
        weights_to_start_from(compose("train", ["experiment=robomme", "init_from=x/y"]).init_from)
        == "x/y"
    )
    assert weights_to_start_from(compose("train", []).init_from) is None


@pytest.mark.parametrize("won", [False, True])
def test_the_average_of_nothing_but_failures_has_an_interval(won: bool) -> None:
    outcome = "success" if won else "fail"
    records = [
        EpisodeRecord("pi05", 1, 7, task, episode, episode, "easy", outcome, 9)
        for task in ("BinFill", "StopCube")
        for episode in range(2)
    ]
    figures = aggregate(records, Protocol(("BinFill", "StopCube"), 2)).methods[0].figures
    average, task = figures["average"]["average"].interval, figures["task"]["BinFill"].interval
    assert 30 < average.high - average.low < task.high - task.low


def test_a_narrow_terminal_cuts_no_number(capsys: pytest.CaptureFixture[str]) -> None:
    print_table(
        Table("t", ["method", *"abcdefgh"], [["framesamp_modul", *["64.94 ± 1.99"] * 8]]), 40
    )
    printed = capsys.readouterr().out
    assert printed.count("64.94 ± 1.99") == 8
    assert "framesamp_modul" in printed


class _Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture
def output_before_imports(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """What standard error held at each import of a command's module; the modules do nothing."""
    outputs: list[str] = []

    def slow_import(name: str) -> SimpleNamespace:
        assert isinstance(sys.stderr, io.StringIO)
        outputs.append(sys.stderr.getvalue())
        return SimpleNamespace(main=lambda *_: None)

    monkeypatch.setattr(cli, "import_module", slow_import)
    monkeypatch.delitem(sys.modules, "mme_vla.cli.train")  # as in a process that begins
    monkeypatch.delenv("LOCAL_RANK", raising=False)
    return outputs


@pytest.mark.parametrize(
    ("stream", "message"), [(_Terminal, "Loading PyTorch and LeRobot …\n"), (io.StringIO, "")]
)
def test_a_terminal_gets_a_line_before_the_imports(
    stream: type[io.StringIO],
    message: str,
    output_before_imports: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sys, "stderr", stream())
    monkeypatch.setattr(sys, "argv", ["train", f"output={tmp_path / 'run'}"])
    cli.run("train")
    assert output_before_imports == [message]


def test_help_imports_no_command(
    output_before_imports: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "stderr", _Terminal())
    monkeypatch.setattr(sys, "argv", ["train", "--help"])
    with pytest.raises(SystemExit) as ended:
        cli.run("train")
    assert ended.value.code in (None, 0)
    assert not output_before_imports


@pytest.mark.slow
@pytest.mark.parametrize("words", [["--help"], ["train", "--help"], ["analyse", "--help"]])
def test_help_ends_quietly_where_its_reader_is_gone(words: list[str]) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    ended = subprocess.run(
        [sys.executable, "-m", "mme_vla", *words], stdout=writing, stderr=subprocess.PIPE, text=True
    )
    os.close(writing)
    assert (ended.returncode, ended.stderr) == (0, "")


def test_a_refused_run_leaves_no_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(name: str) -> None:
        raise UserError(f"device={name}: none here")

    monkeypatch.setattr(train_command, "find_device", refuse)
    folder = tmp_path / "run"
    folder.mkdir()
    with pytest.raises(UserError, match="device=cuda"):
        train_command.main(compose("train", ["train.device=cuda", f"output={folder}"]))
    assert not folder.exists()
