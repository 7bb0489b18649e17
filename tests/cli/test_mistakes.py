"""Mistaken command lines: each reply says what to type, comes before PyTorch, and leaves no
folder.
"""

import subprocess
import sys
from pathlib import Path

import pytest

from helpers import REPOSITORY
from mme_vla import __main__ as entry
from mme_vla import cli
from mme_vla.cli.help import argument_parser


def reply(
    words: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> str:
    """The error of `mme-vla` with these words."""
    monkeypatch.setattr(sys, "argv", ["mme-vla", *words])
    with pytest.raises(SystemExit) as ended:
        entry.main()
    assert ended.value.code == 2
    return " ".join(capsys.readouterr().err.split())


@pytest.mark.parametrize(
    ("line", "typed"),
    [
        ("train --model tokendrop_expert", "write model=tokendrop_expert."),
        ("train --config configs", "Did you mean '--config-dir'?"),
        ("train --config-dir", "--config-dir/-cd: expected one argument"),
        ("train --multi model=pi05,rmt_expert", "Did you mean '--multirun'?"),
        ("train model", "Did you mean model=…? `--help model` lists its names."),
        ("train model pi05", "write model=pi05."),
        ("train pi05", "Did you mean model=pi05 or"),
        ("train model = pi05", "write model=pi05, without spaces around =."),
        ("train model =pi05", "write model=pi05, without spaces around =."),
        ("train model= pi05", "write model=pi05, without spaces around =."),
        ("train train.steps=[1", "'[' is not closed."),
        ("train train.steps=3 =3", "the key is missing"),
        (
            "evaluate tasks=[VideoUnmask, StopCube]",
            "Write tasks=[VideoUnmask,StopCube], or quote it: 'tasks=[VideoUnmask, StopCube]'.",
        ),
        ("evaluate nano", "Did you mean checkpoint=nano or"),
        ("evaluate checkpoint = nano", "write checkpoint=nano, without spaces around =."),
        ("trian model=pi05", "Error: There is no command 'trian'. Did you mean 'train'?"),
        ("train model=framesamp_modl", "or 'keyframes_modul'? `--help model` lists all"),
        ("nano model=framesamp_modl", "? `mme-vla train --help model` lists all"),
        ("results x --epsiodes 3", "There is no option '--epsiodes'. Did you mean '--episodes'?"),
        ("results x --errors fail", "--errors 'fail' is not known. Did you mean 'failure'?"),
        ("results verify", "A value is needed for receipt (receipt: receipt.json, or a folder"),
        ("analyse cost --chekpoint x", "There is no option '--chekpoint'. Known: --backbone"),
        ("analyse cost --chekpoint x", "`mme-vla analyse cost --help` says more."),
        ("docs --biuld", "There is no option '--biuld'. Did you mean '--build'?"),
        ("docs --output", "--output needs one value."),
        ("evaluate checkpoint=nano plugins=[json] max_steps=0", "max_steps=0 must be a whole"),
        ("evaluate with=[drop:all]", "Unknown config key 'with'. Known: backbone,"),
        ("evaluate checkpoint=missing", "No checkpoint at missing: there is no such folder."),
        ("evaluate checkpoint=outputs/missing", "No checkpoint at outputs/missing: there is no"),
        ("probe checkpoint=nano with=[dropall] recordings=sample", "Did you mean 'drop'?"),
        (
            "probe checkpoint=nano with=[drop:many] recordings=sample",
            "a name and a number, drop:2.",
        ),
    ],
)
def test_a_reply_says_what_to_type(
    line: str,
    typed: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
) -> None:
    monkeypatch.chdir(tmp_path)
    printed = reply(line.split(" "), monkeypatch, capsys)
    assert printed.startswith("Error: ")
    assert typed in printed
    assert not list(tmp_path.iterdir())


def test_mistakes_in_several_keys_of_a_probe_are_named_together(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    where = ["checkpoint=missing", "recordings=[not_a_dataset]"]
    printed = reply(["probe", *where, "with=[drop:many]", "draws=0"], monkeypatch, capsys)
    assert "No checkpoint at missing" in printed
    assert "with=drop:many: write a name" in printed
    assert "draws=0 must be" in printed
    assert "No LeRobot dataset at 'not_a_dataset'" in printed
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("place", "folder"),
    [("configs/model", "configs"), ("model", "."), ("robots/model", "robots")],
)
def test_a_file_that_is_not_searched_is_named(
    place: str,
    folder: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
) -> None:
    (tmp_path / place).mkdir(parents=True)
    (tmp_path / place / "mine.yaml").write_text("name: mine\n")
    monkeypatch.chdir(tmp_path)
    printed = reply(["train", "model=mine"], monkeypatch, capsys)
    assert f"./{place}/mine.yaml exists: add --config-dir {folder}." in printed
    elsewhere = reply(["train", "model=other"], monkeypatch, capsys)
    assert "A file of your own, DIR/model/other.yaml, is found with --config-dir DIR." in elsewhere


def test_a_robots_file_that_lacks_what_others_refer_to_names_the_missing_key(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "configs" / "embodiment"
    folder.mkdir(parents=True)
    (folder / "arm.yaml").write_text("{name: arm, cameras: {top: {}}, action: {width: 3}}")
    words = ["train", "--config-dir", str(folder.parent), "embodiment=arm", "plugins=[json]"]
    text = reply(words, monkeypatch, capsys)
    assert "Interpolation key 'embodiment.action.horizon' not found" in text
    assert "Add that key to your YAML file" in text


def test_a_setting_in_a_command_with_options_becomes_one(
    capsys: pytest.CaptureFixture[str],
) -> None:
    parser = argument_parser("demo", "Demonstrates.", ("first",))
    choices = parser.add_subparsers(required=True, metavar="WHAT")
    choices.add_parser("first").add_argument("--checkpoint", type=int)
    for words, expected in (
        (["checkpoint=3"], "WHAT is first, one of first."),
        (["first", "checkpoint=3"], "is written as an option here: --checkpoint 3."),
        (["first", "--checkpoint", "x"], "--checkpoint 'x' does not fit: it is a whole number."),
        ([], "A value is needed for WHAT, one of first."),
    ):
        with pytest.raises(SystemExit):
            parser.parse_args(words)
        assert expected in " ".join(capsys.readouterr().err.split())


def test_each_of_two_mistakes_begins_alike(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["probe", "checkpoint=nano", "offline=false", "max_steps=0"]
    monkeypatch.setattr(sys, "argv", ["mme-vla", *words])
    with pytest.raises(SystemExit):
        entry.main()
    lines = capsys.readouterr().err.splitlines()
    assert [line.partition("=")[0] for line in lines] == ["Error: max_steps", "Error: offline"]


def test_the_name_latest_is_reserved(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    printed = reply(["train", "output=outputs/pi05/latest"], monkeypatch, capsys)
    assert "'latest' is reserved" in printed
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("command", ["evaluate checkpoint=nano", "train", "convert", "probe"])
@pytest.mark.parametrize("output", ["output=", "output=''"])
def test_an_empty_output_is_refused(
    command: str,
    output: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
) -> None:
    monkeypatch.chdir(tmp_path)
    printed = reply([*command.split(), output], monkeypatch, capsys)
    assert "output= is empty" in printed
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "line",
    [
        "train name=",
        "train name='\t'",
        "train resume=",
        "train init_from=",
        "train data.cache.root=",
        "train data.weights=",
        "evaluate server=ws://127.0.0.1:1 connection.name=",
        "evaluate checkpoint=nano times_from=",
        "record tasks=StopCube episodes=1 output=new hdf5=",
        "record tasks=StopCube episodes=1 output=new previews=",
        "inspect dataset=",
        "subgoal-build input=sample output=new tasks=",
    ],
)
def test_a_name_or_a_folder_that_is_empty_is_refused(
    line: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
) -> None:
    monkeypatch.chdir(tmp_path)
    printed = reply(line.split(" "), monkeypatch, capsys)
    assert "must be a text that is not empty" in printed
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("words", [["--shell-completion"], ["-sc", "install=bash"]])
def test_completion_by_the_shell_is_refused_in_words(
    words: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    printed = reply(["train", *words], monkeypatch, capsys)
    assert printed.startswith("Error: --shell-completion completes a program of one command")


@pytest.mark.parametrize("output", ["/proc/mine", "file.txt/mine", "x" * 300])
def test_an_output_that_cannot_be_made_is_refused_before_anything_is_loaded(
    output: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file.txt").write_text("mine")
    printed = reply(["evaluate", "checkpoint=nano", f"output={output}"], monkeypatch, capsys)
    assert printed.startswith(f"Error: output={output} cannot be made: ")
    assert [path.name for path in tmp_path.iterdir()] == ["file.txt"]


def test_the_version_is_printed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["mme-vla", "--version"])
    entry.main()
    name, version = capsys.readouterr().out.split()
    assert name == "mme-vla" and version[0].isdigit()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("train model=pi05 train.steps=-5", "train.steps=-5 must be a whole number"),
        ("train model=pi05 train.batch_size=0", "train.batch_size=0 must be a whole number"),
        ("evaluate checkpoint=nano split=tset", "Unknown split 'tset'. Did you mean 'test'?"),
        ("evaluate checkpoint=nano video=yes", "video='yes'. Known: all, failure, none"),
        ("evaluate checkpoint=nano task=VideoUnmaks", "Did you mean 'VideoUnmask'"),
        ("evaluate checkpoint=nano episodes=abc", "episodes='abc' is not understood"),
        ("inspect checkpoint=missing", "No checkpoint at missing: there is no such folder"),
        ("serve checkpoint=nano port=80000", "port=80000 must be a whole number from 0 to 65535"),
        ("nano task=VideoUnmask model=nope", "Unknown model 'nope'."),
        ("nano task=VideoUnmask split=further_ez", "Unknown split 'further_ez'. Did you mean"),
        ("train model=framesamp_modul memory.budget=100", "choose a multiple of 16, such as 96."),
        ("evaluate checkpoint=missing", "No checkpoint at missing: there is no such folder."),
        ("probe checkpoint=nano recordings=sample with=[dropall]", "Did you mean 'drop'?"),
    ],
)
def test_values_are_checked_without_pytorch(line: str, message: str, tmp_path: Path) -> None:
    watch = (
        "import sys\nfrom mme_vla.__main__ import main\ntry: main()\n"
        "except SystemExit: pass\nprint('torch' in sys.modules)"
    )
    done = subprocess.run(
        [sys.executable, "-c", watch, *line.split()],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env={"PYTHONPATH": str(REPOSITORY), "PATH": "", "HOME": str(tmp_path)},
    )
    assert message in " ".join(done.stderr.split())
    assert done.stdout.split()[-1] == "False"
    assert not (tmp_path / "outputs").exists()


@pytest.mark.slow
@pytest.mark.parametrize("existing", ["", "outputs", "outputs/pi05"])
def test_a_training_that_is_refused_late_leaves_the_folders_that_were_there(
    existing: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
) -> None:
    (tmp_path / existing).mkdir(parents=True, exist_ok=True)
    before = sorted(tmp_path.rglob("*"))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["train", "model=pi05", "init_from=missing"])
    with pytest.raises(SystemExit) as ended:
        cli.run("train")
    assert ended.value.code == 2
    assert "No checkpoint at missing" in capsys.readouterr().err
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.slow
def test_nothing_follows_a_result_where_the_planner_leaves_objects() -> None:
    pytest.importorskip("ompl", reason="needs the simulator: uv sync --inexact --extra sim")
    leak = (
        "import ctypes\nfrom ompl import base\n"
        "ctypes.pythonapi.Py_IncRef(ctypes.py_object(base.RealVectorStateSpace(7)))\n"
    )
    quiet = "import atexit\nfrom mme_vla import cli\natexit.register(cli._end_quietly)\n"
    reports = []
    for code in (leak, quiet + leak):
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
        reports.append(done.stderr)
    assert "leaked" in reports[0]
    assert not reports[1]
