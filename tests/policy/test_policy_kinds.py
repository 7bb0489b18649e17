"""Policies of any kind: names in a configuration, recipes beyond the released one, statistics with
extremes.
"""

from typing import Any

import numpy as np
import pytest

from mme_vla import MMEPolicy, Policy, UserError, build_policy, register
from mme_vla.embodiment import ROBOMME_JOINT
from mme_vla.evaluation.rollout.running import RenderPlan
from mme_vla.evaluation.rollout.settings import RolloutSettings
from mme_vla.policy.network import NetworkPolicy
from mme_vla.policy.saving import composition_digest, policy_class, policy_options
from mme_vla.training.settings import TrainSettings


@register("policy", "quiet")
class QuietPolicy(MMEPolicy):
    """A kind of policy of one's own."""


def test_the_section_policy_says_which_class_is_built() -> None:
    built = build_policy("pi05", policy={"name": "quiet"})
    assert type(built) is QuietPolicy
    assert type(build_policy("pi05")) is MMEPolicy
    assert policy_class({}) is policy_class({"policy": {"compute_dtype": "float32"}}) is MMEPolicy
    for name in ("dreaming", 5, None):
        with pytest.raises(UserError, match="Unknown policy"):
            policy_class({"policy": {"name": name}})


@register("policy", "keeping")
class KeepingPolicy(MMEPolicy):
    """A kind of policy with an option of its own beside those of its parent."""

    def __init__(self, *parts: Any, keep: int = 1, **options: Any) -> None:
        super().__init__(*parts, **options)
        self.keep = keep


def test_a_subclass_takes_the_options_of_its_parents() -> None:
    custom = build_policy("pi05", policy={"name": "keeping", "augment": False})
    assert isinstance(custom, KeepingPolicy) and (custom.augment, custom.keep) == (False, 1)
    with pytest.raises(UserError, match=r"policy has no key 'augmnt'\. Did you mean 'augment'"):
        policy_options(KeepingPolicy, {"policy": {"augmnt": False}})
    assert policy_options(KeepingPolicy, {"policy": {"keep": 3, "augment": False}}) == {
        "keep": 3,
        "augment": False,
    }


def test_a_kind_comes_back_as_what_it_was(tmp_path: Any) -> None:
    build_policy("pi05", policy={"name": "quiet"}).save_pretrained(tmp_path)
    assert (
        type(Policy.from_pretrained(tmp_path))
        is type(MMEPolicy.from_pretrained(tmp_path))
        is QuietPolicy
    )


class Memoryless(NetworkPolicy):
    """A network of its own, without a memory."""

    memory = None
    embodiment = ROBOMME_JOINT


def test_without_a_memory_only_the_frames_of_decisions_are_rendered() -> None:
    policy = Memoryless()
    read = policy.frames_read(np.arange(5), 0)
    assert read is not None and not len(read)
    request = RenderPlan(policy, None, RolloutSettings()).before_video()
    assert request is not None and not any(7 in frames for frames in request.frames.values())


def test_the_default_kind_changes_no_digest_and_another_does() -> None:
    robot = ROBOMME_JOINT.to_dict()
    config = {"backbone": {"name": "pi05"}, "memory": None, "embodiment": robot}
    named = {**config, "policy": {"name": "mme", "compute_dtype": "float32"}}
    assert composition_digest(config) == composition_digest(named)
    assert composition_digest(config) != composition_digest({**config, "policy": {"name": "quiet"}})


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({"schedule": "linear"}, "train.schedule='linear'. Known: constant, cosine, steps"),
        ({"schedule_steps": 5}, "train.schedule_steps=5 must be no fewer than train.warmup=10"),
        ({"milestones": (30, 20)}, "ascending order"),
        ({"milestones": (20, 30)}, "milestones belong to schedule=steps"),
        ({"schedule": "steps"}, "schedule=steps, which needs at least one"),
        ({"gamma": 0}, "train.gamma=0"),
    ],
)
def test_recipes_that_cannot_be(values: dict[str, Any], says: str) -> None:
    with pytest.raises(UserError, match=says):
        TrainSettings.from_dict({"steps": 100, "batch_size": 1, "lr": 1.0, "warmup": 10, **values})
