"""`python -m mme_vla.serve` says at its start whether the policy is what it was."""

from pathlib import Path

import pytest

from helpers.trainings import policy
from mme_vla import MMEPolicy, UserError
from mme_vla.cli import serve
from mme_vla.config.composition import compose
from mme_vla.policy.saving import save_policy
from mme_vla.policy.self_check import NO_CHECK, compare, record_self_check
from mme_vla.serving.server import PolicyServer


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> list[PolicyServer]:
    """Servers that the command would have run."""
    servers: list[PolicyServer] = []

    async def run(server: PolicyServer) -> None:
        servers.append(server)

    monkeypatch.setattr(serve, "run", run)
    return servers


def test_the_start_compares_the_policy_with_its_self_check(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], started: list[PolicyServer]
) -> None:
    def line() -> str:
        serve.main(compose("serve", [f"checkpoint={tmp_path}", "device=cpu"]))
        [text] = [text for text in capsys.readouterr().err.splitlines() if "self-check" in text]
        return text

    built = policy("framesamp_modul")
    built.save_pretrained(tmp_path)
    assert line().endswith(NO_CHECK)

    check = record_self_check(built)
    save_policy(built, tmp_path, self_check=check)
    assert "self-check: passed" in line()

    save_policy(policy("framesamp_modul", seed=5), tmp_path, self_check=check)
    assert "self-check: FAILED" in line()
    assert len(started) == 3, "a difference is reported, and the policy is served"


def test_a_policy_that_fails_its_self_check_with_an_error_is_served_with_a_warning(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    started: list[PolicyServer],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    built = policy()
    save_policy(built, tmp_path, self_check=record_self_check(built))

    def fail(*arguments: object) -> None:
        raise RuntimeError("not implemented\nfor 'BFloat16'")

    monkeypatch.setattr(MMEPolicy, "predict_chunk", fail)
    serve.main(compose("serve", [f"checkpoint={tmp_path}", "device=cpu"]))
    output = capsys.readouterr().err
    assert len(started) == 1 and "Traceback" not in output
    [line] = [text for text in output.splitlines() if "self-check" in text]
    assert "not done" in line and "RuntimeError: not implemented" in line and "BFloat16" in line
    # The comparison alone is an error of its command.
    with pytest.raises(UserError, match="self-check: not done"):
        compare(MMEPolicy.from_pretrained(tmp_path), tmp_path)
