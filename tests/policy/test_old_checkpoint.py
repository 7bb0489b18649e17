"""A checkpoint written before the folders were rearranged loads and acts as it did then; its
training cannot be continued.
"""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from data.earlier_layout.make import actions
from helpers import REPOSITORY
from mme_vla import MMEPolicy
from mme_vla.config.composition import compose, resolved
from mme_vla.errors import UserError
from mme_vla.training.runs import open_run

FOLDER = REPOSITORY / "tests" / "data" / "earlier_layout"
STEP = Path("checkpoints") / "step_000002"
EXPECTED = json.loads((FOLDER / "expected.json").read_text())


def test_it_loads_and_chooses_the_same_actions() -> None:
    policy = MMEPolicy.from_pretrained(FOLDER / "run" / STEP)
    assert policy.embodiment.name == "robomme_joint", "what checkpoints that name no robot are for"
    np.testing.assert_allclose(actions(policy, ("front", "wrist")), EXPECTED["actions"], atol=2e-5)


def test_its_training_is_refused_with_the_settings_that_it_does_not_name(tmp_path: Path) -> None:
    run = tmp_path / "run"
    shutil.copytree(FOLDER / "run", run)
    now = resolved(compose("train", ["model=framesamp_modul", "train.steps=4"]))
    with pytest.raises(
        UserError, match=r"(?s)was trained with other settings.*init_from="
    ) as refused:
        open_run(tmp_path / "new", str(run), now)
    assert str(run / STEP) in str(refused.value)
