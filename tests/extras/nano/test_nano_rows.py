"""A row of nanoMME: every kind of model learns from the same demonstrations, and the page tells how
they did.
"""

from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from helpers.nano_policies import demonstration
from mme_vla import UserError, build_policy
from mme_vla.config.composition import compose, resolved
from mme_vla.embodiment.robomme import embodiment_of
from mme_vla.envs.robomme.recording.frames import DECISIONS, FrameChoice
from mme_vla.evaluation.records import EpisodeRecord
from mme_vla.extras.nano import demonstrations, tokens
from mme_vla.extras.nano.demonstrations import Demonstration, Scene
from mme_vla.extras.nano.learning import Decisions, position_error, statistics
from mme_vla.extras.nano.page import ends_of, outcome_lines, plot_curves, write_page
from mme_vla.extras.nano.rows import TRAINED
from mme_vla.extras.nano.runs import Group, demonstrate
from mme_vla.extras.nano.settings import NanoRun
from mme_vla.extras.nano.tokens import TokenStore
from mme_vla.policy.mme import MMEPolicy
from mme_vla.utils import write_json

CHOOSES = embodiment_of(resolved(compose("policy", ["embodiment=robomme_choice_front"]))).action
SMALL = {
    "framesamp": {"every": 8},
    "tokendrop": {"stride": 8},
    "ttt": {"stride": 16},
    "rmt": {"stride": 16},
}


def nano(model: str) -> MMEPolicy:
    memory = model.rsplit("_", 1)[0]
    words = {"memory": {"budget": 4, "grid": 1, **SMALL[memory]}} if memory in SMALL else {}
    return build_policy(
        model,
        backbone="nano",
        embodiment="robomme_waypoint_front",
        policy={"augment": False},
        **words,
    )


def rendered_for(policy: MMEPolicy) -> Demonstration:
    decisions = np.array([66, 120, 155])
    return demonstration(tuple(np.union1d(decisions, policy.frames_read(decisions, 66)).tolist()))


@pytest.mark.parametrize("memory", ["framesamp", "tokendrop", "ttt", "rmt"])
def test_decisions_hold_what_an_episode_would_store(memory: str) -> None:
    policy = nano(f"{memory}_modul").eval()
    made = rendered_for(policy)
    policy.require_processor().stats = statistics([made], policy)
    batch = Decisions.of(policy, [made]).collate([0])
    images = made.images["front"]
    episode = policy.start_episode(made.goal)
    frames = np.stack([images.get(frame, images[0]) for frame in range(67)])
    episode.observe({"front": frames}, made.states[:67], is_demo=np.arange(67) < 66)
    history = episode.gather_selection()
    assert batch.history is not None
    for name in ("features", "positions", "mask"):
        here, there = getattr(history, name).float(), getattr(batch.history, name)[0].float()
        # later decisions read more frames, so that this one is padded on the left
        there = there[-len(here) :]
        # Resized from noise by Pillow and by PyTorch, encoded in other batches, and kept as
        # bfloat16.
        assert torch.allclose(here, there, atol=0.05)


@pytest.mark.parametrize(
    ("model", "words"), [("simplesg", "pick it up"), ("groundsg", "pick it up at <")]
)
def test_a_model_that_reads_subgoals_learns_from_what_the_simulator_says(
    model: str, words: str
) -> None:
    policy = nano(model)
    made = rendered_for(policy)
    processor = policy.require_processor()
    processor.stats = statistics([made], policy)
    batch = Decisions.of(policy, [made]).batch
    baseline = Decisions.of(nano_like(policy), [made]).batch
    assert batch.prompt_mask.sum() > baseline.prompt_mask.sum()
    ids = batch.prompt[0][batch.prompt_mask[0]].tolist()
    assert words in processor.tokenizer.decode(ids)


def nano_like(policy: MMEPolicy) -> MMEPolicy:
    other = nano("pi05")
    other.require_processor().stats = policy.require_processor().stats
    return other


def test_the_error_is_measured_where_the_arm_goes_to_another_place(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    policy = nano("pi05").eval()
    made = rendered_for(policy)
    policy.require_processor().stats = statistics([made], policy)
    decisions = Decisions.of(policy, [made])
    batch = decisions.collate(decisions.distant.nonzero()[:, 0].tolist())
    assert batch.actions is not None
    monkeypatch.setattr(policy, "sample_actions", lambda *_: batch.actions)
    assert torch.equal(position_error(policy, decisions), torch.zeros(int(decisions.distant.sum())))
    shifted = batch.actions.clone()
    shifted[:, 0, 0] += 0.5  # of half the range that the statistics have
    monkeypatch.setattr(policy, "sample_actions", lambda *_: shifted)
    stats = policy.require_processor().require_stats().actions
    half = 0.5 * float(stats.q99[0] - stats.q01[0]) / 2
    assert position_error(policy, decisions).allclose(
        torch.full((int(decisions.distant.sum()),), half), atol=1e-4
    )


def test_decisions_of_tasks_with_few_are_repeated() -> None:
    policy = nano("pi05")
    many, few = rendered_for(policy), replace(rendered_for(policy), task="MoveCube")
    policy.require_processor().stats = statistics([many], policy)
    demonstrations = [many, many, many, few]
    decisions = Decisions.of(policy, demonstrations, balanced=True)
    rows = Counter(decisions.tasks[decisions[item]] for item in range(len(decisions)))
    assert rows["MoveCube"] == rows[many.task]
    assert len(decisions) > len(Decisions.of(policy, demonstrations))


def test_tokens_are_made_once_for_a_tower_and_again_for_other_frames_or_scores(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    encoded: list[int] = []
    original = tokens.tokenize

    def counted(policy: MMEPolicy, made: Demonstration, *others: object) -> tokens.FrameTokens:
        encoded.append(len(made.images["front"]))
        return original(policy, made, *others)  # type: ignore[arg-type]

    monkeypatch.setattr(tokens, "tokenize", counted)
    file = tmp_path / "VideoUnmask" / "easy-3.npz"
    file.parent.mkdir()
    demonstration().save(file)
    baseline = TokenStore.of(
        tmp_path / "tokens", [nano("framesamp_modul").config, nano("pi05").config]
    )
    read = baseline.read(file)
    policy = nano("tokendrop_modul")
    assert read.tokens["front"].shape == (12, 64, policy.backbone.vision_width) and not read.scores
    assert len(baseline.read(file).frames) == 1 and encoded == [12]
    scored = TokenStore.of(tmp_path / "tokens", [policy.config])
    rows = scored.read(file).scores[policy.require_memory().storage.scorer]
    assert rows.frames.tolist() == [15, 39, 47, 63, 79, 95, 119, 151] and encoded == [12, 12]
    demonstration((0, 15, 66, 120, 155)).save(file)
    assert scored.read(file).frames["front"].tolist() == [0, 15, 66, 120, 155] and encoded == [
        12,
        12,
        5,
    ]


def first_scene(folder: Path, *choices: FrameChoice) -> Scene:
    return Scene("VideoUnmask", 0, "easy", folder, ("front",), choices)


def test_scenes_are_demonstrated_until_there_are_enough_and_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tried: list[int] = []

    def record(task: str, seed: int, *_: object) -> Demonstration | None:
        tried.append(seed)
        return None if seed == 1 else demonstration()

    monkeypatch.setattr(demonstrations, "record", record)

    def demonstrated(count: int, *choices: FrameChoice) -> list[Path]:
        return demonstrate([Group(first_scene(tmp_path, *choices), count)])

    results = demonstrated(3)
    assert [path.stem for path in results] == ["easy-0", "easy-2", "easy-3"] and tried == [
        0,
        1,
        2,
        3,
    ]
    assert demonstrated(3) == results and tried == [0, 1, 2, 3]
    other_memory = FrameChoice(DECISIONS, {"name": "framesamp", "budget": 4, "grid": 1, "every": 4})
    demonstrated(1, other_memory)
    assert tried == [0, 1, 2, 3, 0], (
        "a demonstration without the frames of a new memory is made again"
    )
    (tmp_path / "easy-2.failed").touch()
    assert [path.stem for path in demonstrated(2)] == ["easy-0", "easy-3"], (
        "the new try of the second one failed"
    )


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ({"carried_out": True}, "carried_out=False.*choose another output"),
        ({"acts": CHOOSES}, "7 numbers .* 10"),
    ],
)
def test_demonstrations_of_other_actions_are_not_taken_for_what_is_recorded(
    how: dict[str, Any], message: str, tmp_path: Path
) -> None:
    scene = first_scene(tmp_path)
    demonstration().save(scene.path)
    assert scene.tried
    with pytest.raises(UserError, match=message):
        replace(scene, **how).tried  # noqa: B018


def test_a_demonstration_without_a_cameras_images_is_made_again(tmp_path: Path) -> None:
    scene = first_scene(tmp_path, FrameChoice(DECISIONS))
    made = demonstration()
    made.save(scene.path)
    assert scene.tried
    assert not replace(scene, cameras=("front", "wrist")).tried


def test_scene_after_scene_without_a_demonstration_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(demonstrations, "record", lambda *_: None)
    with pytest.raises(UserError, match="20 easy scenes in a row, to seed 19"):
        demonstrate([Group(first_scene(tmp_path), 3)])


def test_the_page_compares_every_model_with_the_one_without_memory(tmp_path: Path) -> None:
    def records(model: str, won: int, count: int, budget: int | None = None) -> list[EpisodeRecord]:
        return [
            EpisodeRecord(
                model,
                1,
                7,
                "VideoUnmask",
                2 * n,
                n,
                "easy",
                "success" if n < won else "timeout",
                9,
                split="further",
                memory_budget=budget,
            )
            for n in range(count)
        ]

    for model in ("framesamp_modul", "pi05", "ttt_modul"):
        (tmp_path / model).mkdir()
        write_json(tmp_path / model / TRAINED, {"off_by_m": [0.01, 0.02, 0.05]})
        (tmp_path / model / "metrics.jsonl").write_text('{"step": 10, "val/loss": 0.5}\n')
    words = ["task=VideoUnmask", "split=further", "demonstrations={easy: 4}", "policy_seed=7"]
    config = NanoRun.from_config(resolved(compose("nano", words)))
    video = tmp_path / "videos" / "a.mp4"
    runs = {
        "framesamp_modul": records("framesamp_modul", 60, 100, 4), "pi05": records("pi05", 5, 100),
        "ttt_modul": records("ttt_modul", 20, 50, 4), "planner": records("planner", 100, 100),
    }  # fmt: skip
    folders = {model: [tmp_path / model] for model in runs if model != "planner"}
    page = write_page(
        tmp_path, config, runs, "pi05", {"videos": 2.0, "planner": 0.0}, [video], folders, 7
    ).read_text()
    assert "| framesamp_modul | 4 | 60 % (60/100) | 50 … 69 % | 60/100 | 2.0 cm | 67 % |" in page
    assert "medium" not in page, "a column without episodes is left out"
    assert "Brackets: `planner`" in page and "once for seed 7 of" in page
    assert "| ttt_modul@4 − pi05 | 50 of 100 | 20 of 50 (40 %) |" in page
    assert "| planner |  | 100 % (100/100) |" in page and "| ttt_modul | 4 | 40 % (20/50) |" in page
    assert (
        "framesamp_modul@4 − pi05" in page
        and "ttt_modul@4 − pi05" in page
        and "videos/a.mp4" in page
    )
    lead = (
        "**framesamp_modul@4 60 of 100 against pi05 5 of 100: framesamp_modul@4 is significantly"
        " better (p < 0.001).**"
    )
    assert page.splitlines()[2] == lead, "what was found comes first"
    assert page.count("Incomplete") == 1 and "7 demonstrations" in page
    assert "| planner | 0.0 |" not in page, "a stage that did not run has no row"
    assert "| videos | 2.0 |" in page and (tmp_path / "learning.png").is_file()
    lines = outcome_lines(runs, ends_of(folders))
    assert lines[0] == (
        "framesamp_modul: off by 2.0 cm on held-out decisions, 60 of 100 episodes solved"
    )
    assert lines[-1] == "planner: 100 of 100 episodes solved"

    without = {"framesamp_modul": runs["framesamp_modul"]}
    folders = {"framesamp_modul": folders["framesamp_modul"]}
    page = write_page(tmp_path, config, without, None, {}, [], folders, 7).read_text()
    assert "planner" not in page and "noise. No policy without memory was run." in page


def test_a_run_without_held_out_losses_has_no_learning_curve(tmp_path):
    assert not plot_curves({"pi05": [{"step": 10, "loss": 0.5}]}, tmp_path / "learning.png")
    assert not (tmp_path / "learning.png").exists()
