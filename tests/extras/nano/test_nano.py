"""The nano backbone, its tower and its tokens; and what stands between demonstrations
and training.
"""

import hashlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from helpers.nano_policies import EVERY_EIGHTH, demonstration, nano
from mme_vla import UserError, build_policy
from mme_vla.data.waypoints import Motions
from mme_vla.envs.facts import Fact
from mme_vla.extras.nano.cli import nano as nano_command
from mme_vla.extras.nano.cli.nano import with_settings
from mme_vla.extras.nano.demonstrations import Demonstration
from mme_vla.extras.nano.learning import Decisions, statistics
from mme_vla.extras.nano.runs import counts_of
from mme_vla.extras.nano.tower import CLASSES, by_class, summarise
from mme_vla.memory.perturbation import Pause
from mme_vla.policy.mme import MMEPolicy
from mme_vla.policy.run_folders import resolve_checkpoint, shipped_checkpoints
from mme_vla.testing import check_backbone
from mme_vla.types import Batch

SMALL = {
    "vision": {"image_size": 32, "width_32": 8, "width_16": 8, "width_8": 8, "pretrained": False},
    "vlm": {"width": 16, "mlp_dim": 16},
    "action": {"width": 16, "mlp_dim": 16},
    "num_heads": 2,
    "head_dim": 8,
    "vocab_size": 64,
}


def test_it_keeps_a_backbones_contract() -> None:
    check_backbone("nano", **SMALL)


def test_more_cameras_or_words_than_it_has_places_for_are_refused() -> None:
    policy = build_policy("pi05", backbone="nano")
    batch = policy.full_batch()
    views = batch.images[:, :1].expand(-1, 5, -1, -1, -1)
    with pytest.raises(UserError, match=r"takes 4 cameras; embodiment\.cameras names 5"):
        policy.backbone.embed(
            replace(batch, images=views, image_mask=batch.image_mask[:, :1].expand(-1, 5))
        )
    with pytest.raises(UserError, match="reads 256 tokens of a prompt, and this one has 300"):
        policy.backbone.embed(replace(batch, prompt=torch.ones(1, 300, dtype=torch.int64)))


def test_a_demonstration_is_read_as_it_was_saved(tmp_path: Path) -> None:
    made = replace(demonstration(), boundaries=np.array([0, 66]))
    made.save(tmp_path / "a.npz")
    read = Demonstration.load(tmp_path / "a.npz")
    assert (read.goal, read.length, read.exec_start) == (made.goal, made.length, made.exec_start)
    assert read.boundaries.tolist() == [0, 66]
    assert read.facts == made.facts and made.facts
    replace(made, facts=None).save(tmp_path / "earlier.npz")
    assert Demonstration.load(tmp_path / "earlier.npz").facts is None
    assert (
        np.array_equal(read.motions.targets, made.motions.targets)
        and read.subgoals == made.subgoals
    )
    assert list(read.images) == ["front"] and np.array_equal(
        read.images["front"][66], made.images["front"][66]
    )


def test_a_memory_learns_from_the_sub_tasks_of_demonstrations() -> None:
    policy = nano("keyframes_modul", memory={"budget": 4, "grid": 1, "every": 8, "pool": 8})
    read = policy.frames_read(np.array([66, 120, 155]), 66).tolist()
    made = replace(
        demonstration(tuple(sorted({*read, 66, 120, 155}))), boundaries=np.array([0, 30, 66, 121])
    )
    policy.require_processor().stats = statistics([made], policy)

    def labels(
        batch: Batch, begins: tuple[int, ...] = (0, 30, 66, 121)
    ) -> tuple[list[float], list[float]]:
        """What is learned, and what the times of the tokens would say."""
        assert batch.history is not None
        valid = batch.history.mask[0]
        naive = (batch.history.positions[0, valid, :1] >= torch.tensor(begins)).sum(1)
        return batch.history.labels["subtask_index"][0, valid].tolist(), naive.tolist()

    learned, naive = labels(Decisions.of(policy, [made]).collate([2]))
    assert learned == naive and set(learned) == {1, 2, 3, 4}
    batch = Decisions.of(policy, [made], transforms=[Pause(400)]).collate([2])
    learned, naive = labels(batch)
    assert learned != naive and learned == sorted(learned) and learned[-1] == 4, (
        "of the recorded frames"
    )
    assert (
        "losses/write"
        in policy.train()(batch, policy.training_noise(1, torch.Generator().manual_seed(0)))[1]
    )


def test_a_memory_learns_from_the_facts_of_demonstrations() -> None:
    size = {"budget": 4, "grid": 1, "every": 8, "pool": 8, "label": "fact_index"}
    policy = nano("keyframes_modul", memory=size)
    read = policy.frames_read(np.array([66, 120, 155]), 66).tolist()
    made = demonstration(tuple(sorted({*read, 66, 120, 155})))
    facts = [Fact("b", "2", (60, 70)), Fact("a", "1", (10, 20))]
    made = replace(made, facts=facts)
    policy.require_processor().stats = statistics([made], policy)
    batch = Decisions.of(policy, [made]).collate([2])
    assert batch.history is not None
    valid = batch.history.mask[0]
    frames = batch.history.positions[0, valid, 0]
    expected = (frames >= 10).int() + (frames >= 60).int()
    assert batch.history.labels["fact_index"][0, valid].tolist() == expected.tolist()


def test_a_frame_that_was_not_rendered_is_refused() -> None:
    policy = nano()
    policy.require_processor().stats = statistics([demonstration()], policy)
    with pytest.raises(UserError, match=r"\[39\]"):
        Decisions.of(policy, [demonstration((0, 15, 47, 63, 66, 79, 95, 119, 120, 151, 155))])


def test_tokens_made_beforehand_give_the_loss_of_the_images() -> None:
    policy, made = nano("pi05").eval(), demonstration()
    processor = policy.require_processor()
    processor.stats = statistics([made], policy)
    batch = Decisions.of(policy, [made]).collate([0, 1, 2])
    images = processor.images([np.stack([made.images["front"][frame] for frame in (66, 120, 155)])])
    draws = policy.training_noise(3, torch.Generator().manual_seed(0))
    with torch.no_grad():
        ready, from_images = (
            policy(batch, draws)[0],
            policy(replace(batch, images=images, view_tokens=None), draws)[0],
        )
    assert torch.allclose(ready, from_images, atol=1e-3)  # tokens are kept as float16


@pytest.mark.parametrize(
    ("counts", "words"), [({"easy": 1}, "takes two"), ({"simple": 4}, "easy"), ({}, "two")]
)
def test_demonstrations_are_counted_by_difficulty(counts: object, words: str) -> None:
    with pytest.raises(UserError, match=words):
        counts_of("StopCube", counts, {})  # type: ignore[arg-type]
    tasks = ["StopCube", "BinFill"]
    assert counts_of(tasks, {"easy": 2}, {"BinFill": {"hard": 1}}) == {
        ("StopCube", "easy"): 2,
        ("BinFill", "easy"): 2,
        ("BinFill", "hard"): 1,
    }
    assert counts_of(tasks, {"easy": 2}, None) == {
        ("StopCube", "easy"): 2,
        ("BinFill", "easy"): 2,
    }


def test_a_tasks_settings_come_with_its_name_unless_others_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = {name: tmp_path / f"{name}.yaml" for name in ("StopCube", "nano16")}
    monkeypatch.setattr(nano_command, "library_files", lambda group: files)
    assert with_settings(["task=StopCube", "seed=1"]) == [
        "nano=StopCube",
        "task=StopCube",
        "seed=1",
    ]
    assert with_settings(["model=ttt_modul"]) == ["nano=nano16", "with_memory=ttt_modul", "also=[]"]
    for words in (["task=BinFill"], ["task=StopCube", "nano=mine"]):
        assert with_settings(words) == words
    assert with_settings(["task=StopCube", "nano=null"]) == ["task=StopCube"]


def test_the_policy_that_ships_has_four_memory_tokens_and_acts() -> None:
    policy = MMEPolicy.from_pretrained("nano")
    assert policy.require_memory().budget == 4
    made = demonstration()
    episode = policy.start_episode(made.goal)
    frames = np.stack(
        [made.images["front"].get(frame, made.images["front"][0]) for frame in range(67)]
    )
    episode.observe({"front": frames}, made.states[:67], is_demo=np.arange(67) < 66)
    assert policy.act(episode).shape == (4, 7)


@pytest.mark.parametrize("name", shipped_checkpoints())
def test_shipped_checkpoints_are_small_and_whole(name: str) -> None:
    folder = resolve_checkpoint(Path(name))
    lines = [line.split() for line in (folder / "SHA256SUMS").read_text().splitlines()]
    for digest, file in lines:
        assert hashlib.sha256((folder / file).read_bytes()).hexdigest() == digest, file
    assert sum(path.stat().st_size for path in folder.iterdir()) <= 20e6
    assert MMEPolicy.from_pretrained(name).require_processor().stats is not None


def test_a_folder_that_hides_a_shipped_checkpoint_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "nano16").mkdir()
    with pytest.raises(UserError, match="hides the one that ships under this name"):
        resolve_checkpoint(Path("nano16"))


def test_policies_of_earlier_versions_highlight_what_the_goal_names_in_images_and_memory() -> None:
    policy = MMEPolicy.from_pretrained("nano")
    assert policy.backbone.config.goal == "swap"
    backbone, processor = policy.backbone, policy.require_processor()
    ids, mask = processor.prompt(
        "pick up the container hiding the green cube, then the one hiding the red cube"
    )
    unmarked, unmarked_mask = processor.prompt("press the button")
    tokens = torch.arange(96.0).expand(2, 3, 96)
    annotated = backbone.condition_on_prompt(
        tokens, torch.stack([ids, unmarked]), torch.stack([mask, unmarked_mask])
    )
    assert annotated[0, 0, [1, 2, 13, 14, 60]].tolist() == [2, 1, 14, 13, 60]
    assert torch.equal(annotated[1], tokens[1])


def test_the_goal_selects_classes_by_its_words_and_not_by_what_is_behind_them() -> None:
    policy = nano("pi05")
    backbone, processor = policy.backbone, policy.require_processor()
    goals = ["pick up the red cube", "pick up the green cube"]
    ids, masks = (torch.stack(part) for part in zip(*map(processor.prompt, goals), strict=True))
    tokens, reader = torch.rand(2, 3, backbone.vision_width), backbone.goal_reader
    with torch.no_grad():
        # Small ones: a query that is certain would select the same class for both goals.
        reader.votes.weight.normal_(0.0, 0.02, generator=torch.Generator().manual_seed(0))
        read = backbone.condition_on_prompt(tokens, ids, masks)
        padded = backbone.condition_on_prompt(tokens, torch.where(masks, ids, 7), masks)
        selected = reader(ids, masks)
    width = backbone.vision.token_width
    assert torch.equal(read, padded) and torch.equal(read[..., :width], tokens[..., :width])
    expected = torch.einsum("bqk,bnkf->bnqf", selected, by_class(tokens)).flatten(-2)
    assert torch.allclose(read[..., width:], expected) and torch.allclose(
        selected.sum(-1), torch.tensor(1.0)
    )
    assert not torch.allclose(selected[0], selected[1])


def test_half_of_the_queries_tell_which_class_is_named_first() -> None:
    backbone, processor = nano("pi05").backbone, nano("pi05").require_processor()
    reader = backbone.goal_reader
    (red, _), (green, _) = (processor.prompt(f"the {colour} cube") for colour in ("red", "green"))
    word = int((red != green).nonzero()[0, 0])
    with torch.no_grad():
        reader.preference.zero_()
        reader.votes.weight[red[word], 1], reader.votes.weight[green[word], 2] = 1.0, 1.0
        selected = reader(
            *(part[None] for part in processor.prompt("the red cube and the green cube"))
        )[0]
    assert torch.allclose(selected[::2, 1], selected[::2, 2])
    assert (selected[1::2, 1] > 2 * selected[1::2, 2]).all()


def test_only_decisions_whose_goal_names_no_side_are_reflected() -> None:
    words = {
        "backbone": "nano_choice",
        "embodiment": "robomme_choice_front",
        "policy": {"augment": False},
    }
    policy = build_policy("framesamp_modul", memory=EVERY_EIGHTH, **words)
    made = demonstration()
    choices = np.zeros((3, 10), np.float32)
    choices[:, 0], choices[:, 8:] = 1, [[0.3, 0.4], [0.2, 0.6], [0.35, 0.5]]
    made = replace(made, motions=Motions(made.motions.decisions, choices))
    policy.require_processor().stats = statistics([made], policy)
    left = replace(made, goal=f"{made.goal} on the left")
    samples = Decisions.of(policy, [made, left], reflect_p=0.99, sides=["left"])
    rows = range(len(samples.batch.prompt))
    batch, half = samples.collate(list(rows)), len(rows) // 2
    assert not torch.equal(batch.actions[:half], samples.batch.actions[:half])
    assert not torch.equal(batch.history.features[:half], samples.batch.history.features[:half])
    assert torch.equal(batch.view_tokens[half:], samples.batch.view_tokens[half:])
    assert torch.equal(batch.actions[half:], samples.batch.actions[half:])
    assert torch.equal(batch.state, samples.batch.state)
    joints = build_policy("actions_modul", **words)
    joints.require_processor().stats = statistics([made], joints)
    assert Decisions.of(joints, [made], reflect_p=0.99, sides=[]).reflection is None
    motions = nano("pi05")
    motions.require_processor().stats = statistics([demonstration()], motions)
    with pytest.raises(UserError, match=r"learning\.reflect=0\.5 needs a point"):
        Decisions.of(motions, [demonstration()], reflect_p=0.5, sides=[])


def test_features_of_a_class_are_those_that_the_tower_gives_it() -> None:
    presence, offsets = (
        torch.zeros(1, len(CLASSES), 32, 32),
        torch.zeros(1, len(CLASSES), 2, 32, 32),
    )
    presence[:, 3, 8:10, 8:10] = 1
    features = by_class(summarise(presence, offsets))
    assert features.shape == (1, 64, len(CLASSES), 20)
    assert (
        features[:, :, 3].abs().sum() > 0
        and features[:, :, [i for i in range(len(CLASSES)) if i != 3]].abs().sum() == 0
    )
