"""An episode shows the texts that its recording has: in the video, at the change to the execution,
and after waits.
"""

import pytest

pytest.importorskip("mani_skill", reason="the simulation needs the extra 'sim'")

from mme_vla.envs import metadata
from mme_vla.envs.make import make_env, make_task
from mme_vla.envs.robomme.recording.recorder import RecordedStep, Recorder
from mme_vla.envs.subtasks import NO_RECORD

VIDEOS = [
    ("MoveCube", 0),
    ("MoveCube", 6),
    ("MoveCube", 9),
    ("VideoPlaceOrder", 5),
    ("VideoPlaceButton", 4),
    ("VideoRepick", 7),
    ("InsertPeg", 9),
    ("VideoUnmaskSwap", 6),
    ("PatternLock", 8),
]
"""Episodes of the training split. The cube of MoveCube is hooked, pushed, and grasped."""


class ExecutionError(Exception):
    """The execution has begun."""


def recorded_video(task: str, episode: int) -> tuple[list[str], str]:
    """The text of each frame of a recorded video, and of the first frame after it."""
    spec = metadata.episode(task, "train", episode)
    env = make_task(task, render=False, seed=spec.seed, difficulty=spec.difficulty)
    steps: list[RecordedStep] = []

    def keep(step: RecordedStep) -> None:
        steps.append(step)
        if not step.info["is_video_demo"]:
            raise ExecutionError

    with pytest.raises(ExecutionError):
        Recorder(env, render=False, on_step=keep).record()
    env.close()
    *video, after = [step.info["simple_subgoal_online"] for step in steps]
    return video, after


@pytest.mark.slow
@pytest.mark.parametrize(("task", "episode"), VIDEOS)
def test_a_video_has_the_texts_of_its_recording(task: str, episode: int) -> None:
    video, after = recorded_video(task, episode)
    env = make_env(task, "train", episode, action_space="ee_pose", render=False, recovery=None)
    displayed: list[str] = []
    env.on_frame = lambda _, info, in_video: displayed.append(info["simple_subgoal_online"])
    env.reset()
    expected: list[str] = []
    for word in video:
        # A frame whose recorded text is none goes on with the text of the sub-task that is
        # demonstrated.
        expected.append(word if word != NO_RECORD else expected[-1])
    execution = next(step.text for step in env.task.progress.subtasks if not step.video)
    assert not env.task.recording
    env.close()
    assert displayed[:-1] == expected
    assert after == execution


def test_waits_end_at_the_recorded_actions_when_judged_as_recorded() -> None:
    scene = {"seed": 2600, "difficulty": "medium", "render": False}
    task = make_task("StopCube", **scene)
    steps = Recorder(task, render=False).record().frames
    task.close()
    texts: dict[bool, list[str]] = {}
    for as_recorded in (True, False):
        env = make_env("StopCube", **scene)
        env.task.recording = as_recorded
        env.reset()
        texts[as_recorded] = []
        for step in steps:
            _, _, terminated, _, info = env.step(step.action["joint_action"])
            texts[as_recorded].append(info["simple_subgoal_online"])
            if terminated:
                break
        assert info["status"] == "success"
        env.close()
    recorded = [step.info["simple_subgoal_online"] for step in steps][: len(texts[True])]
    assert texts[True] == recorded
    # The clock of an episode is one step ahead of its recording's, which lacks the step of the
    # first observation.
    begin = [
        words.index("press the button to stop the cube on the target")
        for words in (texts[False], recorded)
    ]
    assert begin[0] == begin[1] - 1
