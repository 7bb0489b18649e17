"""`python -m mme_vla.inspect` shows what is there."""

from pathlib import Path

import pytest
from PIL import Image
from rich.console import Console

from mme_vla import UserError, build_policy
from mme_vla.cli.inspect import (
    Inspection,
    build_memory,
    check_place,
    draw_memory,
    main,
    show_checkpoint,
    show_dataset,
    show_episode,
)
from mme_vla.config.composition import compose, resolved
from mme_vla.data.episodes import EpisodeSource


@pytest.fixture
def console() -> Console:
    return Console(record=True, width=160, quiet=False, file=open("/dev/null", "w"))  # noqa: PTH123


@pytest.fixture(scope="module")
def sample() -> EpisodeSource:
    return EpisodeSource("sample")


def test_a_dataset_shows_its_episodes(sample: EpisodeSource, console: Console) -> None:
    show_dataset(sample, console)
    text = console.export_text()
    assert all(sample.goal(episode)[:30] in text for episode in range(len(sample)))
    assert str(int(sample.lengths.sum())) in text


def test_an_episode_shows_its_phases_and_subgoals(sample: EpisodeSource, console: Console) -> None:
    show_episode(sample, 0, 100, console)
    text = console.export_text()
    assert f"frames 0 … {sample.exec_starts[0] - 1}" in text
    assert sample.subgoals(0, 100)["simple_subgoal"] in text


def test_a_memory_is_rendered_as_it_selects(
    sample: EpisodeSource, console: Console, tmp_path: Path
) -> None:
    config = resolved(compose("inspect", ["memory=tokendrop"]))
    memory = build_memory(Inspection.from_config(config))
    path = draw_memory(sample, 3, 120, memory, "tokendrop", tmp_path, console)
    with Image.open(path) as image:
        assert image.width > 800
    assert f"of {memory.budget} tokens" in console.export_text()


def test_a_checkpoint_shows_its_parts(tmp_path: Path, console: Console) -> None:
    policy = build_policy("framesamp_modul", memory={"budget": 64})
    policy.save_pretrained(tmp_path)
    show_checkpoint(tmp_path, console)
    text = console.export_text()
    assert f"{sum(p.numel() for p in policy.parameters()):,}" in text
    assert all(part in text for part in ("vision", "vlm", "memory", "action"))
    assert "budget=64" in text


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ([], "Name one thing"),
        (["dataset=sample", "checkpoint=x"], "Name one thing"),
        (["checkpoint=/nowhere"], "No checkpoint at /nowhere"),
        (["dataset=/nowhere"], "No LeRobot dataset"),
    ],
)
def test_nothing_to_inspect_is_explained(overrides: list[str], message: str) -> None:
    with pytest.raises(UserError, match=message):
        main(compose("inspect", overrides))


def test_a_place_outside_the_data_is_refused(sample: EpisodeSource) -> None:
    assert check_place(sample, 0, None) == (0, int(sample.lengths[0]) - 1)
    with pytest.raises(UserError, match="episodes 0 … 3"):
        check_place(sample, 4, 0)
    with pytest.raises(UserError, match="frames 0 … 172"):
        check_place(sample, 0, 173)
