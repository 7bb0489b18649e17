"""The simulator, for tests of MIKASA-Robo-VLA's scenes."""

from collections.abc import Iterator

import pytest

from mme_vla.envs import base


@pytest.fixture
def simulator() -> Iterator[None]:
    pytest.importorskip("mani_skill", reason="the simulator is not installed: the extra `sim`")
    pytest.importorskip(
        "mikasa_robo_suite", reason="MIKASA-Robo-VLA is not installed: the extra `mikasa`"
    )
    yield
    while base._idle:
        base._idle.popitem()[1].close()
