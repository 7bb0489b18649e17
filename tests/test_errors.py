"""Messages of `UserError`."""

from mme_vla.errors import UserError


def test_the_middle_of_an_overlong_message_is_left_out() -> None:
    message = str(UserError(f"split={'x' * 100_000} is unknown. Choose test."))
    assert len(message) <= UserError.LONGEST
    assert message.startswith("split=xxx") and message.endswith("is unknown. Choose test.")


def test_a_message_of_usual_length_stays_as_it_is() -> None:
    assert str(UserError("budget=0 must be at least 1.")) == "budget=0 must be at least 1."
