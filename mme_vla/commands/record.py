"""`python -m mme_vla.envs.record`: demonstrate episodes of the benchmark and keep them as a dataset."""

import json
import multiprocessing
import shutil
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mme_vla.config.plugins import import_plugins, imported_plugins
from mme_vla.envs.episodes import choose_episodes, named_tasks
from mme_vla.envs.make import make_task, require_simulator
from mme_vla.errors import UserError

if TYPE_CHECKING:
    from omegaconf import DictConfig

    from mme_vla.envs.recording.recorder import Recording


@dataclass(frozen=True)
class Job:
    """One episode to demonstrate."""

    task: str
    episode: int
    seed: int
    difficulty: str
    recovery: str | None
    retries: int

    @property
    def name(self) -> str:
        """Of the episode's files."""
        return f"{self.task}-{self.episode:04d}"


def record_episode(job: Job, folder: Path, previews: Path | None = None) -> dict[str, Any]:
    """Demonstrate an episode into `<folder>/<name>.h5`; seeds that fail are skipped.

    Returns:
        Task, episode, the seed that succeeded, steps, stored steps, video steps, and the failed seeds with reasons.

    Raises:
        UserError: none of the seeds succeeded.
    """
    from mme_vla.envs.recording.hdf5_writer import EpisodeWriter
    from mme_vla.envs.recording.recorder import Recorder
    from mme_vla.envs.scene.placement import SceneError

    failures: dict[int, str] = {}
    draft = folder / f"{job.name}.writing"
    for seed in range(job.seed, job.seed + job.retries):
        try:
            task = make_task(job.task, render=True, seed=seed, difficulty=job.difficulty, recovery=job.recovery)
        except SceneError as error:
            failures[seed] = str(error)
            continue
        writer = EpisodeWriter(draft, job.episode, task)
        try:
            result: Recording = Recorder(task, on_step=writer.add).record()
        finally:
            writer.close()
            task.close()
        if result.success:
            draft.rename(folder / f"{job.name}.h5")
            if previews is not None:
                from mme_vla.data.previews import write_previews

                write_previews(folder / f"{job.name}.h5", job.episode, job.task, previews)
            counts = {"steps": result.steps, "stored": result.stored, "video": result.video}
            done = {"task": job.task, "episode": job.episode, "seed": seed, **counts, "failed_seeds": failures}
            (folder / f"{job.name}.json").write_text(json.dumps(done))
            return done
        failures[seed] = result.error or "the demonstration did not end in success"
    draft.unlink(missing_ok=True)
    last = list(failures.items())[-1]
    raise UserError(
        f"{job.task} episode {job.episode}: none of the seeds {job.seed} … {last[0]} succeeded; the last: {last[1]}. "
        "Raise retries, or leave this episode out."
    )


def record(jobs: Sequence[Job], folder: Path, workers: int, previews: Path | None) -> list[dict[str, Any]]:
    """Demonstrate all episodes that `folder` does not hold yet, with a progress bar; return what is known of each."""
    from mme_vla.data.progress import progress

    folder.mkdir(parents=True, exist_ok=True)
    missing = [job for job in jobs if not (folder / f"{job.name}.json").is_file()]
    with progress("record", len(jobs), len(jobs) - len(missing), "episodes") as advance:
        for _ in _carry_out(missing, folder, workers, previews):
            advance(1)
    return [json.loads((folder / f"{job.name}.json").read_text()) for job in jobs]


def _carry_out(jobs: Sequence[Job], folder: Path, workers: int, previews: Path | None) -> Iterator[dict[str, Any]]:
    if workers == 1 or len(jobs) < 2:
        yield from (record_episode(job, folder, previews) for job in jobs)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, context, import_plugins, (imported_plugins(),)) as pool:
        futures = [pool.submit(record_episode, job, folder, previews) for job in jobs]
        try:
            for future in as_completed(futures):
                yield future.result()
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def plan(cfg: "DictConfig") -> list[Job]:
    """The episodes that a configuration names.

    Raises:
        UserError: an unknown task or split, an episode that does not exist, or a number that is not positive.
    """
    for name in ("workers", "retries"):
        if not isinstance(cfg[name], int) or cfg[name] < 1:
            raise UserError(f"{name}={cfg[name]!r}: expected a positive integer.")
    specs = choose_episodes(named_tasks(cfg), cfg.episodes, cfg.split)
    return [
        Job(s.task, s.episode, s.seed, s.difficulty, s.recovery if cfg.recovery else None, cfg.retries) for s in specs
    ]


def run(cfg: "DictConfig") -> None:
    """Record as configs/record.yaml and the command line say.

    Raises:
        UserError: something that the configuration asks for is not possible; nothing that exists is overwritten.
    """
    from mme_vla.data.conversion import ConvertOptions, convert
    from mme_vla.data.hdf5 import EpisodeRef

    if not cfg.lerobot and cfg.hdf5 is None:
        raise UserError("lerobot=false leaves nothing to write: name a folder with hdf5=<folder>.")
    options = ConvertOptions(images=cfg.images, fps=cfg.fps, **cfg.video)
    jobs, output = plan(cfg), Path(cfg.output)
    if output.exists():
        raise UserError(f"{output} exists already; choose another output, or remove that folder yourself.")
    official = _official_files(jobs, cfg.hdf5)
    require_simulator()
    work = output.with_name(output.name + ".recording")
    _claim(work, jobs)
    previews = None if cfg.previews is None else Path(cfg.previews)
    done = record(jobs, work / "episodes", cfg.workers, previews)
    parts = {job: work / "episodes" / f"{job.name}.h5" for job in jobs}
    for task, path in official.items():
        from mme_vla.envs.recording.hdf5_writer import join

        path.parent.mkdir(parents=True, exist_ok=True)
        join([part for job, part in parts.items() if job.task == task], path)
    if cfg.lerobot:
        convert([EpisodeRef(part, job.episode, job.task) for job, part in parts.items()], output, options)
    shutil.rmtree(work)
    steps, again = sum(d["stored"] for d in done), sum(len(d["failed_seeds"]) for d in done)
    places = ", ".join(map(str, [*([output] if cfg.lerobot else []), *official.values()]))
    print(f"{places}: {len(done)} episodes, {steps} steps; {again} seeds failed and were replaced by the next.")


def _official_files(jobs: Sequence[Job], folder: str | None) -> dict[str, Path]:
    if folder is None:
        return {}
    files = {job.task: Path(folder) / f"record_dataset_{job.task}.h5" for job in jobs}
    if there := [str(path) for path in files.values() if path.exists()]:
        raise UserError(f"{', '.join(there)} exist already; choose another folder with hdf5=, or remove them yourself.")
    return files


def _claim(work: Path, jobs: Sequence[Job]) -> None:
    """Make `work` the folder of these episodes, or recognise it as such."""
    plan_file, wanted = work / "plan.json", [asdict(job) for job in jobs]
    if plan_file.is_file():
        if json.loads(plan_file.read_text()) != wanted:
            raise UserError(
                f"{work} holds an interrupted recording of other episodes. Repeat that command to finish it, choose "
                "another output, or remove that folder yourself."
            )
        return
    work.mkdir(parents=True, exist_ok=True)
    plan_file.write_text(json.dumps(wanted, indent=1))


def main() -> None:
    """Run `python -m mme_vla.envs.record`."""
    from mme_vla.config.composition import cli

    cli("record")(run)()
