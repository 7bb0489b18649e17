"""Sessions before one's own: `split=stress:sessions=2` shows recorded episodes first, in the same memory."""

from collections.abc import Sequence

from mme_vla.envs.variants import SESSIONS, read_variant
from mme_vla.errors import UserError
from mme_vla.evaluation.probe.arms import lacking, read_arm
from mme_vla.evaluation.probe.channels import channel_of
from mme_vla.evaluation.probe.probed import ProbedPolicy
from mme_vla.evaluation.probe.recordings import Recording
from mme_vla.policy.base import Policy


def with_sessions(policy: Policy, split: str, recordings: Sequence[Recording]) -> Policy:
    """The policy as a split evaluates it: where that asks for sessions before each episode, it sees them first.

    They are the first of the recordings, the same before every episode, and seem to be part of its video.

    Args:
        recordings: episodes to show.

    Raises:
        UserError: the split asks for more than there are, or the policy cannot be shown recorded episodes; or there are
            recordings and the split asks for none.
    """
    variant = read_variant(split)
    if variant is None or variant.dial != SESSIONS:
        if recordings:
            raise UserError(f"recordings=…: split={split} shows none; they are for split=stress:sessions=<n>.")
        return policy
    if not variant.sessions:
        return policy
    arm = read_arm(f"distract:{variant.sessions}")
    if why := lacking(arm, policy, channel_of(policy), len(recordings), boundaries=False):
        raise UserError(f"split={split} needs {why}.")
    shown = ProbedPolicy(policy, arm, recordings, of_split=True).eval()
    shown.config["sessions"] = [recording.name for recording in shown.sessions]
    return shown
