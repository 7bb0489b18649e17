"""What scenes of MIKASA-Robo-VLA need beside its package, and where it belongs."""

import os
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path

from mme_vla.errors import missing_extra, require
from mme_vla.extras.mikasa.catalog import BULB, FAMILY_OF, YCB

PACKAGE = "mikasa_robo_suite"
_PIP = " colorama, then pip install --no-deps --ignore-requires-python mikasa-robo-suite==1.0.0"
_BULB = Path("vla", "utils", "objects", "low_poly_light_bulb.glb")
_YCB = Path("data", "assets", "mani_skill2_ycb", "info_pick_v0.json")


def check_package() -> None:
    """Refuse to continue without the benchmark's package and the simulator."""
    for package in (PACKAGE, "mani_skill"):
        if find_spec(package) is None:
            raise missing_extra("MIKASA-Robo-VLA", "mikasa", pip=("sim", _PIP))


def bulb_file() -> Path:
    """Where the package looks for the model of its lamps, which its wheel lacks."""
    check_package()
    spec = find_spec(PACKAGE)
    assert spec is not None and spec.submodule_search_locations
    return Path(next(iter(spec.submodule_search_locations))) / _BULB


def ycb_file() -> Path:
    """A file of the YCB models where ManiSkill keeps what it downloads."""
    root = Path(os.environ.get("MS_ASSET_DIR") or Path.home() / ".maniskill")
    return root.expanduser() / _YCB


def are_there(needs: Sequence[str]) -> bool:
    """Whether all that tasks need is on this machine."""
    if BULB in needs and not (find_spec(PACKAGE) is not None and bulb_file().is_file()):
        return False
    return YCB not in needs or ycb_file().is_file()


def check_assets(task: str) -> None:
    """Refuse a task whose models are not on this machine, and say where they come from."""
    needs = FAMILY_OF[task].needs
    if BULB in needs:
        file = bulb_file()
        require(
            file.is_file(),
            f"{task} needs {file.name}, the model of its lamps, which the package"
            " mikasa-robo-suite lacks. It is in the repository"
            " github.com/CognitiveAISystems/MIKASA-Robo, below mikasa_robo_suite/vla/utils/objects"
            f" (CC BY 4.0). Copy it to {file.parent}.",
        )
    if YCB in needs:
        file = ycb_file()
        require(
            file.is_file(),
            f"{task} needs ManiSkill's YCB models, which are not in {file.parent}. Download them:"
            " python -m mani_skill.utils.download_asset ycb",
        )
