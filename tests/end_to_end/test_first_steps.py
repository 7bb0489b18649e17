"""What a newcomer meets between the first training and the first table."""

import io
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from helpers import REPOSITORY
from mme_vla import Memory, cli
from mme_vla.cli import train as train_command
from mme_vla.config.composition import compose
from mme_vla.errors import UserError
from mme_vla.evaluation.records import EpisodeRecord
from mme_vla.evaluation.results.aggregate import aggregate
from mme_vla.evaluation.results.scopes import Protocol
from mme_vla.evaluation.results.tables import Table, print_table
from mme_vla.policy.run_folders import find_run, resolve_checkpoint
from mme_vla.testing.small import small_policy
from mme_vla.training.loop import worse_than_still
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
    with pytest.raises(UserError, match="No run with a checkpoint in"):
        resolve_checkpoint(tmp_path / "a" / "latest")


def test_the_papers_recipe_asks_for_the_weights_it_starts_from() -> None:
    start = compose("train", ["experiment=robomme"]).init_from
    with pytest.raises(UserError, match="init_from=none"):
        weights_to_start_from(start)
    assert weights_to_start_from(compose("train", ["experiment=robomme", "init_from=none"]).init_from) is None
    assert weights_to_start_from(compose("train", ["experiment=robomme", "init_from=x/y"]).init_from) == "x/y"
    assert weights_to_start_from(compose("train", []).init_from) is None


def test_a_run_that_is_worse_than_holding_still_says_why() -> None:
    summary = {"names": ["a", "b"], "mean_abs_error": [0.2, 0.1], "mean_abs_error_holding_still": [0.1, 0.2]}
    assert worse_than_still(summary, 350).startswith(
        "1 of 2 numbers of the action are predicted worse than by holding still"
    )
    assert "350 updates" in worse_than_still(summary, 350)
    assert worse_than_still({**summary, "mean_abs_error": [0.05, 0.1]}, 350) == ""


def test_one_episode_acts_as_it_does_in_a_list() -> None:
    policy = small_policy("pi05")
    frame, state = np.full((1, 256, 256, 3), 90, np.uint8), np.zeros((1, 8), np.float32)
    chunks = []
    for alone in (True, False):
        episode = policy.start_episode("pick up the red cube", seed=3)
        episode.observe({"front": frame, "wrist": frame}, state)
        chunks.append(policy.act(episode) if alone else policy.act([episode])[0])
    assert chunks[0].ndim == 2
    np.testing.assert_array_equal(*chunks)


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
    assert average is not None
    assert task is not None
    assert 30 < average.high - average.low < task.high - task.low


def test_a_narrow_terminal_cuts_no_number(capsys: pytest.CaptureFixture[str]) -> None:
    print_table(Table("t", ["method", *"abcdefgh"], [["framesamp_modul", *["64.94 ± 1.99"] * 8]]), 40)
    printed = capsys.readouterr().out
    assert printed.count("64.94 ± 1.99") == 8
    assert "framesamp_modul" in printed


def test_the_demonstration_takes_custom_memories_and_always_shows_the_one_without(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.syspath_prepend(REPOSITORY / "examples")
    import memory_matters

    assert memory_matters.models_of(["mine"]) == ["mine", "pi05"]
    assert memory_matters.models_of(["pi05", "ttt_modul"]) == ["pi05", "ttt_modul"]
    monkeypatch.chdir(REPOSITORY / "examples" / "last_frames")
    learned = memory_matters.learn("last_frames_context", steps=1, episodes=2, config_dir=Path("configs"))
    assert (learned["model"], learned["steps"]) == ("last_frames_context", 1)


class _Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize(
    ("stream", "words", "message"),
    [(_Terminal, [], "Loading PyTorch"), (io.StringIO, [], ""), (_Terminal, ["--help"], "")],
)
def test_a_terminal_gets_a_line_before_the_imports(
    stream: type[io.StringIO], words: list[str], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    standard_error, before = stream(), []
    monkeypatch.setattr(sys, "stderr", standard_error)
    monkeypatch.setattr(sys, "argv", ["train", *words])
    monkeypatch.delenv("LOCAL_RANK", raising=False)

    def slow_import(name: str) -> SimpleNamespace:
        before.append(standard_error.getvalue())
        return SimpleNamespace(main=lambda: None)

    monkeypatch.setattr(cli, "import_module", slow_import)
    cli.run("train")
    assert before[0].startswith(message) and bool(before[0]) == bool(message)


@pytest.mark.slow
@pytest.mark.parametrize("words", [["--help"], ["train", "--help"], ["analyse", "--help"]])
def test_help_ends_quietly_where_its_reader_is_gone(words: list[str]) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    ended = subprocess.run([sys.executable, "-m", "mme_vla", *words], stdout=writing, stderr=subprocess.PIPE, text=True)
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


def test_arguments_for_the_constructor_of_memory_are_explained() -> None:
    class Own(Memory):
        def __init__(self) -> None:
            super().__init__(32, 48)

    with pytest.raises(TypeError, match=r"Own: MemoryModule.__init__\(\) takes no arguments.*self.budget"):
        Own()


def test_what_the_tutorials_write_is_ignored_by_git() -> None:
    if not (REPOSITORY / ".git").exists():
        pytest.skip("no clone")
    saved = ("outputs/x", "examples/last_frames/outputs/x", "examples/two_buttons/data/x", "gallery/x", "runs/x")
    for path in saved:
        assert subprocess.run(["git", "check-ignore", "-q", path], cwd=REPOSITORY).returncode == 0, path


def test_pages_have_no_placeholder_that_a_shell_takes_for_a_redirection() -> None:
    for page in (REPOSITORY / "README.md", *(REPOSITORY / "docs").rglob("*.md")):
        assert "<time>" not in page.read_text(), page
