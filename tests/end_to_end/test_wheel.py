"""The built wheel is complete: from an empty environment, away from the repository, a policy builds
and trains.
"""

import os
import re
import shutil
import subprocess
import sys
import sysconfig
import tarfile
import zipfile
from importlib.util import find_spec
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]
TRAIN = [
    "model=tokendrop_expert",
    "train.steps=3",
    "train.val_samples=2",
    "train.open_loop_chunks=1",
    "backbone.vision.depth=1",
    "backbone.vision.image_size=16",
    "backbone.vision.patch_size=2",
    "hydra.run.dir=run",
]
USE = """
import runpy
import sys
import mme_vla

print(mme_vla.__file__)
print(type(mme_vla.build_policy("tokendrop_expert")).__name__, flush=True)
runpy.run_module("mme_vla.train", run_name="__main__", alter_sys=True)
print("lerobot.datasets" in sys.modules)
"""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip(
        "hatchling", reason="building the wheel needs hatchling (the group dev has it)"
    )
    folder = tmp_path_factory.mktemp("wheel")
    run(
        [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(folder)],
        cwd=REPOSITORY,
    )
    return next(folder.glob("*.whl"))


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The Python of a new environment that holds the wheel and its dependencies, at their pinned
    versions.

    They come from uv's cache, without network. Where that lacks them (no uv, or torch from
    elsewhere), they are the running environment's: its folder joins the path, but of what its own
    .pth files add only pinocchio's, so never the repository.
    """
    folder = tmp_path_factory.mktemp("empty")
    run([sys.executable, "-m", "venv", "--without-pip", str(folder)], cwd=folder)
    python = folder / "bin" / "python"
    uv = os.environ.get("UV") or shutil.which("uv")
    if uv is not None:
        pins = str(REPOSITORY / "constraints.txt")
        order = [
            uv,
            "pip",
            "install",
            "--offline",
            "--link-mode",
            "symlink",
            "--no-compile-bytecode",
            "--python",
            str(python),
            "-c",
            pins,
            "pytest",
            "pytest-timeout",
        ]
        if (
            subprocess.run(
                [*order, f"mme-vla[sim] @ {wheel.as_uri()}"], cwd=REPOSITORY, capture_output=True
            ).returncode
            == 0
        ):
            return python
    site_packages = Path(
        run(
            [str(python), "-c", "import sysconfig; print(sysconfig.get_path('purelib'))"],
            cwd=folder,
        ).strip()
    )
    zipfile.ZipFile(wheel).extractall(site_packages)
    paths = [sysconfig.get_path("purelib")]
    if find_spec("cmeel_pth") is not None:
        paths.append("import cmeel_pth")
    (site_packages / "dependencies.pth").write_text("\n".join(paths))
    script = python.with_name("mme-vla")
    script.write_text(f"#!{python}\nfrom mme_vla.__main__ import main\nmain()\n")
    script.chmod(0o755)
    return python


@pytest.mark.slow
def test_the_wheel_holds_every_file_of_the_package_and_the_configs(wheel: Path) -> None:
    packed = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    assert packed == source_files("mme_vla", "mme_vla") | source_files("configs", "mme_vla/configs")
    assert "mme_vla/py.typed" in packed


@pytest.mark.slow
def test_the_source_archive_holds_what_the_wheel_is_made_of(tmp_path: Path) -> None:
    pytest.importorskip("hatchling", reason="building needs hatchling (the group dev has it)")
    run(
        [sys.executable, "-m", "hatchling", "build", "-t", "sdist", "-d", str(tmp_path)],
        cwd=REPOSITORY,
    )
    with tarfile.open(next(tmp_path.glob("*.tar.gz"))) as archive:
        packed = {name.partition("/")[2] for name in archive.getnames()}
    assert source_files("mme_vla", "mme_vla") | source_files("configs", "configs") <= packed
    assert {
        "pyproject.toml",
        "README.md",
        "LICENSE",
        "constraints.txt",
        "tests/end_to_end/test_wheel.py",
        ".ci/run",
        ".github/workflows/tests.yml",
    } <= packed


@pytest.mark.nightly
def test_a_policy_builds_and_trains_from_the_wheel_alone(installed: Path, tmp_path: Path) -> None:
    (tmp_path / "use.py").write_text(USE)
    module, kind, *_, imported = run([str(installed), "use.py", *TRAIN], cwd=tmp_path).splitlines()
    assert Path(module).is_relative_to(installed.parent.parent)
    assert kind == "MMEPolicy"
    assert imported == "False"  # writing datasets needs it, and seconds to import it
    assert list((tmp_path / "run").rglob("*.safetensors"))


@pytest.mark.nightly
def test_the_commands_of_the_readme_work_from_the_wheel(
    installed: Path, tmp_path: Path, renderer: str
) -> None:
    readme = (REPOSITORY / "README.md").read_text()
    *commands, site = blocks("bash", readme.partition("## Try it")[2])[0].splitlines()
    assert len(commands) == 3 and site == "mme-vla docs"  # its pages are in a clone
    train = blocks("bash", readme)[0].partition("uv run ")[2].strip()
    python = blocks("python", readme)[0]
    (tmp_path / "block.py").write_text(python)
    help_texts = ["mme-vla --version", "mme-vla --help", "mme-vla results --demo"]
    inspect = "mme-vla inspect checkpoint=nano"
    for command in [*help_texts, inspect, train, "python block.py", *commands]:
        line = f'PATH="{installed.parent}:$PATH" HOME="{tmp_path}" {command}'
        run(["bash", "-c", line], cwd=tmp_path)
    assert list(tmp_path.rglob("*.mp4"))
    refused = subprocess.run(
        [installed.with_name("mme-vla"), "docs"],
        cwd=tmp_path,
        env=away_from_the_repository(),
        capture_output=True,
        text=True,
    )
    assert refused.returncode == 2 and "pages are in the repository" in refused.stderr


def blocks(language: str, text: str) -> list[str]:
    """The blocks of code of a page."""
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.DOTALL | re.MULTILINE)


def source_files(folder: str, inside: str) -> set[str]:
    files = (
        file
        for file in (REPOSITORY / folder).rglob("*")
        if file.is_file() and "__pycache__" not in file.parts
    )
    return {f"{inside}/{file.relative_to(REPOSITORY / folder).as_posix()}" for file in files}


def run(command: list[str], cwd: Path) -> str:
    """Run without any way back to the repository or out to a hub, and return what was printed."""
    done = subprocess.run(
        command, cwd=cwd, env=away_from_the_repository(), capture_output=True, text=True
    )
    assert done.returncode == 0, f"{done.stdout}\n{done.stderr}"
    return done.stdout


def away_from_the_repository() -> dict[str, str]:
    """Variables of a process that finds neither this repository nor a hub."""
    clean = {
        key: value
        for key, value in os.environ.items()
        if not key.startswith(("PYTHON", "VIRTUAL_ENV"))
    }
    return {**clean, "HF_HUB_OFFLINE": "1"}
