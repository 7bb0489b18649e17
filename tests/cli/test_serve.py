"""`python -m mme_vla.serve` says at its start whether the policy is what it was."""

from pathlib import Path

import pytest

from helpers.trainings import policy
from mme_vla.cli import serve
from mme_vla.config.composition import compose
from mme_vla.policy.saving import save_policy
from mme_vla.policy.self_check import NO_CHECK, record_self_check
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
