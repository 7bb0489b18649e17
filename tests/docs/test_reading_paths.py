"""The numbers of docs/extend/layout.md are those that are counted."""

import pytest
import reading_paths

from helpers import REPOSITORY


@pytest.mark.slow
def test_the_page_on_the_layout_has_the_counted_numbers() -> None:
    page = (REPOSITORY / "docs" / "extend" / "layout.md").read_text()
    for question, (take, _) in zip(reading_paths.QUESTIONS, reading_paths.answers(), strict=True):
        assert f"| {question} | {take} |" in page


@pytest.mark.parametrize(
    ("heading", "most", "on_the_way"),
    [
        (
            reading_paths.LOSS,
            500,
            [
                ("policy/network.py", "NetworkPolicy.encode_frames"),
                ("memory/framesamp.py", "FrameSamp.selected_frames"),
                ("model.py", "MMEModel.loss"),
                ("integration/modulator.py", "ModulatorLayer.forward"),
                ("backbone/flow.py", "step_loss"),
                ("model.py", "masked_mean"),
            ],
        ),
        (
            reading_paths.CHUNK,
            250,
            [
                ("policy/base.py", "Policy.act"),
                ("policy/mme.py", "MMEPolicy.predict_chunk"),
                ("backbone/pi05.py", "Pi05Backbone.sample"),
                ("policy/episode.py", "executable_actions"),
            ],
        ),
        (
            reading_paths.EPISODE,
            550,
            [
                ("evaluation/rollout/evaluation.py", "EvaluationRun.run"),
                ("envs/vector/pool.py", "serve"),
                ("evaluation/rollout/environment.py", "EpisodeFactory.open"),
                ("evaluation/rollout/running.py", "RunningEpisode.read"),
                ("policy/episode.py", "Episode._take"),
                ("evaluation/rollout/runner.py", "Rollout._act"),
                ("evaluation/rollout/environment.py", "ChunkEnv.step"),
                ("evaluation/records.py", "RecordLog.append"),
            ],
        ),
    ],
)
def test_a_table_names_functions_that_exist_in_their_order(heading, most, on_the_way) -> None:
    calls = reading_paths.chain(heading)
    places = [calls.index(call) for call in on_the_way]
    assert places == sorted(places) and len(set(calls)) == len(calls)
    assert reading_paths.lines_of(calls) <= most


def test_a_function_that_a_file_lacks_stops_the_count() -> None:
    with pytest.raises(SystemExit, match=r"model\.py defines no MMEModel\.encode\(\)"):
        reading_paths.defining([("model.py", "MMEModel.encode")])


def test_the_files_on_the_path_of_an_episode_are_at_most_twelve() -> None:
    path = reading_paths.chain(reading_paths.EPISODE) + reading_paths.EPISODE_BESIDE
    assert len(reading_paths.defining(path)) <= 12
    page = (REPOSITORY / "docs" / "extend" / "layout.md").read_text()
    (row,) = [line for line in page.splitlines() if reading_paths.QUESTIONS[-2] in line]
    for file, _ in reading_paths.EPISODE_BESIDE:
        assert f"`{file}`" in row


def test_the_functions_that_end_an_episode_exist() -> None:
    page = (REPOSITORY / "docs" / "evaluate" / "evaluation.md").read_text()
    for file, function in (
        ("envs/interface.py", "RoboMMEEnv._info"),
        ("envs/interface.py", "RoboMMEEnv.step"),
        ("evaluation/rollout/environment.py", "ChunkEnv._execute"),
        ("envs/vector/pool.py", "serve"),
        ("envs/vector/pool.py", "Reply.of_failure"),
        ("envs/vector/pool.py", "VecEnv._replace"),
        ("evaluation/rollout/runner.py", "Rollout._act"),
        ("evaluation/rollout/runner.py", "Rollout._finish"),
    ):
        assert f"`{function}`" in page
        assert reading_paths.named(reading_paths.PACKAGE / file, function)
