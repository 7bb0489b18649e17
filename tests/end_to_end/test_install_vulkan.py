"""`scripts/install_vulkan.sh` against stand-ins of the system's tools, a bare machine first of all.

The stand-ins live in a folder that is the whole PATH, and keep what they "install" in files: nothing of this machine
is read or changed, and the script's user is root or not as a test says. Where Debian's own tools are here, they answer
in a test as the stand-ins do.
"""

import os
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[2]
SCRIPT = REPOSITORY / "scripts" / "install_vulkan.sh"
PACKAGE = "mesa-vulkan-drivers"
NEEDED = ("bash", "awk", "cat", "env", "rm", "tee")  # what the script may take from the system
DEBIAN = 'ID=debian\nVERSION_CODENAME=bookworm\nPRETTY_NAME="Debian GNU/Linux 12 (bookworm)"\n'
UBUNTU = 'ID=ubuntu\nID_LIKE=debian\nVERSION_CODENAME=jammy\nPRETTY_NAME="Ubuntu 22.04"\n'
OLD, NEW = "22.3.6-1+deb12u2", "25.0.7-2~bpo12+1"

# `$STATE` holds a file of each installed package and its version; `offers` and `backports`: the version that apt would
# take from the release and from its backports; `sources`: what indextargets prints; `broken`: the call that fails.
STAND_INS = {
    "id": 'echo "$USER_NUMBER"',
    "sudo": 'echo "sudo $*" >>"$STATE/calls"; AS_ROOT=1 exec "$@"',
    "dpkg-query": r"""
        [ ! -e "$STATE/damaged" ] || { echo "dpkg-query: error: the status database is damaged" >&2; exit 2; }
        file="$STATE/installed/${@: -1}"
        [ -e "$file" ] || { echo "dpkg-query: no packages found matching ${@: -1}" >&2; exit 1; }
        printf 'ii  %s\n' "$(cat "$file")"
    """,
    "apt-cache": r"""
        [ -s "$STATE/offers" ] || exit 0
        printf '%s:\n  Installed: (none)\n  Candidate: %s\n' "$2" "$(cat "$STATE/offers")"
    """,
    "apt-get": r"""
        echo "apt-get $*" >>"$STATE/calls"
        case "$1" in
          update | install)
            [ "$USER_NUMBER" = 0 ] || [ -n "${AS_ROOT:-}" ] || { echo "E: are you root?" >&2; exit 100; } ;;
        esac
        if [ -e "$STATE/broken" ] && [ "$1" = "$(cat "$STATE/broken")" ]; then
          echo "Err:1 Could not connect to the mirror"; echo "E: Failed to fetch" >&2; exit 100
        fi
        case "$1" in
          update)
            if [ -s "$SYSTEM/etc/apt/sources.list.d/bookworm-backports.list" ] && [ ! -s "$STATE/backports" ]; then
              echo "E: The repository does not have a Release file." >&2; exit 100
            fi ;;
          indextargets) cat "$STATE/sources" ;;
          install)
            from=offers
            case " $* " in *" -t bookworm-backports "*) from=backports ;; esac
            [ -s "$STATE/$from" ] || { echo "E: Unable to locate package" >&2; exit 100; }
            cat "$STATE/$from" >"$STATE/installed/mesa-vulkan-drivers"
            echo 1.3.239.0-1 >"$STATE/installed/libvulkan1" ;;
          *) echo "E: Invalid operation $1" >&2; exit 100 ;;
        esac
    """,
}


class Machine:
    """A system made of stand-ins."""

    def __init__(self, folder: Path, release: str, *, offers: str = "", backports: str = "", sources: str = "") -> None:
        self.state, self.system, self.tools = folder / "state", folder / "system", folder / "bin"
        for made in (self.state / "installed", self.system / "etc/apt/sources.list.d", self.tools):
            made.mkdir(parents=True)
        (self.system / "etc/os-release").write_text(release)
        for name, text in (("offers", offers), ("backports", backports), ("sources", sources)):
            (self.state / name).write_text(text)
        for name in NEEDED:
            (self.tools / name).symlink_to(str(shutil.which(name)))
        for name, body in STAND_INS.items():
            self.tool(name, body)

    def tool(self, name: str, body: str) -> None:
        (self.tools / name).write_text(f"#!{shutil.which('bash')}\n{body}\n")
        (self.tools / name).chmod(0o755)

    def holds(self, **packages: str) -> "Machine":
        for name, version in packages.items():
            (self.state / "installed" / name.replace("_", "-")).write_text(version)
        return self

    def run(self, user: int = 0) -> "Ended":
        variables = {
            "PATH": str(self.tools), "STATE": str(self.state), "SYSTEM": str(self.system),
            "INSTALL_VULKAN_SYSTEM": str(self.system), "USER_NUMBER": str(user),
        }  # fmt: skip
        done = subprocess.run(
            [str(shutil.which("bash")), str(SCRIPT)], env=variables, capture_output=True, text=True, timeout=60
        )
        calls = self.state / "calls"
        return Ended(done.returncode, done.stdout + done.stderr, calls.read_text() if calls.exists() else "")

    def version(self) -> str | None:
        file = self.state / "installed" / PACKAGE
        return file.read_text() if file.exists() else None

    @property
    def backports_list(self) -> Path:
        return self.system / "etc/apt/sources.list.d/bookworm-backports.list"


class Ended:
    """How a run ended: its status, what it said, and which of the system's tools that change something it called."""

    def __init__(self, status: int, said: str, calls: str) -> None:
        self.status, self.said, self.calls = status, said, calls


Make = Callable[..., Machine]
BOOKWORM = "http://mirror.example/debian bookworm main\nhttp://mirror.example/debian bookworm-updates main\n"


@pytest.fixture
def make(tmp_path: Path) -> Make:
    return lambda release=DEBIAN, **contents: Machine(tmp_path, release, **contents)


def test_a_driver_that_was_never_installed_is_installed(make: Make) -> None:
    machine = make(offers=NEW)
    ended = machine.run()
    assert ended.status == 0, ended.said
    assert machine.version() == NEW
    assert f"{PACKAGE} is not installed" in ended.said and f"{PACKAGE} {NEW} is installed" in ended.said
    assert not machine.backports_list.exists()
    assert "installed already" in machine.run().said


def test_a_driver_without_the_loader_is_completed(make: Make) -> None:
    machine = make(offers=NEW).holds(mesa_vulkan_drivers=NEW)
    assert machine.run().status == 0
    assert (machine.state / "installed/libvulkan1").exists()


def test_what_is_there_already_is_left_alone(make: Make) -> None:
    ended = make(offers=NEW).holds(mesa_vulkan_drivers=NEW, libvulkan1="1.3").run(user=1000)
    assert ended.status == 0 and "installed already" in ended.said
    assert ended.calls == ""


@pytest.mark.parametrize("there", [{}, {"mesa_vulkan_drivers": OLD, "libvulkan1": "1.3"}], ids=["never", "old"])
def test_debian_takes_a_driver_that_is_too_old_from_its_backports(make: Make, there: dict[str, str]) -> None:
    machine = make(offers=OLD, backports=NEW, sources=BOOKWORM).holds(**there)
    ended = machine.run()
    assert ended.status == 0, ended.said
    assert machine.version() == NEW
    assert machine.backports_list.read_text() == "deb http://mirror.example/debian bookworm-backports main\n"


def test_backports_that_are_a_source_already_are_not_added_again(make: Make) -> None:
    sources = BOOKWORM + "http://mirror.example/debian bookworm-backports main\n"
    machine = make(offers=OLD, backports=NEW, sources=sources)
    assert machine.run().status == 0
    assert machine.version() == NEW and not machine.backports_list.exists()


def test_backports_that_cannot_be_read_are_taken_out_again(make: Make) -> None:
    machine = make(offers=OLD, sources=BOOKWORM)
    ended = machine.run()
    assert ended.status == 1
    assert "does not have a Release file" in ended.said and "is gone again" in ended.said
    assert not machine.backports_list.exists()


def test_an_ubuntu_that_is_too_old_says_so(make: Make) -> None:
    machine = make(UBUNTU, offers="23.2.1-1ubuntu3.1~22.04.3")
    ended = machine.run()
    assert ended.status == 1
    assert "Ubuntu 22.04 offers mesa-vulkan-drivers 23.2.1" in ended.said and "24 or newer is needed" in ended.said
    assert machine.version() is None


@pytest.mark.parametrize("release", [DEBIAN, UBUNTU], ids=["debian", "ubuntu"])
def test_without_a_package_source_it_says_where_one_belongs(make: Make, release: str) -> None:
    ended = make(release).run()
    assert ended.status == 1
    assert f"no package source offers {PACKAGE}" in ended.said and "/etc/apt" in ended.said


def test_a_user_without_sudo_is_told_before_anything_is_changed(make: Make) -> None:
    machine = make(offers=NEW)
    (machine.tools / "sudo").unlink()
    ended = machine.run(user=1000)
    assert ended.status == 1 and "needs root" in ended.said and "sudo" in ended.said
    assert ended.calls == ""


def test_a_user_with_sudo_installs_through_it(make: Make) -> None:
    machine = make(offers=OLD, backports=NEW, sources=BOOKWORM)
    ended = machine.run(user=1000)
    assert ended.status == 0, ended.said
    assert "sudo apt-get update" in ended.calls and "sudo tee" in ended.calls
    assert machine.version() == NEW


@pytest.mark.parametrize("call", ["update", "install"])
def test_apt_that_fails_is_shown_and_named(make: Make, call: str) -> None:
    machine = make(offers=NEW)
    (machine.state / "broken").write_text(call)
    ended = machine.run()
    assert ended.status == 1
    assert "Could not connect to the mirror" in ended.said and "E: Failed to fetch" in ended.said
    assert f"install_vulkan: apt-get {call} failed" in ended.said


def test_a_damaged_package_database_is_not_taken_for_an_empty_one(make: Make) -> None:
    machine = make(offers=NEW)
    (machine.state / "damaged").touch()
    ended = machine.run()
    assert ended.status != 0 and "the status database is damaged" in ended.said
    assert ended.calls == ""


@pytest.mark.parametrize("tool", ["dpkg-query", "apt-cache", "apt-get", "awk", "id"])
def test_a_tool_that_fails_unexpectedly_never_ends_the_script_in_silence(make: Make, tool: str) -> None:
    machine = make(offers=OLD, backports=NEW, sources=BOOKWORM)
    (machine.tools / tool).unlink()
    machine.tool(tool, "exit 7")
    ended = machine.run()
    assert ended.status != 0 and "install_vulkan: " in ended.said


def test_another_system_is_told_what_to_do(make: Make) -> None:
    ended = make('ID=fedora\nPRETTY_NAME="Fedora Linux 42"\n').run()
    assert ended.status == 1 and "Fedora Linux 42" in ended.said and "manually" in ended.said


@pytest.mark.skipif(shutil.which("dpkg-query") is None, reason="no dpkg on this system")
@pytest.mark.parametrize("there", [False, True], ids=["never", "installed"])
def test_the_real_dpkg_query_answers_as_its_stand_in_does(make: Make, tmp_path: Path, there: bool) -> None:
    machine = make(offers=NEW)
    database = tmp_path / "dpkg"
    for folder in ("info", "updates"):
        (database / folder).mkdir(parents=True)
    entry = f"Package: {PACKAGE}\nStatus: install ok installed\nArchitecture: all\nVersion: {NEW}\n"
    (database / "status").write_text(f"{entry}Maintainer: nobody <nobody@mirror.example>\nDescription: none\n" * there)
    if there:
        machine.holds(mesa_vulkan_drivers=NEW)
    question = ["-W", "-f=${db:Status-Abbrev} ${Version}\\n", PACKAGE]
    real = [str(shutil.which("dpkg-query")), f"--admindir={database}", *question]
    variables = {**os.environ, "LC_ALL": "C", "STATE": str(machine.state)}
    answers = [
        subprocess.run(command, env=variables, capture_output=True, text=True)
        for command in (real, [str(machine.tools / "dpkg-query"), *question])
    ]
    assert answers[0].returncode == answers[1].returncode == (0 if there else 1)
    assert answers[0].stdout.split() == answers[1].stdout.split()
    assert answers[0].stderr.strip() == answers[1].stderr.strip()
