"""Tables of parts: names that ship with the library are not taken by others."""

import importlib
import runpy
import subprocess
import sys
from pathlib import Path

import pytest

from helpers import REPOSITORY
from mme_vla import UserError, build_policy, register
from mme_vla.memory.base import Memory
from mme_vla.registry import REGISTRIES, Registry


def test_a_name_that_ships_is_not_taken_before_it_is_used() -> None:
    """In a fresh process, in which nothing has been imported yet."""
    script = "import mme_vla\nmme_vla.register('memory', 'framesamp')(type('Mine', (), {}))"
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, timeout=120
    )
    assert (
        "UserError: memory 'framesamp' ships with the library (mme_vla.memory.framesamp)"
        in done.stderr
    )


def test_a_name_is_taken_once() -> None:
    with pytest.raises(UserError, match=r"ships with the library|already registered"):
        register("memory", "tokendrop")(type("Mine", (), {}))


def test_a_class_of_the_same_name_in_another_module_replaces_the_first_with_a_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = (
        "from mme_vla import register\n@register('reward', 'of_mine')\nclass Mine: 'one of two'\n"
    )
    for name in ("first_rewards", "second_rewards"):
        (tmp_path / f"{name}.py").write_text(source)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(REGISTRIES["reward"], "_entries", {})
    first = importlib.import_module("first_rewards")
    with pytest.warns(UserWarning, match="'of_mine' of second_rewards replaces that of first_rew"):
        importlib.import_module("second_rewards")
    monkeypatch.setattr(REGISTRIES["reward"], "_entries", {"of_mine": first.Mine})
    importlib.reload(first)
    runpy.run_path(str(tmp_path / "first_rewards.py"), run_name="__main__")


class Base:
    def __init__(self, grid: int = 8) -> None:
        if grid < 0:
            raise TypeError("negative")


class Named(Base):
    def __init__(self, budget: int = 4, **options: int) -> None:
        super().__init__(**options)


def test_an_option_that_is_passed_on_is_named_where_no_constructor_takes_it() -> None:
    parts: Registry[type] = Registry("part")
    parts.register("named")(Named)
    with pytest.raises(
        UserError, match=r"part 'named' does not take these options: gird=4 .*Did you mean 'grid'"
    ):
        parts.build({"name": "named", "gird": 4})
    with pytest.raises(TypeError, match="negative"):
        parts.build({"name": "named", "grid": -1})


def test_an_error_says_that_leftover_options_are_of_the_file() -> None:
    @register("memory", "only_budget")
    class OnlyBudget(Memory):
        def __init__(self, d_vision: int, width: int, budget: int = 4) -> None:
            super().__init__()

    with pytest.raises(UserError, match=r"is of the section's file.* memory=….*~memory\."):
        build_policy("framesamp_modul", device="meta", memory={"name": "only_budget"})


def test_an_option_of_a_class_that_has_no_file_is_added() -> None:
    with pytest.raises(UserError, match=r"'memory\.depth'.* is added with \+memory\.depth=…"):
        build_policy("framesamp_modul", memory={"name": "only_budget", "depth": 3})
    with pytest.raises(UserError, match="Unknown memory 'absent'"):
        build_policy("framesamp_modul", memory={"name": "absent"}, **{"+memory.depth": 3})


@pytest.mark.parametrize("section", [[["name", "dot"]], ["name"], "dot", 3, None])
def test_a_section_that_is_no_mapping_is_refused(section: object) -> None:
    shapes: Registry[object] = Registry("shape")
    with pytest.raises(UserError, match="section of the shape must be a section of keys"):
        shapes.build(section)  # type: ignore[arg-type]


def test_the_page_on_methods_lists_all_kinds_of_parts() -> None:
    page = (REPOSITORY / "docs" / "extend" / "add-a-method.md").read_text()
    (line,) = (line for line in page.splitlines() if line.startswith("Keys of `parts`"))
    assert [kind for kind in REGISTRIES if f"`{kind}`" not in line] == []
