"""What commands answer to `--help`, to options that do not exist, and to keys that are called
otherwise here.
"""

import re
import subprocess
import sys
from pathlib import Path

import pytest
from config_pages import keys

from helpers import REPOSITORY
from mme_vla import __main__ as entry
from mme_vla import cli
from mme_vla.cli.help import configured_commands, defaults, help_page
from mme_vla.config.composition import compose
from mme_vla.config.trees import library_files, library_trees
from mme_vla.errors import UserError

COMMANDS = configured_commands()


@pytest.mark.parametrize("name", [name for name, words in COMMANDS.items() if "python" in words])
def test_help_tells_what_a_command_does_with_examples_and_every_key(name: str) -> None:
    text = help_page(name, [], library_trees())
    file = library_files("")[name]
    assert text.startswith(f"Usage: {COMMANDS[name]} ")
    assert f"Examples\n  {COMMANDS[name]}" in text
    for key in keys(file):
        assert f"{key.name.rpartition('.')[2]}: {key.default}".strip() in text
        assert key.comment in text, key
    for group, option in defaults(file).groups.items():
        assert f"  {group.strip('/')}={option}: " in text
        assert all(choice in text for choice in library_files(group.strip("/")))


def test_help_names_the_files_of_a_group_and_custom_ones_too(tmp_path: Path) -> None:
    (tmp_path / "memory").mkdir()
    (tmp_path / "memory" / "mine.yaml").write_text(
        "# Stores recent frames.\nname: mine\nspacing: 4 # steps apart\n"
    )
    trees = [*library_trees(), tmp_path]
    text = help_page("train", ["memory"], trees)
    assert "memory=mine\n  # Stores recent frames.\n" in text
    assert "spacing: 4 # steps apart" in text
    assert "budget: 512 # memory tokens; a multiple of grid²" in text
    one = help_page("train", ["memory=mine"], trees)
    assert "steps apart" in one and "grid²" not in one
    with pytest.raises(
        UserError, match=r"'memori' is no group of this command\. Did you mean 'memory'\?"
    ):
        help_page("train", ["memori"], trees)
    with pytest.raises(UserError, match=r"Unknown memory 'mime'\. Did you mean 'mine'"):
        help_page("train", ["memory=mime"], trees)


@pytest.mark.parametrize("command", ["docs", "results", "sample", "train-tokenizer", "weights"])
def test_help_describes_a_command_in_sentences(
    command: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["mme-vla", command, "--help"])
    with pytest.raises(SystemExit):
        entry.main()
    before_arguments = re.split(r"\n(?:positional arguments|options):", capsys.readouterr().out)[0]
    assert before_arguments.rstrip().endswith(".")


@pytest.mark.slow
def test_help_needs_no_torch() -> None:
    watch = "import sys, runpy; sys.argv = ['x', '--help']\n" \
            "try: runpy.run_module('mme_vla.train', run_name='__main__')\n" \
            "except SystemExit: pass\nprint('torch' in sys.modules, file=sys.stderr)"  # fmt: skip
    done = subprocess.run(
        [sys.executable, "-c", watch], capture_output=True, text=True, cwd=REPOSITORY
    )
    assert done.stderr.split()[-1] == "False", done.stderr


@pytest.mark.parametrize(
    ("command", "words", "message"),
    [
        ("train", ["--steps", "10"], "There is no option '--steps'.*write train.steps=10"),
        ("train", ["--learning-rate=1"], "There is no option '--learning-rate=1'"),
        ("evaluate", ["--max-steps=9", "tasks=all"], "write max_steps=9"),
        ("train", ["model=framesamp_modul", "--buget=5"], r"write memory\.budget=5"),
    ],
)
def test_an_option_that_does_not_exist_is_answered_with_the_word_to_type(
    command: str,
    words: list[str],
    message: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(sys, "argv", [command, *words])
    with pytest.raises(SystemExit) as ended:
        cli.run(command)
    assert ended.value.code == 2
    assert re.search(message, capsys.readouterr().err.replace("\n", " "))


@pytest.mark.parametrize(
    ("command", "word", "message"),
    [
        ("evaluate", "mode=background", "Did you mean 'subgoal_mode'"),
        ("evaluate", "train.device=cuda", "Did you mean 'device'?"),
        ("train", "device=cuda", "Did you mean 'train.device'?"),
        ("serve", "batch=3", "Did you mean 'max_batch'"),
    ],
)
def test_a_key_with_another_name_here_is_suggested(command: str, word: str, message: str) -> None:
    with pytest.raises(UserError, match=re.escape(message)):
        compose(command, [word])
