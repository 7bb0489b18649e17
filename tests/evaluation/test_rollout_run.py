"""A whole run: killed and gone on with, dying workers, shards, videos, the command."""

import shutil
import signal
import time
from pathlib import Path

import pytest

from helpers import commands
from helpers.rollout_fakes import (
    FACTS,
    JOBS,
    InlineEnvs,
    quick_policy,
    roll,
    run_evaluation,
    save_records,
    use_inline_envs,
)
from helpers.scripted_env import make_mortal_env, make_moving_env
from mme_vla import UserError
from mme_vla.envs.vector.pool import Job, Reply
from mme_vla.errors import SceneError
from mme_vla.evaluation.claims import Claims, Shard, choose_shard
from mme_vla.evaluation.records import EpisodeRecord, RecordLog, RunKey
from mme_vla.evaluation.rollout.environment import Report
from mme_vla.evaluation.rollout.evaluation import EvaluationRun, RunOptions, default_output
from mme_vla.evaluation.rollout.progress import RolloutProgress
from mme_vla.evaluation.rollout.settings import RolloutSettings
from mme_vla.evaluation.store import find_records, read_records
from mme_vla.policy.mme import MMEPolicy


def outcomes(folder: Path) -> dict:
    """What must not depend on how a run came about; the last is exact to the last bit."""
    records = [record for path in find_records([folder]) for record in read_records(path)]
    return {r.key: (r.outcome, r.steps, r.actions_sha256) for r in records if r.outcome != "error"}


@pytest.mark.slow
def test_a_killed_run_goes_on_and_ends_as_one_that_was_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    use_inline_envs(monkeypatch)  # the killed run has worker processes
    checkpoint = tmp_path / "step_000003"
    quick_policy("framesamp_modul", memory={"budget": 64}).save_pretrained(checkpoint)
    policy = MMEPolicy.from_pretrained(checkpoint)
    straight = run_evaluation(policy, tmp_path / "whole")
    assert len(straight.records) == len(JOBS) == 6
    assert len({record.outcome for record in straight.records}) > 1, "the episodes should differ"

    folder, records = tmp_path / "killed", tmp_path / "killed" / "episodes.jsonl"
    run = commands.start("helpers.rollout_fakes", str(folder), str(checkpoint), "0.05")
    try:
        until = time.monotonic() + 120
        while not records.exists() or records.read_bytes().count(b"\n") < 2:
            assert run.poll() is None and time.monotonic() < until
            time.sleep(0.02)
    finally:
        run.kill()
        assert commands.finish(run).returncode == -signal.SIGKILL
    with records.open("ab") as file:
        file.write(b'{"model":"tiny","che')  # as if it had been writing
    with pytest.warns(UserWarning, match="half-written"):
        before = [(r.key, r.when) for r in read_records(records)]
    assert 2 <= len(before) < 6

    with pytest.warns(UserWarning, match="half-written"):
        resumed = run_evaluation(policy, folder)
    after = read_records(records)
    assert [(r.key, r.when) for r in after[: len(before)]] == before, (
        "what was finished was run again"
    )
    assert len(after) == len(resumed.records) == 6
    assert outcomes(folder) == outcomes(tmp_path / "whole")
    assert run_evaluation(policy, folder).workload.batches == 0, "nothing was left to do"


def test_a_run_whose_folder_is_removed_ends_at_once_and_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    use_inline_envs(monkeypatch)
    folder, append = tmp_path / "run", RecordLog.append

    def append_to_nothing(log: RecordLog, record: EpisodeRecord) -> None:
        shutil.rmtree(folder)
        append(log, record)

    monkeypatch.setattr(RecordLog, "append", append_to_nothing)
    with pytest.raises(UserError, match=r"episodes\.jsonl was removed or moved: repeat the same"):
        run_evaluation(quick_policy("pi05"), folder, jobs=JOBS[:1])
    assert not folder.exists()
    monkeypatch.setattr(RecordLog, "append", append)
    assert len(run_evaluation(quick_policy("pi05"), folder, jobs=JOBS[:1]).records) == 1


def test_a_dying_worker_is_an_error_that_is_tried_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    policy = quick_policy("pi05")
    (tmp_path / "graves").mkdir()
    monkeypatch.setenv("GRAVES", str(tmp_path / "graves"))
    at_once = run_evaluation(policy, tmp_path / "a", make_mortal_env, jobs=JOBS[1:3])
    records = read_records(tmp_path / "a" / "episodes.jsonl")
    (error,) = [record for record in records if record.outcome == "error"]
    assert error.key == ("PickXtimes", 1) and "exit code 3" in error.error and error.steps == 16
    assert len(records) == 3 and {record.outcome for record in at_once.records} == {"timeout"}

    (tmp_path / "graves" / "PickXtimes-1").unlink()
    later = run_evaluation(policy, tmp_path / "b", make_mortal_env, jobs=JOBS[1:2], retries=0)
    assert [r.key for r in later.records if r.outcome == "error"] == [("PickXtimes", 1)]
    resumed = run_evaluation(policy, tmp_path / "b", make_mortal_env, jobs=JOBS[1:2], retries=0)
    assert {record.outcome for record in resumed.records} == {"timeout"}
    assert outcomes(tmp_path / "b").items() <= outcomes(tmp_path / "a").items()


def test_a_folder_is_gone_on_with_only_as_the_run_it_holds(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    use_inline_envs(monkeypatch)
    run_evaluation(quick_policy("pi05"), tmp_path, jobs=JOBS[:1])
    with pytest.raises(UserError, match=r"execute was 16, is 8"):
        run_evaluation(quick_policy("pi05"), tmp_path, execute=8)
    with pytest.raises(UserError, match=r"policy was"):
        run_evaluation(quick_policy("framesamp_modul"), tmp_path)


def test_episodes_of_other_runs_are_not_taken_for_this_ones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    use_inline_envs(monkeypatch)
    policy, runs = quick_policy("pi05"), tmp_path / "runs"
    for folder in (runs / "seed7", runs):  # the second lies above the first
        done = run_evaluation(policy, folder, jobs=JOBS[:1])
        assert done.workload.batches > 0 and len(done.records) == 1
    other = EpisodeRecord("tiny", "untrained", 7, "PickXtimes", 1, 1, "easy", "success", 5)
    (runs / "episodes-foreign.jsonl").write_text(other.to_json() + "\n")
    done = run_evaluation(policy, runs, jobs=JOBS[:2])
    assert done.workload.batches > 0 and {record.model_seed for record in done.records} == {42}
    assert run_evaluation(policy, runs, jobs=JOBS[:2]).workload.batches == 0


def test_shards_side_by_side_make_the_full_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    use_inline_envs(monkeypatch)
    policy, settings = (
        quick_policy("pi05"),
        RolloutSettings(max_steps=24, flow_steps=2, max_batch=1),
    )
    left = [2, 2]  # how many the first process may begin; the other does the rest
    take = Claims.take

    def at_most(claims: Claims, waiting):
        index = int(claims.records[len("episodes-")])
        left[index] -= 1
        return take(claims, waiting) if left[index] >= 0 else None

    monkeypatch.setattr(Claims, "take", at_most)
    for index in range(2):
        shard = Shard(index, 2)
        mine = EvaluationRun(
            policy,
            JOBS[:4],
            tmp_path,
            FACTS,
            settings,
            RunOptions(shard=shard, base=make_moving_env, show_progress=False),
        ).run()
        assert len(mine.records) == 2
    assert sorted(path.name for path in find_records([tmp_path])) == [
        "episodes-0of2.jsonl",
        "episodes-1of2.jsonl",
    ]
    both = outcomes(tmp_path)
    run_evaluation(policy, tmp_path / "alone", make_moving_env, jobs=JOBS[:4])
    assert both == outcomes(tmp_path / "alone")


def test_a_shard_comes_from_the_word_or_from_torchrun(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("RANK", raising=False)
    assert choose_shard(None) == Shard(0, 1) and Shard(0, 1).file == "episodes.jsonl"
    for wrong in ("4/4", "1", "a/b", "1/0"):
        with pytest.raises(UserError, match="counted from 0"):
            choose_shard(wrong)
    monkeypatch.setenv("RANK", "2")
    monkeypatch.setenv("WORLD_SIZE", "4")
    assert choose_shard(None) == Shard(2, 4) and choose_shard("1/4") == Shard(1, 4)


def test_environments_that_cannot_begin_stop_the_run() -> None:
    class Broken(InlineEnvs):
        def start(self, worker, job, **how):
            self._replies.append(Reply.of_failure(worker, job, True, self.kind("no scene")))

    envs = Broken(2)
    envs.kind = UserError
    with pytest.raises(UserError, match="no scene"):
        roll(quick_policy("pi05"), JOBS, envs)
    envs = Broken(2)
    envs.kind = RuntimeError
    with pytest.raises(UserError, match="8 environments in a row"):
        roll(quick_policy("pi05"), JOBS, envs)
    envs = Broken(2)
    envs.kind = SceneError
    many = [Job("VideoPlaceOrder", "reserved", episode) for episode in range(12)]
    assert [record.outcome for record in roll(quick_policy("pi05"), many, envs)] == ["error"] * 12


def test_episodes_that_fail_before_the_first_chunk_stop_no_run() -> None:
    class Brief(InlineEnvs):
        """Episodes fail while an event holds the robot."""

        def send(self, worker, action):
            assert action.hold
            job, _ = self._running[worker]
            outcome = {}, 0.0, True, False, Report(status="fail")
            self._replies.append(Reply.of_outcome(worker, job, False, outcome))

    jobs = [Job("StopCube", "test", episode) for episode in range(10)]
    records = roll(quick_policy("pi05"), jobs, Brief(2), event="pause:400@step:0")
    assert [(record.outcome, record.chunks) for record in records] == [("fail", 0)] * 10


def test_videos_show_the_conditioning_part_in_red_and_are_named_by_their_end(
    tmp_path: Path,
) -> None:
    import av

    options = {"base": make_moving_env, "videos": (str(tmp_path), "all")}
    records = roll(quick_policy("pi05"), [Job("VideoUnmask", "test", 0)], InlineEnvs(**options))
    (path,) = tmp_path.iterdir()
    assert path.name == "VideoUnmask_ep0_success_pick_up_the_red_cube.mp4" == records[0].video
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        assert stream.average_rate == 30
        frames = [
            frame.to_ndarray(format="rgb24").astype(int) for frame in container.decode(stream)
        ]
    assert len(frames) == 22 + records[0].steps
    red = [bool((frame[3, 20] - frame[3, 20].mean())[0] > 80) for frame in frames]
    assert red == [True] * 21 + [False] * (len(frames) - 21)
    failed = tmp_path / "failed"
    options["videos"] = (str(failed), "failure")
    roll(quick_policy("pi05"), [Job("VideoUnmask", "test", 0)], InlineEnvs(**options))
    assert list(failed.iterdir()) == []


def test_progress_counts_errors_apart_and_retries_not_at_all(capsys: pytest.CaptureFixture) -> None:
    def record(outcome: str, **changes) -> EpisodeRecord:
        return EpisodeRecord("m", 1, 0, "BinFill", 0, 1, "easy", outcome, 5, **changes)

    with RolloutProgress(4, [record("success")]) as progress:
        progress.episode(record("error", error="it died"), again=True)
        progress.episode(record("fail"))
        progress.episode(record("error", error="it died"))
        assert progress.summary == "success 1/3 = 33.3 % · 1 errors"
    assert "tried again" in capsys.readouterr().err


def test_progress_names_the_run_and_no_difficulty_where_there_is_none(
    capsys: pytest.CaptureFixture,
) -> None:
    with RolloutProgress(1, name="nano · drop:all") as progress:
        progress.say("forecast")
        progress.episode(EpisodeRecord("m", 1, 0, "FirstLight", 31, 1, "", "timeout", 25))
    forecast, line = capsys.readouterr().err.splitlines()
    assert forecast == "nano · drop:all: forecast"
    assert line.startswith("nano · drop:all: FirstLight 31: timeout, 25 steps")


def test_only_the_first_of_several_arms_forecasts_its_time(
    tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    use_inline_envs(monkeypatch)
    settings = RolloutSettings(max_steps=16, workers=1, max_batch=1)
    save_records(tmp_path / "earlier", roll(quick_policy("pi05"), JOBS[:1], InlineEnvs()))
    options = RunOptions(base=make_moving_env, times_from=tmp_path / "earlier")
    events = ["pause:4"]
    EvaluationRun(
        quick_policy("pi05"), JOBS[:1], tmp_path / "run", FACTS, settings, options
    ).run_with_events(events)
    assert capsys.readouterr().err.count("forecast") == 1


def test_a_shipped_policy_has_a_folder_of_its_name_and_old_runs_resume(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    facts = RunKey("framesamp_modul-every_8-grid_1", "nano", 7, memory_budget=4)
    assert default_output(facts) == Path("outputs/evaluation/nano/seed7")
    earlier = Path("outputs/evaluation/framesamp_modul-every_8-grid_1-4/nano/seed7")
    earlier.mkdir(parents=True)
    assert default_output(facts) == earlier
    trained = RunKey("framesamp_modul", 80000, 7)
    assert default_output(trained) == Path("outputs/evaluation/framesamp_modul/80000/seed7")
