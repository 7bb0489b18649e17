"""A policy that plays: loaded here (`checkpoint=…`), or computed by a server (`server=…`)."""

import logging
from typing import Any

import numpy as np
from omegaconf import DictConfig

from mme_vla.cli.evaluate import choose_subgoals
from mme_vla.cli.loading import PolicyChoice, load_policy, release
from mme_vla.config.devices import process_device
from mme_vla.embodiment.robomme import SIDE, benchmark_action
from mme_vla.envs.base import CHOICES, environment
from mme_vla.envs.vector.pool import Job
from mme_vla.errors import require
from mme_vla.evaluation.records import RunKey
from mme_vla.evaluation.rollout.environment import OPTIONS, Frames, Report
from mme_vla.evaluation.rollout.evaluation import facts_of, run_settings
from mme_vla.evaluation.rollout.running import RunningEpisode
from mme_vla.evaluation.rollout.settings import RolloutSettings
from mme_vla.extras.play.game import ChoiceSession
from mme_vla.extras.play.players import NoChoiceError, Player
from mme_vla.policy.base import Policy
from mme_vla.policy.build import policy_config
from mme_vla.utils import safe_name

logger = logging.getLogger("mme_vla.play")


class PolicyPlayer(Player):
    """Plays what a policy chooses, from the same observations and noise as in an evaluation.

    Args:
        policy: in eval mode, of a robot that chooses among options.
        model: name of its records.
        seed: of its noise.
    """

    def __init__(self, policy: Policy, model: str, seed: int) -> None:
        self.max_choices = policy.info.max_actions  # alone, as in an evaluation
        self.policy = policy
        self.model = model
        self.seed = seed
        self._running: RunningEpisode | None = None
        self._frames = Frames(policy.embodiment)
        self._actions: list[np.ndarray] = []
        """Actions of the chunk that are still to be executed."""
        self._n_executed = 0  # actions of the latest chunk

    def start(self, session: ChoiceSession) -> None:
        self._end_episode()
        which = session.episode
        job = Job(which.task, which.split, which.episode)
        self._running = RunningEpisode(self.policy, job, self.seed)
        self._frames = Frames(self.policy.embodiment)
        self._actions = []
        self._n_executed = 0

    def choose(self, session: ChoiceSession) -> tuple[dict[str, Any], dict[str, Any]]:
        running = self._running
        assert running is not None
        space = self.policy.embodiment.action
        self._frames.add(session.observation)
        if not self._actions:
            # The policy reads the frames since its last chunk, and chooses the next one.
            frames = self._frames.observation()
            self._frames = Frames(self.policy.embodiment)
            report = Report(
                goal=session.goal,
                options=session.info.get(OPTIONS),
                executed=self._n_executed,
                frames=len(frames["state"]),
            )
            running.take_report(report)
            if running.chunks == 0:
                running.begin(frames)
            else:
                running.resume(frames)
            running.read()
            while running.pieces:
                running.read()
            chunk = self.policy.act(running.episode)
            failure = running.episode.failure
            if failure is not None:
                raise NoChoiceError("error", failure.reason)
            running.set_actions(chunk[: space.execute])
            self._actions = list(chunk[: space.execute])
            self._n_executed = len(self._actions)
        action = benchmark_action(space, self._actions.pop(0))
        assert isinstance(action, dict)
        point = [min(value, SIDE - 1) for value in action["point"]]  # a share of 1 is the last
        return {"choice": action["choice"], "point": point}, {}

    def close(self) -> None:
        self._end_episode()
        release(self.policy)

    def _end_episode(self) -> None:
        """Free what the policy holds of an episode, such as a connection."""
        if self._running is not None:
            self._running.episode.close()


def load_player(
    cfg: DictConfig, max_steps: int, max_choices: int | None
) -> tuple[PolicyPlayer, RunKey, dict[str, Any]]:
    """The policy of `checkpoint=…` or `server=…` as a player, what its records say of it, and what
    decides its choices.
    """
    config = policy_config(cfg)
    choice = PolicyChoice.from_config({**config, "name": "policy"})
    policy, name, place = load_policy(choice, "play", logger, process_device(choice.device))
    try:
        robot = policy.embodiment
        require(
            robot.action.space == CHOICES,
            f"{name} acts by {robot.action.answers or robot.name}, and play offers choices"
            f" ({CHOICES}): evaluate it on the same episodes, mme-vla evaluate … video=all.",
        )
        limits = {"max_steps": max_steps, "max_actions": max_choices}
        settings = RolloutSettings.from_config({**config, **limits})
        environment(settings.env).check_embodiment(robot)
        choose_subgoals(policy, None)  # none is given here, of which a policy that reads them warns
        facts = facts_of(policy, name, place, settings, None)
        safe_name(facts.model, "the policy's name")  # it names a folder
        decisive = run_settings(policy, facts, settings, None, place)
    except BaseException:
        release(policy)
        raise
    return PolicyPlayer(policy.eval(), facts.model, settings.seed), facts, decisive
