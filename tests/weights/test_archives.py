"""Released checkpoints as they are published: a zip in a folder of a hub repository, read where it
lies.
"""

import zipfile
from collections.abc import Callable
from pathlib import Path

import huggingface_hub
import pytest

from helpers.memory_fakes import same
from mme_vla.cli.weights import convert
from mme_vla.errors import UserError
from mme_vla.policy.build import build_policy
from mme_vla.policy.mme import MMEPolicy
from mme_vla.testing.small import small_policy, unit_stats
from mme_vla.training.runs import start_from
from mme_vla.weights import load_weights
from mme_vla.weights.orbax import Zipped
from mme_vla.weights.source import open_source
from mme_vla.weights.statistics import stats_files

pytest.importorskip("tensorstore", reason="reading Orbax checkpoints needs the extra 'orbax'")
VARIANT = "perceptual-tokendrop-modul"


@pytest.fixture(scope="module")
def policy() -> MMEPolicy:
    return small_policy("tokendrop_modul", seed=5)


@pytest.fixture(scope="module")
def published(policy: MMEPolicy, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """<folder of the variant's name>/79999.zip, with the step's arrays and statistics."""
    folder = tmp_path_factory.mktemp("hub") / VARIANT
    policy.save_pretrained(folder.parent / "ours")
    convert(folder.parent / "ours", folder.parent / "run", to="released")
    folder.mkdir()
    with zipfile.ZipFile(folder / "79999.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        for file in sorted((folder.parent / "run" / "0").rglob("*")):
            archive.write(file, Path("79999") / file.relative_to(folder.parent / "run" / "0"))
    return folder


@pytest.mark.parametrize(
    "named", [lambda folder: folder, lambda folder: folder / "79999.zip"], ids=["folder", "zip"]
)
def test_an_archive_is_loaded_completely_with_its_statistics(
    policy: MMEPolicy, published: Path, named: Callable[[Path], Path]
) -> None:
    loaded = build_policy("tokendrop_modul", seed=1)
    assert loaded.require_processor().stats is None
    load_weights(loaded, named(published))
    assert same(loaded, policy)
    stats = loaded.require_processor().require_stats()
    assert stats.actions.q99.tolist() == unit_stats().actions.q99.tolist()


def test_the_variant_is_recognised_from_the_name_of_the_folder(
    policy: MMEPolicy, published: Path, tmp_path: Path
) -> None:
    assert open_source(published / "79999.zip").variants == ["tokendrop_modul"]
    convert(published, tmp_path / "ours", ["backbone=tiny"])
    assert same(MMEPolicy.from_pretrained(tmp_path / "ours"), policy)


def test_a_file_in_the_archive_tells_it_before_the_folder_does(
    published: Path, tmp_path: Path
) -> None:
    archive = tmp_path / "79999.zip"
    archive.write_bytes((published / "79999.zip").read_bytes())
    assert open_source(archive).variants == []
    with zipfile.ZipFile(archive, "a") as opened:
        opened.writestr("history_config.txt", "configs/recurrent-ttt-expert.yaml\n")
    assert open_source(archive).variants == ["ttt_expert"]


def test_a_folder_on_the_hub_is_fetched_alone(
    policy: MMEPolicy, published: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    requests = []

    def snapshot(
        repository: str, revision: str | None, token: str | None, allow_patterns: list[str]
    ) -> str:
        requests.append((repository, revision, allow_patterns))
        return str(published.parent)

    monkeypatch.setattr(huggingface_hub, "snapshot_download", snapshot)
    fresh = small_policy("tokendrop_modul", seed=1)
    report = start_from(fresh, f"Yinpei/mme_vla_suite/{VARIANT}")
    assert same(fresh, policy) and " 0 new" in report
    assert requests == [("Yinpei/mme_vla_suite", None, [VARIANT, f"{VARIANT}/*"])]
    with pytest.raises(UserError, match="nothing called 'perceptual-nothing'"):
        start_from(fresh, "Yinpei/mme_vla_suite/perceptual-nothing")


def write(file: Path, **contents: bytes) -> Path:
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in contents.items():
            archive.writestr(name, content)
    return file


@pytest.mark.parametrize(
    ("contents", "message"),
    [
        ({"../params/manifest.ocdbt": b"x"}, "lies outside of it"),
        ({"/params/manifest.ocdbt": b"x"}, "lies outside of it"),
        ({"C:/params/manifest.ocdbt": b"x"}, "lies outside of it"),
        (
            {"params/manifest.ocdbt": b"x", "params/d/1": bytes(20_000_000)},
            "unpacks to 20,000,000 bytes",
        ),
        ({"notes.txt": b"x"}, "no Orbax arrays"),
        ({"params/manifest.ocdbt": b"x"}, "is damaged: it cannot be read as an Orbax checkpoint"),
        (
            {"params/manifest.ocdbt": b"x", "assets/a b/norm_stats.json": b"{}"},
            "cannot name a folder",
        ),
    ],
)
def test_what_no_checkpoint_holds_is_refused(
    tmp_path: Path, contents: dict[str, bytes], message: str
) -> None:
    with pytest.raises(UserError, match=message):
        load_weights(build_policy("pi05"), write(tmp_path / "1.zip", **contents))


def test_a_cut_archive_is_damaged(published: Path, tmp_path: Path) -> None:
    content = (published / "79999.zip").read_bytes()
    (tmp_path / "79999.zip").write_bytes(content[: len(content) // 2])
    with pytest.raises(UserError, match="is damaged: it cannot be read as a zip archive"):
        open_source(tmp_path / "79999.zip")
    flipped = bytearray(content)
    flipped[len(content) // 2] ^= 0xFF
    (tmp_path / "79999.zip").write_bytes(flipped)
    with pytest.raises(UserError, match="damaged"):
        load_weights(build_policy("tokendrop_modul"), tmp_path / "79999.zip")


def test_a_name_that_stands_twice_is_refused(tmp_path: Path) -> None:
    file = write(tmp_path / "1.zip", **{"params/manifest.ocdbt": b"x", "params/d/1": b"first"})
    with zipfile.ZipFile(file, "a") as archive, pytest.warns(UserWarning, match="Duplicate name"):
        archive.writestr("params/d/1", b"second")
    with pytest.raises(UserError, match="names 'params/d/1' twice"):
        open_source(file)


def test_entries_that_overlap_are_refused(tmp_path: Path) -> None:
    """One entry's content holds the header of another, which the directory lists as well."""
    inner = write(tmp_path / "inner.zip", **{"params/d/2": b"y" * 1000})
    with zipfile.ZipFile(inner) as archive:
        hidden = archive.getinfo("params/d/2")
    file = tmp_path / "1.zip"
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("params/manifest.ocdbt", b"x")
        archive.writestr("params/d/1", inner.read_bytes())
        outer = archive.getinfo("params/d/1")
        hidden.header_offset = outer.header_offset + len(outer.FileHeader())
        archive.filelist.append(hidden)
    with pytest.raises(UserError, match="the bytes of 'params/d/1' overlap"):
        open_source(file)


def test_many_small_files_that_unpack_to_more_than_arrays_do_are_refused(tmp_path: Path) -> None:
    pieces = {f"params/d/{i}": bytes(4_000_000) for i in range(3)}
    with pytest.raises(UserError, match="bytes unpack to 12,000,001: that is no checkpoint"):
        open_source(write(tmp_path / "1.zip", **{"params/manifest.ocdbt": b"x"}, **pieces))


def test_of_several_steps_in_an_archive_the_newest_is_read_with_its_statistics(
    tmp_path: Path,
) -> None:
    contents = {}
    for step in (9999, 10000, 100):
        for place in ("org/robot", "other/robot"):
            contents[f"run/{step}/assets/{place}/norm_stats.json"] = f"{step} {place}".encode()
        contents[f"run/{step}/params/manifest.ocdbt"] = b"x"
    contents["run/history_config.txt"] = b"recurrent-ttt-expert.yaml"
    source = open_source(write(tmp_path / "1.zip", **contents))
    assert isinstance(source.params, Zipped) and source.params.place == "run/10000/params/"
    assert source.variants == ["ttt_expert"]
    files = stats_files(source.folder)
    assert {name: file.read_text() for name, file in files.items()} == {
        "org/robot": "10000 org/robot",
        "other/robot": "10000 other/robot",
    }


def test_an_archive_that_was_refused_is_refused_again(tmp_path: Path) -> None:
    names = ["params/manifest.ocdbt", "assets/a b/norm_stats.json"]
    file = write(tmp_path / "1.zip", **dict.fromkeys(names, b"{}"))
    for _ in range(2):
        with pytest.raises(UserError, match="cannot name a folder"):
            open_source(file)
