"""Sharded processes learn what one process learns, whichever saves, resumes, stops or dies."""

import json
from pathlib import Path
from typing import Any

import pytest
import torch

from helpers import commands, sharded_runs
from helpers.sharded_runs import RUNS, trainer
from mme_vla.config.sections import read_section
from mme_vla.errors import UserError
from mme_vla.policy.base import Policy
from mme_vla.policy.run_folders import checkpoints_in, resolve_checkpoint
from mme_vla.testing.small import small_policy
from mme_vla.training.checkpoint import read_state
from mme_vla.training.logging import read_metrics
from mme_vla.training.settings import ParallelSettings
from mme_vla.training.shards import shard_files

CLOSE = 2e-6
"""Largest relative difference of losses that are added up in another order."""


def reply(folder: Path, what: str) -> Any:
    return json.loads((folder / f"{what}.json").read_text())


def losses(folder: Path, name: str = "train/loss") -> list[float]:
    return [line[name] for line in read_metrics(folder) if name in line]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two processes to step 4, one to 6, three to 8; two that are stopped, and two of which one is
    killed.

    Beside them one that did all 8.
    """
    folder = tmp_path_factory.mktemp("shared")
    done = commands.run("helpers.sharded_runs", str(folder), env={"OMP_NUM_THREADS": "1"})
    ended = reply(folder, "ended") if done.returncode == 0 else {}
    codes = [(1, -9) if "die" in what else (0,) * processes for processes, what in RUNS]
    assert [tuple(code) for code in ended.values()] == codes, (done.stdout + done.stderr)[-3000:]
    assert reply(folder, "go_on") == {"parts": 2, "finished": True}
    return folder


@pytest.mark.slow
def test_two_then_one_then_three_processes_learn_what_one_learns(folder: Path) -> None:
    assert len(losses(folder / "run")) == 8
    assert losses(folder / "run") == pytest.approx(losses(folder / "whole"), rel=CLOSE)
    norms = [losses(folder / name, "train/grad_norm") for name in ("run", "whole")]
    assert norms[0] == pytest.approx(norms[1], rel=1e-5)
    held_out = [losses(folder / name, "val/loss")[-1] for name in ("run", "whole")]
    assert held_out[0] == pytest.approx(held_out[1], rel=CLOSE)


@pytest.mark.slow
def test_the_averages_are_what_is_validated_and_saved(folder: Path) -> None:
    shared, alone = reply(folder, "resume"), reply(folder, "whole")
    assert shared == pytest.approx(alone, rel=CLOSE)
    assert abs(shared["raw"] - shared["average"]) > 1e-3
    parts = Policy.from_pretrained(resolve_checkpoint(folder / "run")).state_dict()
    for name, tensor in (
        Policy.from_pretrained(resolve_checkpoint(folder / "whole")).state_dict().items()
    ):
        # Adam divides by what may be all but zero: a few numbers differ more than the losses.
        assert (parts[name] - tensor).abs().float().mean() < 1e-6, name


@pytest.mark.slow
def test_each_process_holds_its_part_alone(folder: Path) -> None:
    assert reply(folder, "train")["held"] == pytest.approx(1 / 2, rel=0.05)


@pytest.mark.slow
def test_a_stop_signal_to_one_process_saves_what_all_hold(folder: Path) -> None:
    assert reply(folder, "stop") == {"finished": False, "signal": 15}
    checkpoint = resolve_checkpoint(folder / "stopped")
    assert (checkpoint.name, read_state(checkpoint)["shards"]) == ("step_000001", 2)
    Policy.from_pretrained(checkpoint)
    assert not list(checkpoint.parent.glob(".*"))


@pytest.mark.slow
def test_a_killed_process_ends_the_others(folder: Path) -> None:
    """Of the fixture's two the second killed itself; the first then ended with an error, which it
    compared.
    """
    assert reply(folder, "policies")
    assert not (folder / "die.json").exists()
    assert not checkpoints_in(folder / "killed" / "checkpoints")


@pytest.mark.slow
def test_every_kind_of_policy_learns_and_answers_the_same_shared(folder: Path) -> None:
    result = reply(folder, "policies")
    assert set(sharded_runs.MODELS) <= set(result)
    for name, one in result.items():
        assert one["shared"] == pytest.approx(one["alone"], rel=2e-5), name
        assert one["shared chunk"] == pytest.approx(
            one["alone chunk"], rel=1e-3 if "16" in name else 2e-5
        ), name
        assert one["again"] == one["shared"][2], name


@pytest.mark.slow
def test_an_incomplete_checkpoint_is_refused(folder: Path, tmp_path: Path) -> None:
    import shutil

    copy = tmp_path / "run"
    checkpoint = resolve_checkpoint(folder / "run")
    shutil.copytree(checkpoint, copy / "checkpoints" / checkpoint.name)
    files = shard_files(resolve_checkpoint(copy))
    content = bytearray(files[1].read_bytes())
    content[-9] ^= 1
    files[1].write_bytes(content)
    with pytest.raises(UserError, match=f"{files[1].name} is damaged"):
        trainer(copy, 8, resumed=True)
    files[1].unlink()
    with pytest.raises(UserError, match="holds 2 of the 3 files"):
        read_state(resolve_checkpoint(copy))


def test_what_cannot_be_shared_is_reported_in_words() -> None:
    with pytest.raises(UserError, match="torchrun"):
        ParallelSettings("fsdp").shards(torch.device("cpu"))
    with pytest.raises(UserError, match="Did you mean 'fsdp'"):
        read_section(ParallelSettings, {"strategy": "fspd"}, "train.parallel")
    with pytest.raises(
        UserError, match=r"train\.parallel\.replicate=0 must be a whole number, 1 or more"
    ):
        read_section(ParallelSettings, {"replicate": 0}, "train.parallel")
    assert not ParallelSettings().shards(torch.device("cpu"))


def test_what_is_gathered_together_is_not_counted_twice() -> None:
    policy = small_policy("framesamp_expert")
    groups = [id(group.module) for group in policy.shard_groups()]
    inside = [id(p) for group in policy.shard_groups() for p in group.module.parameters()]
    assert len(groups) == len(set(groups)) == 2 + policy.backbone.config.depth
    assert len(inside) == len(set(inside))
