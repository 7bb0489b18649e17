"""The order of work: short frames, one batch, long videos; episodes that are ready
share a batch.
"""

from dataclasses import dataclass

from mme_vla.policy import scheduler
from mme_vla.policy.scheduler import Act, Read, Scheduler


@dataclass(eq=False)
class Frames:
    name: str
    pieces: int


def steps(schedule: Scheduler) -> list[str]:
    """What one turn does, in words; an episode whose frames are in requests actions."""
    done = []
    for step in schedule.next_steps():
        if isinstance(step, Act):
            done.append("act " + "".join(step.batch))
            continue
        assert isinstance(step, Read)
        step.work.pieces -= 1
        done.append("read " + step.work.name)
        if not step.work.pieces:
            schedule.acting.append(step.work.name)
    return done


def test_short_frames_come_first_then_one_batch_then_a_piece_of_a_long_video(monkeypatch):
    now = iter(range(1000))
    monkeypatch.setattr(scheduler.time, "perf_counter", lambda: 0.0 if next(now) % 3 < 2 else 1.0)
    schedule: Scheduler = Scheduler(max_batch=2)
    schedule.reading.extend(
        [Frames("v", 3), Frames("a", 1), Frames("w", 3), Frames("b", 1), Frames("c", 1)]
    )
    assert steps(schedule) == ["read a", "read b", "read c", "act ab", "read v"]
    assert steps(schedule) == ["act c", "read w"]
    assert steps(schedule) == ["read v"], "videos take turns"
    assert steps(schedule) == ["read v", "act v", "read w"]
    assert steps(schedule) == ["read w", "act w"]
    assert not schedule and steps(schedule) == []


def test_long_videos_get_as_much_time_as_the_other_work(monkeypatch):
    clock = [0.0]
    monkeypatch.setattr(scheduler.time, "perf_counter", lambda: clock[0])
    schedule: Scheduler = Scheduler(max_batch=8)
    schedule.acting.append("a")
    schedule.reading.append(Frames("v", 100))
    read = 0
    for step in schedule.next_steps():
        clock[0] += 5.0 if isinstance(step, Act) else 1.0
        if isinstance(step, Read):
            step.work.pieces -= 1
            read += 1
    assert read == 6, "five seconds of pieces, and the one that goes beyond them"


def test_a_video_whose_client_goes_is_not_read_again():
    schedule: Scheduler = Scheduler(max_batch=8)
    schedule.reading.append(Frames("v", 9))
    for step in schedule.next_steps():
        step.work.pieces = 0
    assert not schedule
