"""The launchers of the extra `sweep` run the jobs of a sweep as processes of this machine."""

from pathlib import Path

import pytest
from hydra.errors import MissingConfigException

from helpers import commands
from mme_vla.config.override_errors import ConfigTree

TINY = (
    "backbone=tiny",
    "backbone.vision.depth=1",
    "backbone.vision.image_size=16",
    "backbone.vision.patch_size=1",
)


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("launcher", "package", "words"),
    [
        ("joblib", "hydra_joblib_launcher", ()), ("submitit_local", "hydra_submitit_launcher", ()),
        ("ray", "hydra_ray_launcher", ("+hydra.launcher.ray.init.num_cpus=1",)),
    ],
)  # fmt: skip
def test_a_launcher_runs_every_job_of_a_sweep(
    launcher: str, package: str, words: tuple[str, ...], tmp_path: Path
) -> None:
    pytest.importorskip(
        f"hydra_plugins.{package}", reason="launchers: uv sync --inexact --extra sweep"
    )
    done = commands.run(
        "mme_vla.probe",
        "--multirun",
        f"launcher={launcher}",
        *words,
        "seed=7,42",
        "model=framesamp_modul",
        *TINY,
        "recordings=sample",
        "recorded=1",
        "with=[shuffle]",
        "draws=2",
        "moments=1",
        "scan=false",
        f"output={tmp_path}/${{seed}}",
        f"hydra.sweep.dir={tmp_path}/sweep",
    )
    assert done.returncode == 0, done.stderr[-3000:]
    probed = {
        seed: sorted(file.name for file in (tmp_path / seed).iterdir()) for seed in ("7", "42")
    }
    assert "table.md" in probed["7"] and probed["7"] == probed["42"]


def test_a_launcher_that_is_not_installed_names_its_extra() -> None:
    missing = MissingConfigException(
        "Could not find 'hydra/launcher/joblib'", missing_cfg_file="hydra/launcher/joblib"
    )
    explained = ConfigTree.explain(None, missing)  # type: ignore[arg-type]
    assert "launcher=joblib" in explained and "extra `sweep`" in explained
