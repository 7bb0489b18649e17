"""The page of public names says what the docstrings say."""

import importlib.util

import pytest

from helpers import REPOSITORY


@pytest.fixture(scope="module")
def script():
    pytest.importorskip("gymnasium", reason="the environments' signatures: uv sync --inexact --extra sim")
    spec = importlib.util.spec_from_file_location("api", REPOSITORY / "docs" / "api.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_page_is_what_the_docstrings_say(script):
    assert script.PAGE.read_text() == script.page(), "run: python docs/api.py"


def test_every_public_name_and_method_says_what_it_does(script):
    import mme_vla

    bare = [name for names in script.GROUPS.values() for name in names if not script.text_of(getattr(mme_vla, name))]
    assert bare == []
