"""Commands destroy nothing of the user's: what is there and is no earlier output of the command is
refused by name.
"""

import json
import os
import resource
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import fields
from pathlib import Path
from types import SimpleNamespace

import pytest

from mme_vla.cli import docs, gallery, results, train_tokenizer
from mme_vla.cli.errors import print_user_errors
from mme_vla.config.composition import compose
from mme_vla.envs import metadata
from mme_vla.errors import SceneError, UserError
from mme_vla.extras.nano.cli import board
from mme_vla.extras.nano.fitting import _remove_drafts
from mme_vla.extras.probing.analyses.cost import ModelCost, write_costs
from mme_vla.extras.probing.cli.analyse import _beside, _save
from mme_vla.policy.tensor_files import replace_folder
from mme_vla.utils import require_replaceable, write_text


def contents(folder: Path) -> dict[str, bytes | None]:
    paths = {path.relative_to(folder).as_posix(): path for path in folder.rglob("*")}
    return {name: path.read_bytes() if path.is_file() else None for name, path in paths.items()}


@contextmanager
def disk_of(size: int) -> Iterator[None]:
    """No file takes more bytes meanwhile, as on a full disk."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


@pytest.fixture
def pages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A small clone whose pages `mme-vla docs` builds."""
    pytest.importorskip("mkdocs", reason="the extra `docs` is not installed")
    clone = tmp_path / "clone"
    (clone / "docs" / "sub").mkdir(parents=True)
    (clone / "docs" / "index.md").write_text("# First\n")
    (clone / "docs" / "sub" / "more.md").write_text("# More\n")
    (clone / "mkdocs.yml").write_text("site_name: x\n")
    monkeypatch.setattr(docs, "SETTINGS", clone / "mkdocs.yml")
    return clone / "docs"


def test_a_site_replaces_an_earlier_one_and_nothing_else(pages: Path, tmp_path: Path) -> None:
    site = tmp_path / "outputs" / "site"
    assert "First" in docs.build_site(site).read_text()
    assert (site / "sub" / "more" / "index.html").is_file()
    (pages / "index.md").write_text("# Second\n")
    (pages / "sub" / "more.md").unlink()
    assert "Second" in docs.build_site(site).read_text()
    assert not (site / "sub").exists()
    assert [path.name for path in site.parent.iterdir()] == ["site"]


@pytest.mark.parametrize(
    "name", ["thesis.txt", "chapter/one.txt", ".notes", ".git/config", "empty/", "sub/mine.html"]
)
@pytest.mark.parametrize("built", [False, True], ids=["other folder", "in an earlier site"])
def test_a_site_is_not_built_where_something_of_the_users_lies(
    built: bool, name: str, pages: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "folder"
    if built:
        docs.build_site(folder)
    place = folder / name
    (place if name.endswith("/") else place.parent).mkdir(parents=True, exist_ok=True)
    if not name.endswith("/"):
        place.write_text("mine")
    before = contents(folder)
    with pytest.raises(UserError, match=r"folder holds what is no site .* choose another"):
        docs.build_site(folder)
    assert contents(folder) == before


def test_a_page_that_somebody_changed_is_not_replaced(pages: Path, tmp_path: Path) -> None:
    page = docs.build_site(tmp_path / "site")
    page.write_text("my own start page")
    with pytest.raises(UserError, match="changed since"):
        docs.build_site(tmp_path / "site")
    assert page.read_text() == "my own start page"


def test_a_page_that_somebody_renamed_or_removed_is_not_replaced(
    pages: Path, tmp_path: Path
) -> None:
    page = docs.build_site(tmp_path / "site")
    page.rename(page.with_name("mine.html"))
    with pytest.raises(UserError, match="changed since"):
        docs.build_site(tmp_path / "site")
    page.with_name("mine.html").unlink()
    with pytest.raises(UserError, match="changed since"):
        docs.build_site(tmp_path / "site")


def test_a_link_in_a_site_and_a_file_in_its_place_are_refused(pages: Path, tmp_path: Path) -> None:
    docs.build_site(tmp_path / "site")
    (tmp_path / "site" / "away").symlink_to(tmp_path)
    with pytest.raises(UserError, match="no site"):
        docs.build_site(tmp_path / "site")
    assert (tmp_path / "site" / "away").is_symlink()
    (tmp_path / "file").write_text("mine")
    with pytest.raises(UserError, match="is a file"):
        docs.build_site(tmp_path / "file")


def test_an_empty_folder_takes_a_site_and_a_failed_build_leaves_the_earlier_one(
    pages: Path, tmp_path: Path
) -> None:
    (tmp_path / "site").mkdir()
    docs.build_site(tmp_path / "site")
    before = contents(tmp_path / "site")
    (pages.parent / "mkdocs.yml").write_text(
        "site_name: x\nvalidation: {links: {not_found: warn}}\n"
    )
    (pages / "index.md").write_text("[nowhere](nowhere.md)\n")
    with pytest.raises(UserError, match="not built"):
        docs.build_site(tmp_path / "site")
    assert contents(tmp_path / "site") == before


@pytest.mark.parametrize("option", ["--csv", "--latex", "--markdown", "--html"])
@pytest.mark.parametrize("name", ["episodes.jsonl", "config.yaml", "thesis"])
def test_results_replace_no_file_of_another_kind(option: str, name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text("mine")
    with pytest.raises(UserError, match=f"{name} exists"):
        results.run(results._parser().parse_args(["--demo", option, str(tmp_path / name)]))
    assert (tmp_path / name).read_text() == "mine"


def test_a_board_replaces_no_records(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    records = tmp_path / "episodes.jsonl.xz"
    records.write_text("mine")
    with pytest.raises(SystemExit):
        board.main(["--html", str(records)], lambda: None, list)
    assert "episodes.jsonl.xz exists" in capsys.readouterr().err.replace("\n", " ")
    assert records.read_text() == "mine"


def test_an_earlier_output_and_a_device_are_written_again(tmp_path: Path) -> None:
    (tmp_path / "page.HTML").write_text("earlier")
    assert require_replaceable(tmp_path / "page.HTML", ".html") == tmp_path / "page.HTML"
    assert require_replaceable(tmp_path / "new", ".html") == tmp_path / "new"
    assert require_replaceable(Path("/dev/null"), ".html") == Path("/dev/null")
    with pytest.raises(UserError, match=r"is a folder: name a file, such as .*/NAME\.html\."):
        require_replaceable(tmp_path, ".html", ".htm")


def _results(path: Path) -> None:
    results._write({path: "page" * 1000})


def _analysis(path: Path) -> None:
    _save(SimpleNamespace(output=path), {"key": "value" * 1000})  # type: ignore[arg-type]


def _costs(path: Path) -> None:
    write_costs([ModelCost(*[1] * len(fields(ModelCost)))] * 100, path)  # type: ignore[arg-type]


@pytest.mark.usefixtures("capsys")  # in memory, which the limit leaves alone
@pytest.mark.parametrize(
    ("write", "name"), [(_results, "page.html"), (_analysis, "a.json"), (_costs, "costs.csv")]
)
def test_an_earlier_output_stays_where_the_disk_is_full(
    write: Callable[[Path], None], name: str, tmp_path: Path
) -> None:
    (tmp_path / name).write_text("earlier")
    with disk_of(1000), pytest.raises(OSError, match="too large"):
        write(tmp_path / name)
    assert (tmp_path / name).read_text() == "earlier"
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_a_pipe_stays_a_pipe(tmp_path: Path) -> None:
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    write_text(pipe, "page")
    assert (os.read(reader, 100), pipe.is_fifo()) == (b"page", True)
    os.close(reader)


def test_an_analysis_replaces_neither_other_files_nor_one_beside_its_output(tmp_path: Path) -> None:
    records, table = tmp_path / "episodes.jsonl", tmp_path / "figure.csv"
    records.write_text("mine")
    with pytest.raises(UserError, match=r"episodes\.jsonl exists"):
        _save(SimpleNamespace(output=records), {})  # type: ignore[arg-type]
    table.write_text("mine")
    with pytest.raises(UserError, match=r"figure\.csv exists"):
        _beside(tmp_path / "figure.svg", ".csv")
    (tmp_path / "figure.svg").write_text("earlier")
    assert _beside(tmp_path / "figure.svg", ".csv") == table


def test_a_tokenizer_of_a_checkpoint_is_not_replaced(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(train_tokenizer, "train_tokenizer", lambda lines: b"trained")
    (tmp_path / "tokenizer.model").write_bytes(b"mine")
    with pytest.raises(UserError, match="another tokenizer"):
        train_tokenizer.main([str(tmp_path)])
    assert (tmp_path / "tokenizer.model").read_bytes() == b"mine"
    for _ in range(2):
        train_tokenizer.main([str(tmp_path / "new")])
    assert (tmp_path / "new" / "tokenizer.model").read_bytes() == b"trained"


@pytest.mark.usefixtures("capsys")
def test_a_tokenizer_larger_than_the_disk_leaves_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(train_tokenizer, "train_tokenizer", lambda lines: b"trained" * 1000)
    with disk_of(1000), pytest.raises(OSError, match="too large"):
        train_tokenizer.main([str(tmp_path)])
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("split", "seeds"), [("test", r"seeds 520000 … 520099\."), ("ood", r"\(seed 16200000\)\.")]
)
def test_a_gallery_names_the_seeds_it_has_tried(
    monkeypatch: pytest.MonkeyPatch, split: str, seeds: str
) -> None:
    def fail(task: str, **options: object) -> None:
        raise SceneError("no place")

    monkeypatch.setattr(gallery, "make_task", fail)
    spec = metadata.episode("StopCube", split, 0)
    with pytest.raises(UserError, match=f"StopCube episode 0: no demonstration .* {seeds}"):
        gallery.demonstrated(spec)


def test_a_gallery_replaces_no_readme_but_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stop() -> None:
        raise RuntimeError("reached")

    monkeypatch.setattr(gallery, "require_simulator", stop)
    cfg = compose("show", ["tasks=StopCube", f"output={tmp_path}"])
    page = tmp_path / "README.md"
    page.write_text("# My project\n")
    with pytest.raises(UserError, match=r"README\.md exists"):
        gallery.main(cfg)
    assert page.read_text() == "# My project\n"
    page.write_text(
        gallery.render(
            "gallery.md", title="StopCube", entries=[("StopCube", "press", "StopCube.jpg")]
        )
    )
    with pytest.raises(RuntimeError, match="reached"):
        gallery.main(cfg)


def test_a_checkpoint_that_is_written_again_leaves_a_copy_beside_it_alone(tmp_path: Path) -> None:
    for name in ("step_000001", "step_000001.old", "draft"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "file").write_text(name)
    replace_folder(tmp_path / "draft", tmp_path / "step_000001")
    assert contents(tmp_path) == {
        "step_000001": None, "step_000001/file": b"draft",
        "step_000001.old": None, "step_000001.old/file": b"step_000001.old",
    }  # fmt: skip


def test_a_training_that_begins_anew_removes_drafts_alone(tmp_path: Path) -> None:
    drafts = tmp_path / "checkpoints"
    (drafts / ".step_000005.partial").mkdir(parents=True)
    (tmp_path / "metrics.jsonl").write_text(json.dumps({}))
    (drafts / "weights_of_mine").mkdir()
    _remove_drafts(tmp_path)
    assert [path.name for path in drafts.iterdir()] == ["weights_of_mine"]
    assert (tmp_path / "metrics.jsonl").is_file()
    (drafts / "weights_of_mine").rmdir()
    _remove_drafts(tmp_path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("output", "reason"),
    [("file.txt", "File exists"), ("file.txt/run", "Not a directory")],
)
def test_an_output_in_the_place_of_a_file_is_named(
    output: str, reason: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file.txt").write_text("mine")
    with pytest.raises(SystemExit), print_user_errors():
        (tmp_path / output).mkdir(parents=True, exist_ok=True)  # as Hydra makes a run's folder
    error = capsys.readouterr().err
    assert f"{output} cannot be written or opened: {reason}" in error and "choose another" in error
    assert (tmp_path / "file.txt").read_text() == "mine"
