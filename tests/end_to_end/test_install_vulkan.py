"""`scripts/install_vulkan.sh` with fakes of the system's tools, which keep what they install in files."""

import shutil
import subprocess
from pathlib import Path

import pytest

from helpers import REPOSITORY

PACKAGE = "mesa-vulkan-drivers"
DEBIAN = 'ID=debian\nVERSION_CODENAME=bookworm\nPRETTY_NAME="Debian GNU/Linux 12 (bookworm)"\n'
UBUNTU = 'ID=ubuntu\nID_LIKE=debian\nVERSION_CODENAME=jammy\nPRETTY_NAME="Ubuntu 22.04"\n'
OLD, NEW = "22.3.6-1+deb12u2", "25.0.7-2~bpo12+1"
FAKES = {
    "id": "echo 0",
    "dpkg-query": '[ -e "$STATE/${@: -1}" ] || exit 1; echo "ii  $(cat "$STATE/${@: -1}")"',
    "apt-cache": '[ ! -s "$STATE/offers" ] || echo "  Candidate: $(cat "$STATE/offers")"',
    "apt-get": r"""
        case "$1" in
          update) [ ! -e "$STATE/offline" ] || { echo "E: Failed to fetch" >&2; exit 100; } ;;
          indextargets) echo "http://mirror.example/debian bookworm main" ;;
          install)
            from=offers
            case " $* " in *" -t bookworm-backports "*) from=backports ;; esac
            cp "$STATE/$from" "$STATE/mesa-vulkan-drivers"; echo 1.3 >"$STATE/libvulkan1" ;;
        esac
    """,
}


def run(folder: Path, release: str = DEBIAN, **state: str) -> tuple[int, str, str | None]:
    """Exit code, output, and the version of the driver that is then installed."""
    tools, system = folder / "bin", folder / "system"
    for made in (tools, system / "etc/apt/sources.list.d"):
        made.mkdir(parents=True)
    (system / "etc/os-release").write_text(release)
    for name, text in state.items():
        (folder / name.replace("_", "-")).write_text(text)
    for name in ("bash", "awk", "cat", "cp", "env", "rm", "tee"):
        (tools / name).symlink_to(str(shutil.which(name)))
    for name, body in FAKES.items():
        (tools / name).write_text(f"#!{shutil.which('bash')}\n{body}\n")
        (tools / name).chmod(0o755)
    variables = {"PATH": str(tools), "STATE": str(folder), "INSTALL_VULKAN_SYSTEM": str(system)}
    script = [str(shutil.which("bash")), str(REPOSITORY / "scripts" / "install_vulkan.sh")]
    done = subprocess.run(script, env=variables, capture_output=True, text=True, timeout=60)
    driver = folder / PACKAGE
    return done.returncode, done.stdout + done.stderr, driver.read_text() if driver.exists() else None


def test_an_absent_driver_is_installed(tmp_path: Path) -> None:
    code, output, driver = run(tmp_path, offers=NEW)
    assert (code, driver) == (0, NEW) and f"{PACKAGE} is not installed" in output


def test_a_recent_driver_is_left_alone(tmp_path: Path) -> None:
    code, output, _ = run(tmp_path, mesa_vulkan_drivers=NEW, libvulkan1="1.3", offline="")
    assert code == 0 and "installed already" in output


def test_debian_takes_a_recent_driver_from_its_backports(tmp_path: Path) -> None:
    code, output, driver = run(tmp_path, offers=OLD, backports=NEW, mesa_vulkan_drivers=OLD, libvulkan1="1.3")
    assert (code, driver) == (0, NEW), output
    sources = tmp_path / "system/etc/apt/sources.list.d/bookworm-backports.list"
    assert sources.read_text() == "deb http://mirror.example/debian bookworm-backports main\n"


@pytest.mark.parametrize(
    ("release", "state", "message"),
    [
        (UBUNTU, {"offers": "23.2.1-1ubuntu3.1"}, "24 or newer is needed"),
        (DEBIAN, {}, f"no package source offers {PACKAGE}"),
        (DEBIAN, {"offers": NEW, "offline": ""}, "apt-get update failed"),
        ('ID=fedora\nPRETTY_NAME="Fedora Linux 42"\n', {}, "manually"),
    ],
    ids=["old release", "no source", "offline", "other system"],
)
def test_a_failure_says_what_to_do(tmp_path: Path, release: str, state: dict[str, str], message: str) -> None:
    code, output, driver = run(tmp_path, release, **state)
    assert code == 1 and driver is None and message in output, output
