"""What commands answer to `--help`, to options that do not exist, and to keys that are called
otherwise here.
"""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from helpers import REPOSITORY
from mme_vla import cli
from mme_vla.cli.command import help_text
from mme_vla.cli.help import choices, configured_commands, defaults, keys
from mme_vla.config.composition import compose, library_files, library_trees
from mme_vla.errors import UserError

COMMANDS = configured_commands()


@pytest.mark.parametrize("name", [name for name, words in COMMANDS.items() if "python" in words])
def test_help_tells_what_a_command_does_with_examples_and_every_key(name: str) -> None:
    text = help_text(name, [], library_trees())
    file = library_files("")[name]
    assert text.startswith(f"Usage: {COMMANDS[name]} ")
    assert f"Examples\n  {COMMANDS[name]}" in text
    flat = re.sub(r"\s+", " ", text)
    for key in keys(file):
        assert not key.default or f"{key.name}={key.default}" in flat
        assert re.sub(r"\s+", " ", key.comment) in flat, key
    for group, option in defaults(file).groups.items():
        if not group.startswith("override"):
            assert f"{group}={option}" in flat
            assert all(choice in flat for choice in choices(library_trees(), group))


def test_help_names_the_files_of_a_group_and_custom_ones_too(tmp_path: Path) -> None:
    (tmp_path / "memory").mkdir()
    (tmp_path / "memory" / "mine.yaml").write_text(
        "# Remembers what I like.\nname: mine\nspacing: 4 # steps apart\n"
    )
    text = help_text("train", ["memory"], library_trees(), [tmp_path])
    assert "memory=mine\n  Remembers what I like.\n" in text
    assert re.search(r"memory.spacing=4 +steps apart", text)
    assert re.search(r"memory.budget=512 +memory tokens; a multiple of grid²", text)
    with pytest.raises(
        UserError, match=r"'memori' is no group of this command\. Did you mean 'memory'\?"
    ):
        help_text("train", ["memori"], library_trees())


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
