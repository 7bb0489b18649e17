"""Many episodes at once: environments in worker processes, one policy that acts for the waiting
ones in one batch.

Each worker executes its chunk at its own pace, and joins the policy's next batch when it is done.
"""

import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mme_vla.envs.base import environment
from mme_vla.envs.vector.pool import Job, Reply, VecEnv
from mme_vla.errors import SceneError, UserError, text_of
from mme_vla.evaluation.claims import Claims, Waiting
from mme_vla.evaluation.records import EpisodeRecord, RunKey
from mme_vla.evaluation.rollout.environment import ChunkCommand
from mme_vla.evaluation.rollout.failures import FailureStreaks
from mme_vla.evaluation.rollout.progress import RolloutProgress
from mme_vla.evaluation.rollout.running import RenderPlan, RunningEpisode
from mme_vla.evaluation.rollout.settings import RolloutSettings
from mme_vla.policy.base import Policy, frames_a_piece
from mme_vla.policy.scheduler import Act, Prepare, Scheduler
from mme_vla.subgoal import SubgoalPredictor


@dataclass
class Workload:
    """What the policy did, over a whole rollout."""

    batches: int = 0
    chunks: int = 0
    policy_s: float = 0.0
    wall_s: float = 0.0

    @property
    def mean_batch(self) -> float:
        """Episodes to a batch."""
        return self.chunks / max(self.batches, 1)


class Rollout:
    """Runs episodes and records each when it ends.

    A subclass may override `on_reply`, `choose` and `on_end`. The last one writes the record: call
    `super().on_end` to keep it.
    """

    def __init__(
        self,
        policy: Policy,
        envs: VecEnv,
        facts: RunKey,
        settings: RolloutSettings,
        record: Callable[[EpisodeRecord], None],
        subgoals: SubgoalPredictor | None = None,
        subgoal_folder: Path | None = None,
        progress: RolloutProgress | None = None,
    ) -> None:
        """Prepare a rollout; `run` does it.

        Args:
            policy: in eval mode, on its device.
            envs: environments that take chunks (of an `EpisodeFactory`), or what has the interface.
            facts: what the records say of the policy.
            record: called with every record, as soon as there is one.
            subgoals: predicts the subgoal; None leaves it out of the prompt.
            subgoal_folder: where every subgoal is logged with its image; None keeps the scores
                alone.
            progress: is told of every record.
        """
        self.policy = policy
        self.envs = envs
        self.facts = facts
        self.settings = settings
        self.record = record
        self.subgoals = subgoals
        self.subgoal_folder = subgoal_folder
        self.progress = progress or RolloutProgress(0, visible=False)
        self.workload = Workload()
        self._waiting = Waiting()
        self._running: dict[int, RunningEpisode] = {}  # by worker
        self._tries: Counter[Job] = Counter()
        self._failures = FailureStreaks()
        self._scheduler: Scheduler[RunningEpisode, RunningEpisode, RunningEpisode] = Scheduler(
            settings.max_batch
        )
        self._events = settings.events
        self._render_plan = RenderPlan(policy, subgoals, settings)

    # What a subclass may override -----------------------------------------------------------------

    def on_reply(self, running: RunningEpisode, reply: Reply) -> None:
        """See what came back from an episode's environment, before the episode takes it."""

    def choose(self, batch: Sequence[RunningEpisode]) -> np.ndarray:
        """The chunks [n, h, w] that these episodes execute the first actions of."""
        return self.policy.act([running.episode for running in batch], self.settings.flow_steps)

    def on_end(
        self, running: RunningEpisode, outcome: str, reason: str | None, again: bool
    ) -> None:
        """Keep what is wanted of an episode that is over: its record.

        reason: the error, or of another outcome why the last action was refused.
        again: whether the episode is tried once more.
        """
        job = running.job
        robot = self.policy.embodiment
        source = environment(self.settings.env)
        spec = source.episode(job.task, job.split, job.episode)
        record = EpisodeRecord(
            **self.facts._asdict(),
            max_steps=self.settings.limit_of(job.task),
            action_space=robot.action.answers or robot.name,
            task=job.task,
            episode=job.episode,
            seed=spec.seed,
            difficulty=spec.difficulty,
            scene=running.report.scene,
            outcome=outcome,
            steps=running.steps,
            seconds=running.seconds,
            error=reason if outcome == "error" else None,
            env=self.settings.env,
            goal=running.episode.goal,
            chunks=running.chunks,
            video_frames=running.video_frames,
            actions_sha256=running.actions_sha256,
            suite=source.suite_of(job.task),
            groups=source.groups_of(job.task) or None,
            refused=reason if outcome != "error" else None,
            video=running.report.video,
            process=running.report.process,
            events=tuple(running.events.log),
            subgoals=None if running.trace is None else running.trace.score.to_dict(),
        )
        self.record(record)
        self.progress.episode(record, again)

    # The rollout ----------------------------------------------------------------------------------

    def run(self, jobs: Sequence[Job], claims: Claims | None = None) -> None:
        """Run these episodes; claims: where other processes run the same ones."""
        for _ in self.rounds(jobs, claims):
            pass

    def rounds(self, jobs: Sequence[Job], claims: Claims | None = None) -> Iterator[None]:
        """Run these episodes; yields after each turn of the policy."""
        begun = time.perf_counter()
        self._waiting = Waiting(jobs, claims)
        for worker in range(self.envs.workers):
            self._start(worker)
        while self.envs.busy or self._scheduler:
            # While the policy has work, take what is there; else wait for the next environment.
            seconds = 0 if self._scheduler else None
            for reply in self.envs.recv(seconds):
                self._take(reply)
            # Then read, act and prepare for the episodes that wait for the policy.
            round_begun = time.perf_counter()
            for step in self._scheduler.next_steps():
                if isinstance(step, Act):
                    self._act(step.batch)
                elif isinstance(step, Prepare):
                    if self.policy.prepare(step.work.episode):
                        self._scheduler.later[step.work] = None
                else:
                    step.work.read()
                    if not step.work.pieces:
                        self._proceed(step.work)
            self.workload.policy_s += time.perf_counter() - round_begun
            yield
        self.workload.wall_s += time.perf_counter() - begun

    def _start(self, worker: int) -> None:
        """Begin the next episode that waits, if there is one."""
        job = self._waiting.take()
        if job is None:
            return
        self._tries[job] += 1
        piece = frames_a_piece(self.policy, self.settings.encode_chunk)
        folder = self.subgoal_folder
        running = RunningEpisode(
            self.policy, job, self.settings.seed, self.subgoals, piece, folder, self._events, worker
        )
        self._running[worker] = running
        self.envs.start(worker, job, images=self._render_plan.before_video())

    def _take(self, reply: Reply) -> None:
        """Give a reply to its episode: end it, restart it for images, or queue its frames."""
        running = self._running[reply.worker]
        self._scheduler.later.pop(running, None)
        self.on_reply(running, reply)
        if isinstance(reply.error, UserError):
            raise UserError(f"{reply.job}: {text_of(reply.error)}")
        if reply.error is None:
            running.take_report(reply.info)
            status = str(running.report.status)
            message = running.report.error
        else:
            status = "error"
            message = f"{reply.job}: {text_of(reply.error)}"
        if reply.done:
            self._failures.note_end(reply, message, is_repeated=self._tries[running.job] > 1)
            # A scene in which an object finds no place finds none again.
            is_unbuildable = isinstance(reply.error, SceneError)
            self._finish(running, status, message, retry=not is_unbuildable)
            return
        if reply.is_reset:
            self._failures.note_start()
            if self._rerenders_video(running, reply):
                return
            running.begin(reply.observation)
        else:
            running.resume(reply.observation)
        self._scheduler.reading.append(running)

    def _rerenders_video(self, running: RunningEpisode, reply: Reply) -> bool:
        """Reset the episode once more if video frames that its memory reads were not rendered."""
        length = len(reply.observation["state"]) - 1
        first = running.first_video_frames
        if first not in (None, length):
            raise UserError(
                f"{reply.job}: its conditioning video had {first} frames, and {length} when"
                " it was simulated again: the environment does not repeat itself. Set draw=all."
            )
        missing = self._render_plan.missing(reply.observation)
        if missing is None:
            return False
        running.first_video_frames = length
        self.envs.start(running.worker, running.job, images=missing)
        return True

    def _proceed(self, running: RunningEpisode) -> None:
        """Queue an episode to act in the next batch, unless an event holds the robot first."""
        running.events.next(running.episode, running.steps, running.report.subtask)
        event = running.events.holding
        if event is None:
            self._scheduler.acting.append(running)
            return
        images = self._render_plan.of_chunk(running, event.observed, event.hold - event.observed)
        command = ChunkCommand(hold=event.hold, subgoal=running.episode.subgoal, images=images)
        self.envs.send(running.worker, command)

    def _act(self, batch: list[RunningEpisode]) -> None:
        """Choose the chunks of a batch and send the actions that are executed to their workers."""
        begun = time.perf_counter()
        if self.subgoals is not None:
            subgoals = self.subgoals.predict([running.watched for running in batch])
            latency = time.perf_counter() - begun
            for running, subgoal in zip(batch, subgoals, strict=True):
                running.episode.subgoal = subgoal.text
                if running.trace is not None:
                    running.trace.add(running.watched, subgoal, latency)
        chunks = self.choose(batch)
        self.workload.batches += 1
        self.workload.chunks += len(batch)
        share = (time.perf_counter() - begun) / len(batch)
        execute = self.settings.execute or self.policy.embodiment.action.execute
        for running, chunk in zip(batch, chunks, strict=True):
            running.policy_s += share
            failure = running.episode.failure
            if failure is not None:  # the policy cannot act in it any more
                if not running.chunks:
                    self._failures.note_no_chunk(failure.reason)
                self._finish(running, "error", failure.reason, retry=failure.again)
                continue
            self._failures.note_chunk()
            actions = chunk[:execute]
            if not np.isfinite(actions).all():
                self._finish(
                    running, "error", "the policy's actions are not finite numbers", retry=False
                )
                continue
            running.set_actions(actions)
            images = self._render_plan.of_chunk(running, len(actions))
            command = ChunkCommand(actions, subgoal=running.episode.subgoal, images=images)
            self.envs.send(running.worker, command)
            self._scheduler.later[running] = None

    def _finish(
        self, running: RunningEpisode, status: str, error: str | None = None, retry: bool = True
    ) -> None:
        """End an episode, have `on_end` write its record, and let its worker begin another."""
        outcome = status
        if status not in ("success", "fail", "timeout"):
            outcome = "error"
            error = error or f"the environment ended the episode with the status {status!r}"
        running.episode.close()
        again = outcome == "error" and retry and self._tries[running.job] <= self.settings.retries
        # The record of an error is superseded by that of the repetition (`records.merge`).
        self.on_end(running, outcome, error, again)
        if again:
            self._waiting.put_back(running.job)
        del self._running[running.worker]
        self._start(running.worker)
