"""Extensions: names that extras and installed packages add, without being imported."""

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from mme_vla import build_policy, cli, registry
from mme_vla.config.plugins import import_trusted
from mme_vla.errors import UserError
from mme_vla.registry import Extension, Registry

SOURCE = """
from mme_vla.memory.framesamp import FrameSamp
from mme_vla.registry import register


@register("memory", "paling")
class Paling(FrameSamp):
    pass


def main():
    print("paled")
"""
EXTENSION = """
from pathlib import Path

from mme_vla.registry import Command, Extension

EXTENSION = Extension(
    parts={"memory": {"paling": "package_of_a_paling_memory"}},
    commands={"pale": Command("package_of_a_paling_memory", "pale")},
    configs=Path(__file__).parent / "configs",
)
"""
PACKAGE, NAMES = "package_of_a_paling_memory", "names_of_a_paling_memory"


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """An installed package that adds a memory, a model of it and a command."""
    (tmp_path / f"{PACKAGE}.py").write_text(SOURCE)
    (tmp_path / "configs" / "model").mkdir(parents=True)
    (tmp_path / "configs" / "memory").mkdir()
    (tmp_path / "configs" / "model" / "paling_modul.yaml").write_text(
        "# @package _global_\ndefaults:\n  - /memory: paling\n  - /integration: modulator\n"
        "name: paling_modul\n"
    )
    (tmp_path / "configs" / "memory" / "paling.yaml").write_text(
        "name: paling\nbudget: 64\ngrid: 4\n"
    )
    (tmp_path / f"{NAMES}.py").write_text(EXTENSION)
    metadata = tmp_path / f"{NAMES}-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {NAMES}\nVersion: 1.0\n")
    (metadata / "entry_points.txt").write_text(f"[mme_vla.plugins]\npaling = {NAMES}:EXTENSION\n")
    monkeypatch.syspath_prepend(tmp_path)
    registry.installed_extensions.cache_clear()
    yield tmp_path
    registry.installed_extensions.cache_clear()
    for name in (PACKAGE, NAMES):
        sys.modules.pop(name, None)
    registry.MEMORIES._entries.pop("paling", None)


def test_a_name_of_an_installed_package_is_taken_by_its_module(package: Path) -> None:
    with pytest.raises(UserError, match=f"memory 'paling' is taken by {PACKAGE}; choose another"):
        registry.register("memory", "paling")(type("Mine", (), {}))


def test_an_installed_package_adds_a_memory_and_its_files(package: Path) -> None:
    assert "paling" in registry.MEMORIES and PACKAGE not in sys.modules
    policy = build_policy("paling_modul", backbone="tiny", device="meta")
    assert type(policy.memory).__name__ == "Paling" and PACKAGE in sys.modules


def test_an_installed_package_adds_a_command(
    package: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["mme-vla pale"])
    cli.run("pale")
    assert capsys.readouterr().out == "paled\n"


def test_a_checkpoint_that_names_a_part_of_a_package_needs_trust(package: Path) -> None:
    config = {"name": "paling_modul", "memory": {"name": "paling"}}
    with pytest.raises(UserError, match=f"needs the plugin {PACKAGE}.*--trust-plugins"):
        import_trusted(config, "a checkpoint", trust=False)
    assert PACKAGE not in sys.modules
    import_trusted(config, "a checkpoint", trust=True)


def test_an_entry_point_that_is_no_extension_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    class Entry:
        name, value = "broken", "broken_package:EXTENSION"

        def load(self) -> object:
            raise ImportError("no module named broken_package")

    monkeypatch.setattr(registry, "entry_points", lambda group: [Entry()])
    with pytest.raises(UserError, match=r"'broken'.*broken_package.*uninstall"):
        registry.installed_extensions.__wrapped__()
    monkeypatch.setattr(Entry, "load", lambda self: "text")
    with pytest.raises(UserError, match=r"is no mme_vla\.registry\.Extension"):
        registry.installed_extensions.__wrapped__()


def test_a_name_of_the_core_is_not_replaced(monkeypatch: pytest.MonkeyPatch) -> None:
    extension = Extension(parts={"shape": {"dot": "elsewhere"}})
    monkeypatch.setattr(registry, "extensions", lambda: (extension,))
    shapes: Registry[object] = Registry("shape", {"dot": "collections"})
    assert shapes._modules == {"dot": "collections"}
