"""What a release has beside the code: metadata of the package, notices, and the workflow that
publishes it.
"""

import ast
import re
import shutil
from email import message_from_string
from email.message import Message
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import published
import pytest
import release_check
import yaml
from metadata_hook import with_addresses
from packaging.version import Version

from helpers import REPOSITORY
from helpers.published import published_folder

ASSETS = REPOSITORY / "mme_vla" / "assets"
ADDRESS = "https://example.com/owner/project"


@pytest.fixture(scope="module")
def metadata() -> Message:
    """The package's metadata, as its build writes them."""
    pytest.importorskip("hatchling", reason="the group dev has it")
    from hatchling.metadata.core import ProjectMetadata
    from hatchling.metadata.spec import construct_metadata_file_2_4
    from hatchling.plugin.manager import PluginManager

    project = ProjectMetadata(str(REPOSITORY), PluginManager())
    return message_from_string(construct_metadata_file_2_4(project))


def test_links_of_the_package_page_lead_to_files_of_the_released_version(metadata: Message) -> None:
    page = str(metadata.get_payload())
    source = (REPOSITORY / "README.md").read_text()
    targets = re.findall(r"\]\(([^)\s]+)\)", page)
    assert len(targets) == len(re.findall(r"\]\(([^)\s]+)\)", source)) > 50
    version = metadata["Version"]
    for target in targets:
        match = re.fullmatch(rf"https://[^/]+/[^/]+/[^/]+/(raw|blob)/v{version}/([^#]+).*", target)
        assert match is not None, target
        assert (REPOSITORY / match[2]).is_file()
        assert (match[1] == "raw") == match[2].endswith(".webp")


def test_the_package_page_shows_the_readme(metadata: Message) -> None:
    page = str(metadata.get_payload())
    assert metadata["Description-Content-Type"].startswith("text/markdown")
    source = (REPOSITORY / "README.md").read_text()
    without_links = re.compile(r"\]\([^)\s]+\)")
    assert without_links.sub("]", page).strip() == without_links.sub("]", source).strip()


def test_a_package_page_has_addresses_classifiers_and_a_public_version(metadata: Message) -> None:
    names = [line.partition(",")[0] for line in metadata.get_all("Project-URL")]
    assert names == ["Homepage", "Documentation", "Issues", "Changelog"]
    classifiers = metadata.get_all("Classifier")
    assert "Typing :: Typed" in classifiers and (REPOSITORY / "mme_vla" / "py.typed").is_file()
    oldest = metadata["Requires-Python"].removeprefix(">=")
    assert f"Programming Language :: Python :: {oldest}" in classifiers
    assert Version(metadata["Version"]).local is None
    assert set(metadata.get_all("License-File")) == {"LICENSE", "THIRD_PARTY.md"}


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("[a](b/c.md)", f"[a]({ADDRESS}/blob/v1/b/c.md)"),
        ("[a](b.md#part)", f"[a]({ADDRESS}/blob/v1/b.md#part)"),
        ("![a](b.png)", f"![a]({ADDRESS}/raw/v1/b.png)"),
        ("[![a](b.png)](c.md)", f"[![a]({ADDRESS}/raw/v1/b.png)]({ADDRESS}/blob/v1/c.md)"),
        ("[a](https://x.org) [b](#c)", "[a](https://x.org) [b](#c)"),
        ("```\n[a](b)\n```", "```\n[a](b)\n```"),
    ],
)
def test_relative_links_get_the_address_of_their_file(text: str, expected: str) -> None:
    assert with_addresses(text, ADDRESS, "v1") == expected


def test_every_asset_is_named_with_its_source() -> None:
    notices = (REPOSITORY / "THIRD_PARTY.md").read_text()
    index = (ASSETS / "README.md").read_text()
    for path in sorted(ASSETS.iterdir()):
        if path.name == "README.md":
            continue
        assert f"mme_vla/assets/{path.name}" in notices, f"THIRD_PARTY.md: {path.name}"
        assert f"`{path.name}`" in index, f"assets/README.md: {path.name}"
        if path.is_dir():
            text = (path / "README.md").read_text()
            assert re.search(r"^Source: |\| source \|", text, re.MULTILINE), path.name


def test_every_file_that_the_notices_name_exists() -> None:
    notices = (REPOSITORY / "THIRD_PARTY.md").read_text()
    rows = re.findall(r"^\| (`.*?) \|", notices, re.MULTILINE)
    for name in re.findall(r"`([\w./*{},-]+)`", " ".join(rows)):
        if "/" in name or (REPOSITORY / name).exists():
            options = re.search(r"\{(.*)\}", name)
            for option in options[1].split(",") if options else [""]:
                pattern = re.sub(r"\{.*\}", option, name)
                assert list(REPOSITORY.glob(pattern)), name


def test_a_release_needs_its_version_a_dated_change_log_and_its_own_address(tmp_path: Path) -> None:
    for name in ("pyproject.toml", "CHANGELOG.md"):
        shutil.copy(REPOSITORY / name, tmp_path)
    version = re.search(r'^version = "(.*)"', (tmp_path / "pyproject.toml").read_text(), re.M)
    assert version is not None
    messages = release_check.problems("v9.9.9", ADDRESS, tmp_path)
    assert len(messages) == 3

    file = tmp_path / "pyproject.toml"
    text = re.sub(r'^repository = ".*"', f'repository = "{ADDRESS}"', file.read_text(), flags=re.M)
    file.write_text(text)
    (tmp_path / "CHANGELOG.md").write_text(f"# Changes\n\n## {version[1]} (2026-12-24)\n")
    assert release_check.problems(f"v{version[1]}", ADDRESS, tmp_path) == []


def test_the_release_workflow_checks_before_it_publishes_without_a_stored_key() -> None:
    workflow = yaml.safe_load((REPOSITORY / ".github/workflows/release.yml").read_text())
    build, publish = workflow["jobs"]["build"], workflow["jobs"]["publish"]
    commands = [step["run"] for step in build["steps"] if "run" in step]
    places = [
        next(i for i, command in enumerate(commands) if word in command)
        for word in ("release_check.py", "uv build", "twine check")
    ]
    assert places == sorted(places)
    assert publish["needs"] == "build" and publish["permissions"] == {"id-token": "write"}
    for job in (build, publish):
        assert job["timeout-minutes"] <= 30
        for step in job["steps"]:
            assert re.fullmatch(r"[\w/-]+@v\d+\.\d+\.\d+", step.get("uses", "a/b@v1.0.0"))
            assert "secrets." not in str(step)


@pytest.mark.parametrize("form", ["bug", "question", "feature"])
def test_forms_of_issues_are_complete(form: str) -> None:
    content = yaml.safe_load((REPOSITORY / f".github/ISSUE_TEMPLATE/{form}.yml").read_text())
    assert {"name", "description", "body"} <= set(content)
    fields = [entry for entry in content["body"] if entry["type"] != "markdown"]
    assert all(entry["attributes"]["label"] for entry in fields)
    assert len({entry["id"] for entry in fields}) == len(fields)
    assert any(entry.get("validations", {}).get("required") for entry in fields)


def test_the_published_results_are_those_of_the_index() -> None:
    assert published.INDEX.read_text() == published.sums()
    index = (published.RESULTS / "README.md").read_text()
    files = {path.name for path in published.RESULTS.iterdir()} - {"README.md", "SHA256SUMS"}
    archives = {path.name for path in published.ARCHIVES.values()}
    assert files <= archives | {"stress_dials.csv", "compatibility.csv"}
    assert all(f"`{name}`" in index for name in published.ARCHIVES)


def test_the_index_says_what_each_archive_holds() -> None:
    index = (published.RESULTS / "README.md").read_text()
    for name in published.ARCHIVES:
        files = [file for file in published_folder(name).rglob("*") if file.is_file()]
        row = re.search(rf"^\| `{re.escape(name)}` \|.*\| (\d+) \|", index, re.MULTILINE)
        assert row is not None and int(row[1]) == len(files), name


def test_a_packed_folder_unpacks_to_the_same_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "rows" / "a").mkdir(parents=True)
    (tmp_path / "rows" / "a" / "episodes.jsonl.xz").write_bytes(bytes(range(256)))
    (tmp_path / "rows" / "scenes.json").write_text("{}")
    archive = tmp_path / "ood.tar.xz"
    monkeypatch.setitem(published.ARCHIVES, "ood", archive)
    published.pack(tmp_path / "rows", archive)
    folder = published.unpack("ood", tmp_path / "out")
    assert (folder / "a" / "episodes.jsonl.xz").read_bytes() == bytes(range(256))
    assert (folder / "scenes.json").read_text() == "{}"


def test_the_readme_of_the_benchmarks_names_every_script() -> None:
    text = (REPOSITORY / "benchmarks" / "README.md").read_text()
    scripts = re.findall(r"^\| `(\w+\.py)` \|", text, re.MULTILINE)
    assert sorted(scripts) == sorted(p.name for p in (REPOSITORY / "benchmarks").glob("*.py"))


@pytest.mark.slow
def test_benchmarks_import_what_the_library_has() -> None:
    missing = []
    for script in sorted((REPOSITORY / "benchmarks").glob("*.py")):
        for node in ast.walk(ast.parse(script.read_text())):
            if not isinstance(node, ast.ImportFrom) or not str(node.module).startswith("mme_vla"):
                continue
            module = import_module(str(node.module))
            for name in (alias.name for alias in node.names):
                if not hasattr(module, name) and find_spec(f"{node.module}.{name}") is None:
                    missing.append(f"{script.name}: {node.module}.{name}")
    assert not missing
