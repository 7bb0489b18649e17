"""Extensions: names that extras and installed packages add, without being imported."""

import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest

from mme_vla import build_policy, cli, registry
from mme_vla.__main__ import main
from mme_vla.config.plugins import import_trusted
from mme_vla.config.trees import library_trees
from mme_vla.errors import UserError
from mme_vla.policy.run_folders import shipped_checkpoints
from mme_vla.registry import Command, Extension, Registry, WeightFormat
from mme_vla.weights.source import formats

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


def test_all_parts_with_one_name_need_trust(install: Callable[..., None]) -> None:
    """`json` is imported already, so that only the other module is foreign."""
    install(Extension(parts={"policy": {"mine": "first.policy"}, "processor": {"mine": "json"}}))
    with pytest.raises(UserError, match=r"needs the plugin first\.policy: code"):
        import_trusted({"policy": {"name": "mine"}}, "a checkpoint", trust=False)


def test_an_entry_point_that_is_no_extension_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    class Entry:
        name, value, dist = "broken", "broken_package:EXTENSION", None

        def load(self) -> object:
            raise ImportError("no module named broken_package")

    monkeypatch.setattr(registry, "entry_points", lambda group: [Entry()])
    with pytest.raises(UserError, match=r"'broken'.*broken_package.*uninstall"):
        registry.installed_extensions.__wrapped__()
    monkeypatch.setattr(Entry, "load", lambda self: "text")
    with pytest.raises(UserError, match=r"is no mme_vla\.registry\.Extension"):
        registry.installed_extensions.__wrapped__()


def test_a_name_of_the_core_is_not_replaced(monkeypatch: pytest.MonkeyPatch) -> None:
    extension = Extension(parts={"shape": {"dot": "elsewhere"}}, owner="the package P")
    monkeypatch.setattr(registry, "extensions", lambda: (extension,))
    shapes: Registry[object] = Registry("shape", {"dot": "collections"})
    with pytest.raises(UserError, match=r"the library \(collections\), and the package P \(else"):
        list(shapes)


# A name that is taken -----------------------------------------------------------------------------


class Entry:
    """An entry point of an installed package."""

    def __init__(self, name: str, extension: Extension) -> None:
        self.name, self.value, self.extension = name, f"{name}.names:EXTENSION", extension
        self.dist = SimpleNamespace(name=f"{name}-package")

    def load(self) -> Extension:
        return self.extension


@pytest.fixture
def install(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., None]]:
    """Have packages `first`, `second`, … bring these extensions."""

    def install(*listed: Extension) -> None:
        entries = [Entry(name, one) for name, one in zip(("first", "second"), listed, strict=False)]
        monkeypatch.setattr(registry, "entry_points", lambda group: entries)
        registry.installed_extensions.cache_clear()

    yield install
    registry.installed_extensions.cache_clear()


FORMAT = WeightFormat("second.weights", "files", "matches", "adapter", "write")
PARTS = [
    # of the core, of an extra, and under another key of the same registry
    ("memory", "framesamp", "the library (mme_vla.memory.framesamp)"),
    ("integration", "modulator", "the library (mme_vla.integration.modulator)"),
    ("backbone", "nano", "the extra 'nano' (mme_vla.extras.nano.backbone)"),
    ("policy", "memoryvla", "the extra 'methods' (mme_vla.extras.methods.memoryvla.policy)"),
    ("env", "mme_vla", "the library (mme_vla.envs.benchmark)"),
    ("env", "mikasa", "the extra 'mikasa' (mme_vla.extras.mikasa.environment)"),
    ("event", "pause", "the library (mme_vla.memory.perturbation)"),
    ("perturbation", "shuffle", "the extra 'probing' (mme_vla.extras.probing.interventions)"),
]


@pytest.mark.parametrize(("key", "name", "owner"), PARTS)
def test_a_part_whose_name_is_taken_names_both_owners(
    key: str, name: str, owner: str, install: Callable[..., None]
) -> None:
    install(Extension(parts={key: {name: "first.part"}}))
    with pytest.raises(UserError) as refused:
        registry.extensions()
    plugin = (
        "the installed plugin 'first' of the package 'first-package' (first.names:EXTENSION)"
        " (first.part)"
    )
    kind = registry.REGISTRIES[key].kind
    assert str(refused.value) == (
        f"Two packages define the {kind} {name!r}: {owner}, and {plugin}. Rename it in one"
        " of them, or uninstall one."
    )


@pytest.mark.parametrize("keys", [("task", "task"), ("event", "intervention")])
def test_two_packages_do_not_bring_one_part(
    keys: tuple[str, str], install: Callable[..., None]
) -> None:
    first, second = (
        Extension(parts={key: {"Mine": f"{name}.part"}})
        for key, name in zip(keys, ("first", "second"), strict=True)
    )
    install(first, second)
    with pytest.raises(
        UserError, match=r"'first'.*\(first\.part\), and .*'second'.*\(second\.part"
    ):
        registry.extensions()
    install(first, Extension(parts=first.parts))
    assert registry.extensions(), "the same module under the same name is no contradiction"


def test_commands_checkpoints_and_formats_whose_name_is_taken_name_both_owners(
    tmp_path: Path, install: Callable[..., None], capsys: pytest.CaptureFixture[str]
) -> None:
    install(
        Extension(commands={"train": Command("first.train", "t")}, checkpoints={"a": tmp_path}),
        Extension(checkpoints={"a": tmp_path / "b"}, weight_formats={"openpi": FORMAT}),
    )
    with pytest.raises(
        UserError, match=r"command 'train': the library \(mme_vla\.cli\.train\), and"
    ):
        cli.commands()
    with pytest.raises(UserError, match=r"the checkpoint 'a': .*'first'.*, and .*'second'.*/b\)"):
        shipped_checkpoints()
    with pytest.raises(
        UserError, match=r"weight format 'openpi': the library.*\(second\.weights\)"
    ):
        formats()
    with pytest.raises(SystemExit) as ended:
        main()
    assert (
        ended.value.code == 2
        and "Two packages define the command 'train'" in capsys.readouterr().err
    )


def test_a_yaml_file_whose_name_is_taken_names_both_files(
    tmp_path: Path, install: Callable[..., None]
) -> None:
    install(Extension(configs=tmp_path / "first"), Extension(configs=tmp_path / "second"))
    with pytest.raises(UserError, match=r"'first'.*has no folder .*first: install it with its fi"):
        library_trees()
    for name in ("first", "second"):
        (tmp_path / name / "memory").mkdir(parents=True)
        (tmp_path / name / "memory" / f"of_{name}.yaml").write_text("name: mine\n")
    assert library_trees()[-2:] == (tmp_path / "first", tmp_path / "second")
    (tmp_path / "second" / "memory" / "of_first.yaml").write_text("name: mine\n")
    with pytest.raises(
        UserError, match=r"memory/of_first\.yaml': .*'first'.*, and .*second/memory"
    ):
        library_trees()
    for shipped in ("memory/framesamp.yaml", "model/memoryvla.yaml", "train.yaml"):
        (tmp_path / "first" / shipped).parent.mkdir(exist_ok=True)
        (tmp_path / "first" / shipped).write_text("name: mine\n")
        with pytest.raises(UserError, match=rf"the configuration '{shipped}': the \w+ .*first/"):
            build_policy("framesamp_modul", device="meta")
        (tmp_path / "first" / shipped).unlink()


def test_a_part_with_an_unknown_kind_is_refused(install: Callable[..., None]) -> None:
    install(Extension(parts={"memroy": {"mine": "first.part"}}))
    with pytest.raises(UserError, match=r"plugin 'first'.*kind of part='memroy'.*memory"):
        registry.extensions()


def test_extras_bring_no_name_twice(install: Callable[..., None]) -> None:
    install()
    assert registry.installed_extensions() == ()  # compares the parts of extras
    assert cli.commands() and shipped_checkpoints() and formats()
    names = [file.relative_to(tree) for tree in library_trees() for file in tree.rglob("*.yaml")]
    assert len(names) == len(set(names))
