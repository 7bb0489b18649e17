"""How far each dial of `split=stress` goes: whether experts with the full state still solve the
test scenes.

`python benchmarks/stress_dials.py --output benchmarks/results/stress_dials.csv` (continues where
it was stopped)

There are two experts. The demonstrator moves the arm as it records. The oracle planner is
`mme_vla.play`'s: it acts from outside, as a policy in an evaluation does, by choices and pixels,
and has so many control steps after the video.
"""

import argparse
import csv
from collections.abc import Callable
from pathlib import Path

from mme_vla.envs import metadata
from mme_vla.envs.make import make_task
from mme_vla.envs.metadata import DIALS
from mme_vla.envs.robomme.recording.recorder import Recorder
from mme_vla.envs.robomme.scene.placement import SceneError
from mme_vla.extras.play import OraclePlayer
from mme_vla.extras.play.game import MAX_CHOICES
from mme_vla.extras.play.players import play
from mme_vla.extras.play.run import make_session

VALUES = {
    "count": (0, 2, 5, 10),
    "containers": (0, 2, 5, 10),
    "swaps": (0, 2, 5, 10),
    "delay": (0, 100, 400),
    "path": (0, 1, 2, 4),
    "distractors": (0, 2, 4, 8),
}
EPISODES = {"count": 4}
"""The first so many of `test`; of the other dials three."""
KEY = ("actor", "dial", "task", "value", "episode")
COLUMNS = (*KEY, "difficulty", "outcome", "steps", "video")
MAX_STEPS = 3000  # of the oracle planner: ten repetitions more are over the 1,300 of an evaluation
type Ended = tuple[str, int, int]
"""How an episode ended, its steps, and those of its video."""


def demonstrator(dial: str, task: str, value: int, episode: int) -> Ended:
    """A demonstration without images."""
    spec = metadata.episode(task, "test", episode)
    env = make_task(
        task, render=False, seed=spec.seed, difficulty=spec.difficulty, stress={dial: value}
    )
    try:
        done = Recorder(env, render=False).record()
    finally:
        env.close()
    return "success" if done.success else "failure", done.stored, done.video


def oracle(dial: str, task: str, value: int, episode: int) -> Ended:
    """The oracle planner's choices in the environment that policies meet, without images."""
    spec = metadata.episode(task, f"stress:{dial}={value}", episode)
    session = make_session(spec, "mme_vla", lambda _: MAX_STEPS, MAX_CHOICES, images=False)
    try:
        play(session, OraclePlayer())
        video = len(session.reveals[0].frames) - 1
    finally:
        session.close()
    return "failure" if session.status == "fail" else session.status, video + session.steps, video


ACTORS: dict[str, Callable[[str, str, int, int], Ended]] = {
    "demonstrator": demonstrator,
    "oracle": oracle,
}


def measure(actor: str, dial: str, task: str, value: int, episode: int) -> tuple[str | int, ...]:
    """A row of the table."""
    key = (actor, dial, task, value, episode, metadata.episode(task, "test", episode).difficulty)
    try:
        return *key, *ACTORS[actor](dial, task, value, episode)
    except SceneError:
        return *key, "no scene", 0, 0


def main() -> None:
    """Measure what the table does not hold yet."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--actors", nargs="+", default=list(ACTORS), choices=list(ACTORS))
    parser.add_argument("--dials", nargs="+", default=list(DIALS), choices=list(DIALS))
    parser.add_argument("--output", type=Path, required=True)
    args = parser.parse_args()
    there, done = args.output.is_file(), set()
    if there:
        with args.output.open() as file:
            done = {tuple(row[name] for name in KEY) for row in csv.DictReader(file)}
    keys = [
        (actor, dial, task, value, episode)
        for actor in args.actors
        for dial in args.dials
        for episode in range(EPISODES.get(dial, 3))
        for value in VALUES[dial]
        for task in DIALS[dial]
    ]
    with args.output.open("a", newline="") as file:
        writer = csv.writer(file)
        if not there:
            writer.writerow(COLUMNS)
        for key in keys:
            if tuple(map(str, key)) not in done:
                writer.writerow(measure(*key))
                file.flush()


if __name__ == "__main__":
    main()
