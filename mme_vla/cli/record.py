"""`mme-vla record`: demonstrate episodes of the benchmark and keep them as a dataset."""

import glob
import time
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from omegaconf import DictConfig

from mme_vla.config.composition import resolved
from mme_vla.config.sections import PathText, PositiveInt, read_section
from mme_vla.data.console import progress
from mme_vla.data.convert import ConvertOptions, write_previews
from mme_vla.embodiment import Embodiment
from mme_vla.envs.base import Environment, environment
from mme_vla.envs.episodes import choose_episodes, named_tasks
from mme_vla.envs.make import ROBOMME, make_task, require_simulator
from mme_vla.envs.metadata import base_of
from mme_vla.envs.robomme.recording.coverage import compare, goal_of, goals_recorded, in_words
from mme_vla.envs.robomme.recording.frames import FrameChoice
from mme_vla.envs.robomme.recording.outputs import EpisodeWriter, Job, RecordingPlan
from mme_vla.envs.robomme.recording.own import DRAFT, episode_file, record_own
from mme_vla.envs.robomme.recording.processes import carry_out, simulation_pool
from mme_vla.envs.rows import task_options
from mme_vla.errors import SceneError, UserError, counted, require
from mme_vla.utils import FolderLock, claim_plan, drop_plan, is_vacant, read_json, write_json
from mme_vla.utils.processes import signals_deferred

if TYPE_CHECKING:  # it imports the simulator, which is asked for first
    from mme_vla.envs.robomme.recording.recorder import Recording


@dataclass(frozen=True)
class RecordRun:
    """The keys of `configs/record.yaml`, where each is explained.

    tasks: what `tasks` or `task` name.
    video: the section of `ConvertOptions`.
    """

    tasks: str | tuple[str, ...]
    env: str
    episodes: Any
    split: str
    output: PathText
    hdf5: PathText | None
    lerobot: bool
    previews: PathText | None
    recovery: bool
    retries: PositiveInt
    coverage: PathText | None
    workers: PositiveInt
    frames: Any
    memory: Mapping[str, Any] | None
    names: str
    images: str
    fps: PositiveInt | None
    video: Mapping[str, Any]

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> Self:
        """Read a composed configuration, plain and resolved."""
        return read_section(cls, config, others=True, tasks=named_tasks(config))


_FPS = 20  # of RoboMME's cameras and control
FAILED = "the demonstration did not end in success"


def record_episode(job: Job, folder: Path, previews: Path | None = None) -> None:
    """Demonstrate an episode into `<folder>/<name>.h5`; seeds that fail are skipped.

    Where not all frames are rendered, it is made twice: first without images, to choose the frames,
    and again with images of them. What is known of it goes into `<folder>/<name>.json`: the seed
    that succeeded, steps, stored steps, video steps, the failed seeds with reasons, and the facts.
    """
    from mme_vla.envs.robomme.recording.recorder import Recorder

    failures: dict[int, str] = {}
    draft = folder / f"{job.name}.writing"
    for seed in range(job.seed, job.seed + job.retries):
        scene: dict[str, Any] = {
            "seed": seed,
            "difficulty": job.difficulty,
            "recovery": job.recovery,
        }
        if job.row is not None:
            scene |= task_options(job.row)
        blind: Recording | None = None
        try:
            request = None
            if job.frames is not None:
                with closing(make_task(job.task, render=False, **scene)) as task:
                    blind = Recorder(task, render=False).record()
                if not blind.success:
                    failures[seed] = blind.error or FAILED
                    continue
                request = job.frames.render_request(blind.frames)
            task = make_task(job.task, render=True, **scene)
        except SceneError as error:
            failures[seed] = str(error)
            continue
        with (
            closing(task),
            closing(EpisodeWriter(draft, job.episode, task, job.frames)) as writer,
        ):
            result: Recording = Recorder(task, on_step=writer.add, render_request=request).record()
        if blind is not None and (blind.steps, blind.stored) != (result.steps, result.stored):
            raise RuntimeError(
                f"{job.name}: seed {seed} took {blind.steps} steps, and {result.steps} when"
                " rendered."
            )
        if result.success:
            draft.rename(folder / f"{job.name}.h5")
            if previews is not None:
                write_previews(folder / f"{job.name}.h5", job.episode, job.task, previews)
            done = {
                "task": job.task,
                "episode": job.episode,
                "seed": seed,
                "steps": result.steps,
                "stored": result.stored,
                "video": result.video,
                "failed_seeds": failures,
                "facts": [fact.to_dict() for fact in result.facts],
            }
            # last: what it tells of is there
            write_json(folder / f"{job.name}.json", done, indent=None)
            return
        failures[seed] = result.error or FAILED
    draft.unlink(missing_ok=True)
    last = list(failures.items())[-1]
    raise UserError(
        f"{job.task} episode {job.episode}: none of the seeds {job.seed} … {last[0]} succeeded; the"
        f" last: {last[1]}. Raise retries, or leave this episode out."
    )


def record(
    jobs: Sequence[Job], folder: Path, workers: int, previews: Path | None
) -> list[dict[str, Any]]:
    """Demonstrate all episodes that `folder` does not hold yet, with a progress bar; return what is
    known of each.
    """
    folder.mkdir(parents=True, exist_ok=True)
    missing = [job for job in jobs if not (folder / f"{job.name}.json").is_file()]
    with progress("record", len(jobs), len(jobs) - len(missing), "episodes") as advance:
        for _ in carry_out(
            missing, partial(record_episode, folder=folder, previews=previews), workers
        ):
            advance(1)
    recorded = []
    for job in jobs:
        file = folder / f"{job.name}.json"
        recorded.append(read_json(file, "what is known of a recorded episode"))
    return recorded


def report_coverage(
    tasks: str | Sequence[str], plan: RecordingPlan, file: Path, workers: int
) -> None:
    """Say which goals of the test split the recorded episodes lack, and write it as JSON.

    plan: a recording that is there.
    workers: processes that build the split's scenes, which tell their goals.
    """
    specs = choose_episodes(tasks, None, "test")
    goals = []
    with progress("goals", len(specs), unit="episodes") as advance, ExitStack() as stack:
        with signals_deferred():
            run = map if workers == 1 else stack.enter_context(simulation_pool(workers)).map
            episode_goals = run(goal_of, specs)
        for goal in episode_goals:
            goals.append(goal)
            advance(1)
    official = [place for place in plan.places if place != plan.dataset]
    coverage = compare(goals_recorded(plan.dataset, official), zip(specs, goals, strict=True))
    write_json(file, coverage, indent=1)
    print(f"{in_words(coverage)}\n{file}")


def plan(run: RecordRun) -> list[Job]:
    """The episodes that a configuration names."""
    specs = choose_episodes(run.tasks, run.episodes, run.split)
    base = base_of(run.split)
    require(
        base == run.split,
        f"split={run.split} varies scenes for evaluations, and a recording has the scenes as"
        f" they are: record split={base}.",
    )
    require(
        run.frames != "all" or run.memory is None,
        "frames=all draws every frame, those of a memory too: leave out memory, or set frames.",
    )
    frames = None if run.frames == "all" else FrameChoice(run.frames, run.memory)
    jobs = []
    for spec in specs:
        job = Job(
            spec.task,
            spec.episode,
            spec.seed,
            spec.difficulty,
            spec.recovery if run.recovery else None,
            # A row describes one scene: another seed would be another row.
            run.retries if spec.row is None else 1,
            frames,
            spec.row,
        )
        jobs.append(job)
    return jobs


def main(cfg: DictConfig) -> None:
    """Record as configs/record.yaml and the command line say; what the same words have recorded
    stays as it is.
    """
    run = RecordRun.from_config(resolved(cfg))
    if run.env != ROBOMME:
        record_environment(run)
        return
    if not run.lerobot and run.hdf5 is None:
        raise UserError("lerobot=false leaves nothing to write: name a folder with hdf5=<folder>.")
    rate = run.fps or _FPS
    options = read_section(
        ConvertOptions, run.video, "video", images=run.images, fps=rate, names=run.names
    )
    jobs = plan(run)
    recording_plan = RecordingPlan(
        jobs,
        Path(run.output) if run.lerobot else None,
        None if run.hdf5 is None else Path(run.hdf5),
    )
    places = ", ".join(map(str, recording_plan.places))
    work = _work_folder(run.output)
    summary = f"{places}: {counted(len(jobs), 'episode')}, all there already."
    if recording_plan.missing(options) or work.exists():
        require_simulator()
        with FolderLock(work, "recording"):
            _claim(work, [job.plan for job in jobs])
            # asked again: another process may have finished it meanwhile
            missing = recording_plan.missing(options)
            if missing:
                previews = None if run.previews is None else Path(run.previews)
                there = {path.stem for path in (work / "episodes").glob("*.json")}
                begun = time.perf_counter()
                done = record(jobs, work / "episodes", run.workers, previews)
                recording_plan.write(missing, work / "episodes", options)
                seconds = time.perf_counter() - begun  # the conversion is part of the time
                n_steps = n_failed = 0
                n_new = n_new_steps = 0
                for job, recorded in zip(jobs, done, strict=True):
                    n_steps += recorded["stored"]
                    n_failed += len(recorded["failed_seeds"])
                    if job.name not in there:
                        n_new += 1
                        n_new_steps += recorded["stored"]
                summary = (
                    f"{places}: {counted(len(done), 'episode')}, {counted(n_steps, 'step')};"
                    f" {counted(n_failed, 'seed')} failed, replaced by the next."
                )
                if n_new:
                    summary += f"\n{_throughput(n_new, n_new_steps, seconds, run.workers)}"
            recording_plan.write_facts(work / "episodes")
            recording_plan.tidy()
            drafts = []
            for job in jobs:
                for ending in ("h5", "json", "writing"):
                    drafts.append(f"episodes/{job.name}.{ending}")
            drop_plan(work, *drafts)
    print(summary)
    if run.coverage is not None:
        require_simulator()
        report_coverage(run.tasks, recording_plan, Path(run.coverage), run.workers)


def record_environment(run: RecordRun) -> None:
    """Record demonstrations of an environment of the user's own."""
    source = environment(run.env)
    source.check_installed()
    specs = choose_episodes(run.tasks, run.episodes, run.split, run.env)
    rate = _rate(source, run)
    output = Path(run.output)
    work = _work_folder(run.output)
    require(
        is_vacant(output),
        f"{output} exists already; choose another output, or remove it yourself.",
    )
    with FolderLock(work, "recording"):
        _claim(work, [{"env": run.env, "fps": rate}, *map(vars, specs)])
        frames, failures = record_own(source, specs, output, work, rate)
        drop_plan(work, DRAFT, *(glob.escape(episode_file(spec)) for spec in specs))
    print(
        f"{run.output}: {counted(len(specs) - len(failures), 'episode')},"
        f" {counted(frames, 'step')}; {len(failures)} did not succeed."
    )


def _rate(source: Environment, run: RecordRun) -> int:
    """Frames per second of the dataset: the robot's, and where it names none as many as RoboMME's.

    Raises:
        UserError: `fps` contradicts the robot.
    """
    rate = None
    if source.embodiment is not None:
        rate = Embodiment.from_dict(source.embodiment).fps
    if rate is None:
        return run.fps or _FPS
    require(
        run.fps in (None, rate),
        f"fps={run.fps} contradicts the robot of env={run.env}, which has {rate:g} frames per"
        " second: leave out fps.",
    )
    require(
        rate == int(rate),
        f"The robot of env={run.env} has {rate:g} frames per second; a dataset takes whole"
        " numbers.",
    )
    return int(rate)


def _throughput(episodes: int, steps: int, seconds: float, workers: int) -> str:
    """A line on the speed; of a resumed recording, on what was added."""
    hours = max(seconds, 1e-9) / 3600
    named = counted(workers, "worker")
    return (
        f"{counted(episodes, 'episode')} in {seconds:.0f} s with {named}:"
        f" {episodes / hours:,.0f} episodes and {steps / hours:,.0f} steps an hour."
    )


def _work_folder(output: str) -> Path:
    return Path(output).with_name(Path(output).name + ".recording")


def _claim(work: Path, plan: list[dict[str, Any]]) -> None:
    """Make `work` the folder of these episodes, or recognise it as such."""
    require(
        claim_plan(work, plan),
        f"{work} holds an interrupted recording of other episodes. Repeat that command to finish"
        " it, choose another output, or remove that folder yourself.",
    )
