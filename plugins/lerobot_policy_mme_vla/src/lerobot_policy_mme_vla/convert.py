"""`python -m lerobot_policy_mme_vla.convert SRC DST`: a checkpoint of mme-vla for LeRobot's
commands, and back.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path

from lerobot.configs import FeatureType, PolicyFeature

from lerobot_policy_mme_vla.configuration_mme_vla import STATE, MMEVLAConfig
from lerobot_policy_mme_vla.modeling_mme_vla import MMEVLAPolicy
from lerobot_policy_mme_vla.processor_mme_vla import make_mme_vla_pre_post_processors
from mme_vla import Policy
from mme_vla.cli.errors import print_user_errors
from mme_vla.embodiment import Embodiment
from mme_vla.embodiment.robomme import SIDE
from mme_vla.errors import UserError
from mme_vla.policy.saving import CONFIG, local_folder
from mme_vla.utils import Sums, inside, read_json


def for_lerobot(policy: Policy, device: str = "cpu") -> MMEVLAPolicy:
    """A policy of mme-vla as LeRobot's commands know it."""
    image_features, numbers = features_of(policy.embodiment)
    config = MMEVLAConfig(
        model=str(policy.config.get("name")),
        device=device,
        input_features=image_features,
        output_features=numbers,
    )
    return MMEVLAPolicy(config, model=policy).to(device).eval()


def features_of(robot: Embodiment) -> tuple[dict[str, PolicyFeature], dict[str, PolicyFeature]]:
    """The features that LeRobot lists for a robot's policy; images may have any size."""
    image_features = {
        camera.lerobot_key: PolicyFeature(FeatureType.VISUAL, (3, SIDE, SIDE))
        for camera in robot.cameras
    }
    state = PolicyFeature(FeatureType.STATE, (robot.state.width,))
    return {**image_features, STATE: state}, {
        "action": PolicyFeature(FeatureType.ACTION, (robot.action.width,))
    }


def convert(source: str, target: Path) -> None:
    """Write a checkpoint of the one kind as one of the other, into a new folder.

    Raises:
        UserError: the folder exists, or the source is neither.
    """
    if target.exists():
        raise UserError(f"{target} exists: give a new folder, nothing is ever written over.")
    folder = local_folder(source)
    Sums(folder).check(CONFIG)  # earlier folders of this plugin do not list it
    config = read_json(inside(folder, CONFIG), "a policy's configuration", limit=2**20)
    if config.get("type") == MMEVLAPolicy.name:
        MMEVLAPolicy.from_pretrained(folder).model.save_pretrained(target)
        return
    lerobot_policy = for_lerobot(Policy.from_pretrained(folder))
    lerobot_policy.save_pretrained(target)
    for pipeline in make_mme_vla_pre_post_processors(lerobot_policy.config):
        pipeline.save_pretrained(target)


def main(arguments: Sequence[str] | None = None) -> None:
    """Read the command line and convert."""
    parser = argparse.ArgumentParser(
        prog="python -m lerobot_policy_mme_vla.convert", description=__doc__
    )
    parser.add_argument(
        "source", help="checkpoint folder, or owner/name on the hub; of mme-vla, or of this plugin"
    )
    parser.add_argument("target", type=Path, help="new folder")
    args = parser.parse_args(arguments)
    with print_user_errors():
        convert(args.source, args.target)


if __name__ == "__main__":
    main()
