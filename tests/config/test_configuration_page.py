"""Every configuration key is explained where it stands, and the page in docs/ says the same."""

import importlib.util

import pytest

from helpers import REPOSITORY


@pytest.fixture(scope="module")
def script():
    spec = importlib.util.spec_from_file_location("configuration", REPOSITORY / "docs" / "configuration.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_page_is_what_the_files_say(script):
    assert script.PAGE.read_text() == script.page(), "run: python docs/configuration.py"


def test_every_key_has_a_comment_in_one_file_of_its_group(script):
    """A group's other files may repeat a key without explaining it again."""
    unexplained = []
    for folder in [script.CONFIGS, *(f for f in script.CONFIGS.iterdir() if f.is_dir() and f.name != "model")]:
        files = sorted(folder.glob("*.yaml"))
        groups = [[file] for file in files] if folder == script.CONFIGS else [files]
        for group in groups:
            rows = [(file, key.name, key.default, key.comment) for file in group for key in script.keys(file)]
            explained = {key for _, key, _, comment in rows if comment}
            covered = explained | {
                key for _, key, _, _ in rows if any(other.startswith(f"{key}.") for other in explained)
            }
            unexplained += [f"{file.name}: {key}" for file, key, _, _ in rows if key not in covered]
    assert sorted(set(unexplained)) == []
