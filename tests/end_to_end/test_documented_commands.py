"""Every shell command of README.md and docs/**/*.md runs as printed.

A command runs unless `NOT_RUN` gives the reason; its words must be valid all the same.
"""

import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from shutil import copytree

import published
import pytest
from hydra._internal.utils import get_args_parser

from helpers import REPOSITORY
from mme_vla import cli
from mme_vla.cli.command import check_overrides
from mme_vla.cli.help import configured_commands
from mme_vla.cli.results import main as results
from mme_vla.config.composition import compose
from mme_vla.config.plugins import trust_as_override
from mme_vla.extras.nano.cli.nano import with_settings

EXAMPLES = {
    "add-a-memory.md": "last_frames",
    "add-a-backbone.md": "regression",
    "add-an-integration.md": "gist",
    "add-a-task.md": "two_buttons",
    "your-robot.md": "bimanual",
    "first-hour.md": "first_hour",
    "auxiliary-losses.md": "write_head",
    "environments.md": "blink",
    "trajectories.md": "trajectories",
}
"""The folder that the commands of a page are typed in; of other pages it is the
repository's root.
"""
NOT_RUN = {
    r"^(pip install|uv |python3 -m venv)": "installs packages",
    r"^(cd |IMAGE_MAX_TOKEN_NUM)": "needs ms-swift and GPUs",
    r"^B=": "sets a shell variable",
    r"^pytest tests/": "these tests run by themselves",
    r"mme-vla audit (checkpoint|server)=": "evaluates for minutes",
    r"served_checkpoint\.py": "serves until it is stopped",
    r"torchrun|accelerate launch|--multirun": "needs several GPUs or a cluster",
    r"env[= ]mikasa|benchmarks/mikasa": (
        "needs the extra `mikasa`; tests/extras/mikasa/test_mikasa_commands.py tries each command"
    ),
    r"<|…": "has a place for a file or folder of the reader's own",
    r"mme(_vla\.|-vla )train ": "trains for minutes or hours",
    r"mme(_vla\.|-vla )nano( |$)": "trains for minutes or hours",
    r"mme-vla vision-pretrain ": (
        "trains for minutes; tests/extras/nano/test_vision_pretrain.py runs it on few scenes"
    ),
    r"mme(_vla\.|-vla )(inspect|evaluate|serve|probe) .*checkpoint=(outputs|runs)/": (
        "needs a policy that was trained before"
    ),
    r"--checkpoint outputs/": "needs a policy that was trained before",
    r"mme(_vla\.|-vla )results (outputs/(?!published)|verify)": (
        "needs the records of an evaluation"
    ),
    r"mme-vla probe card": "needs recorded episodes",
    r"scripts/figures\.py .*--probe outputs/": "needs a finished probe",
    r"analyse writing --memories anchors": (
        "demonstrates 48 episodes; tests/extras/probing/test_writing.py runs it on one"
    ),
    r"benchmarks/\w+\.py (memory|update|chunk)": "needs a GPU, or a mock driver",
    r"python (dagger|grpo|reward_weighted)\.py": (
        "tests/extras/trajectories/test_rollouts.py or test_dagger_example.py runs it"
    ),
    r"mme(_vla\.|-vla )serve ": "serves until it is stopped",
    r"mme-vla harness ": "serves until it is stopped",
    r"mme-vla docs$": "opens a browser; tests/docs builds the site",
    r"mme(_vla\.|-vla )play ": "waits for a player, or plays hundreds of episodes",
    r"mme-vla record ": "records for minutes or hours",
    r"mme(_vla\.|-vla )evaluate .*checkpoint=nano|tasks=\[PickXtimes,VideoUnmask\]": (
        "evaluates for minutes"
    ),
    r"mme(_vla\.|-vla )probe (twins |checkpoint=nano|compare=)": (
        "needs recorded episodes or finished probes, or evaluates for minutes"
    ),
    r"mme-vla (convert|cache) |subgoal-build input=(path|datasets)": "needs a full dataset",
    r"--config-dir configs embodiment=two_arms": "needs a robot's dataset",
    r"mme-vla weights ": "needs released weights",
    r"benchmarks/(gpu|episode_seeds|nano_simplememvla)\.py|benchmarks/simplememvla\.py count": (
        "measures for minutes"
    ),
}
"""Pattern → why the commands that it matches are not run here."""


@cache
def documented() -> list[tuple[str, str]]:
    """Page and command of every shell command in the documentation, continued lines joined."""
    pages = [REPOSITORY / "README.md", *sorted((REPOSITORY / "docs").rglob("*.md"))]
    return list(
        dict.fromkeys((page.name, line) for page in pages for line in commands_of(page.read_text()))
    )


def commands_of(text: str) -> Iterator[str]:
    for language, block in re.findall(r"^```(\w*)\n(.*?)^```", text, re.DOTALL | re.MULTILINE):
        for line in block.replace("\\\n", " ").splitlines():
            if language == "bash" or (not language and line.startswith(("python ", "mme-vla "))):
                yield re.sub(r"  +# .*", "", line).strip()


def reason(command: str) -> str | None:
    return next((why for pattern, why in NOT_RUN.items() if re.search(pattern, command)), None)


RUN = list(
    {
        command: (page, command)
        for page, command in reversed(documented())
        if reason(command) is None
    }.values()
)
OTHERS = list(
    {command: (page, command) for page, command in documented() if reason(command)}.values()
)


@cache
def folder_of(page: str, root: Path) -> Path:
    """A copy of what stands beside the reader who types a page's commands."""
    folder = root / page
    if page in EXAMPLES:
        return copytree(REPOSITORY / "examples" / EXAMPLES[page], folder)
    folder.mkdir()
    for name in ("benchmarks", "examples", "scripts"):
        (folder / name).symlink_to(REPOSITORY / name)
    (folder / "outputs").mkdir()
    for name in published.ARCHIVES:
        published.unpack(name, folder / published.TARGET)
    return folder


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("pages")


@pytest.mark.nightly
@pytest.mark.parametrize(("page", "command"), RUN[::-1])
def test_a_documented_command_runs_as_printed(
    page: str, command: str, root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = shlex.split(command)
    if words[:2] == ["mme-vla", "results"]:  # in this process: it only reads
        monkeypatch.chdir(folder_of(page, root))
        results(words[2:])
        return
    if re.search(r"mme(_vla\.|-vla )evaluate|mme-vla gallery", command):
        pytest.importorskip(
            "mani_skill", reason="the simulator is not installed: the extra `sim` has it"
        )
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    environment = {**os.environ, "PATH": path, "PYTHONPATH": str(REPOSITORY)}
    done = subprocess.run(
        ["bash", "-c", command],
        cwd=folder_of(page, root),
        env=environment,
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.slow
@pytest.mark.parametrize(("page", "command"), OTHERS)
def test_the_words_of_other_documented_commands_are_valid(page: str, command: str) -> None:
    # what means several words, and may be none
    filled = re.sub(r"<the words[^>]*>|(?<= )(…|\$B)", "", command)
    words = shlex.split(re.sub(r"<[^>]*>|…", "x", filled), comments=True)
    start = next(
        (i for i, word in enumerate(words) if re.match(r"mme-vla$|mme_vla(\.|$)", word)), None
    )
    if start is None:
        return
    program, arguments = words[start], words[start + 1 :]
    if program in ("mme-vla", "mme_vla"):
        assert arguments[0] in cli.commands()
        command_name, arguments = arguments[0], arguments[1:]
        entry = f"mme-vla {command_name}"
    else:
        assert find_spec(program) is not None
        entry = f"mme-vla {program.removeprefix('mme_vla.')}"
    name = {documented: name for name, documented in configured_commands().items()}.get(entry)
    if name is None:  # it takes options instead of a configuration
        return
    if arguments[:1] == ["board"]:  # a command of its own, with options
        return
    if arguments[:1] in (["card"], ["twins"]):
        arguments[0] += "=true"
    # Words that a line above the command defines
    arguments = [word for word in arguments if not word.startswith("$")]
    arguments = trust_as_override(arguments)
    args = get_args_parser().parse_intermixed_args(
        with_settings(arguments) if name == "nano" else arguments
    )
    example = REPOSITORY / "examples" / EXAMPLES.get(page, "")
    trees = (
        [example / args.config_dir]
        if args.config_dir and (example / args.config_dir).is_dir()
        else []
    )
    if args.config_dir and not trees:  # the reader's own
        return
    # Launchers need the extra `sweep`.
    overrides = [word for word in args.overrides if not re.match(r"(hydra\.)?launcher", word)]
    check_overrides(name, overrides, extra_dirs=trees)
    if not args.multirun and name != "nano":  # it composes its models by itself
        plugins = compose(name, args.overrides, extra_dirs=trees).get("plugins", [])
        assert all((example / f"{plugin}.py").is_file() for plugin in plugins)
        assert (
            plugins
            or page not in EXAMPLES
            or page in ("your-robot.md", "first-hour.md")
            or "checkpoint=" in command
        )
