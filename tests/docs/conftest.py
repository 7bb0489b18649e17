"""The site, built once."""

from pathlib import Path

import pytest

from helpers import commands


@pytest.fixture(scope="session")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, built by the command, which stops at a warning."""
    pytest.importorskip("material", reason="the extra `docs` is not installed")
    pytest.importorskip("mkdocstrings", reason="the extra `docs` is not installed")
    folder = tmp_path_factory.mktemp("docs") / "site"
    done = commands.run("mme_vla", "docs", "--build", "--output", str(folder))
    assert done.returncode == 0, done.stderr
    assert "WARNING" not in done.stderr
    assert done.stdout.startswith("Building the site")
    assert str(folder / "index.html") in done.stdout
    return folder
