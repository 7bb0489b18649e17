"""Messages of `UserError`."""

from pathlib import Path

import pytest

from mme_vla import errors
from mme_vla.errors import LONG, UserError, did_you_mean, missing_extra


def test_the_middle_of_an_overlong_message_is_left_out() -> None:
    message = str(UserError(f"split={'x' * 100_000} is unknown. Choose test."))
    assert len(message) <= UserError.LONGEST
    assert message.startswith("split=xxx") and message.endswith("is unknown. Choose test.")


def test_a_message_of_usual_length_stays_as_it_is() -> None:
    assert str(UserError("budget=0 must be at least 1.")) == "budget=0 must be at least 1."


def test_a_missing_extra_is_installed_with_the_commands_of_the_clone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(errors, "CONSTRAINTS", tmp_path / "constraints.txt")
    errors.CONSTRAINTS.touch()
    message = str(missing_extra("The simulator", "sim"))
    assert message.startswith("The simulator needs the extra `sim`. In the clone: uv sync")
    assert "--inexact --extra sim " in message
    assert "pip install -c constraints.txt -e '.[sim]'" in message


def test_a_missing_extra_of_the_installed_wheel_is_installed_by_the_name_of_the_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(errors, "CONSTRAINTS", tmp_path / "constraints.txt")
    assert str(missing_extra("The simulator", "sim")) == (
        "The simulator needs the extra `sim`. With pip: pip install 'mme-vla[sim]'"
        " (with uv: uv pip install 'mme-vla[sim]')."
    )


def test_a_long_list_of_names_is_left_to_a_command_where_one_is_near() -> None:
    names = [f"model_{number}x" for number in range(LONG)]
    assert did_you_mean("model_3", names, "--help model").endswith(
        f"Known: {', '.join(sorted(names))}."
    )
    names.append("framesamp")
    guess = did_you_mean("framesmp", names, "--help model")
    assert guess == "Did you mean 'framesamp'? `--help model` lists all 21."
    assert "Known: framesamp, model_0x" in did_you_mean("pi", names, "--help model")
    assert "Known: framesamp, model_0x" in did_you_mean("framesmp", names)
