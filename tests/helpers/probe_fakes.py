"""Recorded episodes synthetic on the spot, and policies that are known to read one
slot, or none.
"""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from helpers.rollout_fakes import InlineEnvs, quick_policy, roll
from helpers.scripted_env import make_moving_env
from mme_vla.embodiment import ROBOMME_JOINT, Embodiment, Option
from mme_vla.envs import Job
from mme_vla.extras.probing.arms import Arm, read_arm, read_arms
from mme_vla.extras.probing.lines import Line
from mme_vla.extras.probing.offline import probe_offline
from mme_vla.extras.probing.probed import ProbedPolicy
from mme_vla.extras.probing.recordings import Recording
from mme_vla.extras.probing.settings import OfflineSettings
from mme_vla.policy.mme import MMEPolicy

SIDE = 64


class MadeUpSource:
    """What a probe asks of a dataset: every frame's brightness is its episode's and
    its number's.
    """

    subgoal_names = ("simple_subgoal",)
    name = fingerprint = "made-up"

    def __init__(
        self,
        lengths: tuple[int, ...] = (60, 70, 80),
        video: int = 20,
        robot: Embodiment = ROBOMME_JOINT,
    ):
        self.lengths, self.exec_starts = np.array(lengths), np.full(len(lengths), video)
        self.robot, self.frames_read = robot, []

    def __len__(self) -> int:
        return len(self.lengths)

    def task(self, episode: int) -> str:
        return "VideoUnmask"

    def goal(self, episode: int, frame: int | None = None) -> str:
        return f"pick up the cube number {episode}"

    def options(self, episode: int) -> tuple[Option, ...]:
        offered = Option("a", f"pick up cube {episode}", True), Option("c", "drop it")
        return offered if self.robot.action.choice else ()

    def action_chunk(
        self, episode: int, start: int, horizon: int, offset: int = 0
    ) -> tuple[np.ndarray, np.ndarray]:
        """Zeros, known up to the episode's end."""
        chunk = np.zeros((horizon, self.robot.action.width), np.float32)
        return chunk, start + offset + np.arange(horizon) < self.lengths[episode]

    def past_actions(self, episode: int, start: int, most: int, offset: int = 0) -> np.ndarray:
        """One motion a frame of the execution, all of its numbers that frame's."""
        frames = np.arange(self.exec_starts[episode], max(start, self.exec_starts[episode]))
        return np.repeat(frames[-most:, None], self.robot.action.width, 1).astype(np.float32)

    def decisions(self, episode: int) -> range:
        return range(int(self.exec_starts[episode]), int(self.lengths[episode]))

    def rendered(self, episode: int) -> np.ndarray:
        return np.ones(self.lengths[episode], bool)

    def subgoals(self, episode: int, step: int) -> dict[str, str]:
        late = step >= self.exec_starts[episode] + 20
        return {
            "simple_subgoal": (
                f"pick it up for the {'second' if late else 'first'} time, number {episode}"
            )
        }

    def states(self, episode: int, start: int = 0, stop: int | None = None) -> np.ndarray:
        stop = int(self.lengths[episode]) if stop is None else stop
        return np.zeros((stop - start, self.robot.state.width), np.float32)

    def actions(self, episode: int) -> np.ndarray:
        return np.zeros((self.lengths[episode], self.robot.action.width), np.float32)

    def frames(self, episode: int, indices: Any, camera: str | None = None) -> np.ndarray:
        self.frames_read += [(episode, int(i)) for i in indices]
        values = (97 * episode + 3 * np.asarray(indices)) % 256
        images = (
            np.broadcast_to(values[:, None, None, None], (len(values), SIDE, SIDE, 3))
            .astype(np.uint8)
            .copy()
        )
        images[:, : 8 + 8 * episode, :8] = 255  # not of one colour, so that a normed tower sees it
        return images


def made_up(count: int = 3, **options: Any) -> list[Recording]:
    source: Any = MadeUpSource(**options)
    return [Recording(source, episode) for episode in range(count)]


class ReadsOneSlot(MMEPolicy):
    """Returns the content of one slot of its memory, plus a little noise."""

    slot: int | None = 2

    def sample_actions(
        self, batch: Any, draws: Any = None, steps: Any = None, **others: Any
    ) -> Tensor:
        noise = 0.01 * draws["noise"]
        if self.slot is None or batch.history is None:
            return noise
        read = (
            batch.history.features[:, self.slot].float().mean(-1) * batch.history.mask[:, self.slot]
        )
        return noise + read[:, None, None]


def reader(slot: int | None, budget: int = 5) -> ReadsOneSlot:
    """One token a frame, five frames; `slot` None reads nothing."""
    full = quick_policy("framesamp_modul", memory={"budget": budget, "grid": 1})
    policy = ReadsOneSlot(full.backbone, full.memory, full.integration, full.processor, full.config)
    policy.slot = slot
    return policy.eval()


def probed(
    policy: Any, words: list[Any], folder: Any, count: int = 1, **settings: Any
) -> list[Line]:
    """A probe of the first synthetic episodes, each of which may take from the others."""
    recordings = made_up(robot=policy.embodiment)
    arms: list[Arm] = read_arms(words) if words else []
    settings_ = OfflineSettings(**{"draws": 3, "moments": 2, "flow_steps": 2, **settings})
    torch.manual_seed(0)
    return probe_offline(
        policy, arms, recordings[:count], recordings, folder / "offline.jsonl", settings_
    )


JOBS = [Job("VideoUnmask", "test", 0), Job("PickXtimes", "test", 1)]


def actions(policy: MMEPolicy, word: str, **settings: object) -> list[np.ndarray]:
    probe = ProbedPolicy(policy, read_arm(word), made_up(), None).eval()
    envs = InlineEnvs(base=make_moving_env)
    roll(probe, JOBS, envs, **settings)
    return [np.stack(envs.made[job].actions) for job in JOBS]
