"""Several processes of a launcher train one policy, or are refused; a model that is wrapped
exchanges its gradients.
"""

import json
from pathlib import Path

import pytest
import torch
from torch.func import functional_call

from helpers import commands
from helpers.tiers import slow_or_nightly
from mme_vla import cli
from mme_vla.cli import check_launcher
from mme_vla.cli.train import check_processes
from mme_vla.errors import UserError
from mme_vla.model import MMEModel
from mme_vla.testing.small import SMALL_VISION, random_batch, small_policy
from mme_vla.utils import started_processes

TORCHRUN = ("torch.distributed.run", "--nproc-per-node", "2", "--master-port")
TINY = (
    "backbone=tiny",
    "backbone.vision.depth=1",
    "backbone.vision.image_size=16",
    "backbone.vision.patch_size=1",
)


def small_model() -> tuple[MMEModel, tuple]:
    policy = small_policy("framesamp_modul", backbone={"vision": SMALL_VISION})
    model = MMEModel(policy.backbone, policy.memory, policy.integration)
    return model, (random_batch(policy), model.training_noise(2, torch.Generator().manual_seed(0)))


def test_calling_a_model_gives_its_loss_also_functionally_and_on_the_meta_of_a_wrapper() -> None:
    model, arguments = small_model()
    loss = model.loss(*arguments)
    assert torch.equal(model(*arguments), loss)
    assert torch.equal(functional_call(model, dict(model.named_parameters()), arguments), loss)
    assert torch.equal(torch.nn.DataParallel(model, device_ids=[])(*arguments), loss)


def test_hooks_of_a_model_run_when_it_is_called() -> None:
    model, arguments = small_model()
    seen: list[torch.Tensor] = []
    model.register_forward_hook(lambda module, inputs, output: seen.append(output))
    model(*arguments)
    assert len(seen) == 1


@pytest.mark.parametrize(
    ("kind", "port"),
    slow_or_nightly([("ddp", "29613"), ("fsdp", "29614")], lambda case: case[0] == "fsdp"),
)
def test_two_processes_exchange_the_gradients_of_a_model_that_is_called(
    kind: str, port: str, tmp_path: Path
) -> None:
    script = str(Path(commands.__file__).with_name("ddp_gradients.py"))
    done = commands.run(*TORCHRUN, port, script, kind, str(tmp_path), env={"OMP_NUM_THREADS": "1"})
    assert done.returncode == 0, done.stderr[-3000:]
    first, second = (torch.load(tmp_path / f"{rank}.pt", weights_only=True) for rank in (0, 1))
    assert first.abs().max() > 0 and torch.equal(first, second)


@pytest.mark.slow
def test_two_processes_without_a_gpu_train_one_policy(tmp_path: Path) -> None:
    words = (
        "model=pi05",
        *TINY,
        "train.steps=2",
        "train.batch_size=2",
        f"output={tmp_path / 'run'}",
    )
    done = commands.run(
        *TORCHRUN, "29615", "-m", "mme_vla.train", *words, env={"CUDA_VISIBLE_DEVICES": ""}
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert "2 × " in done.stdout
    runs = sorted(path.parent for path in tmp_path.rglob("summary.json"))
    assert runs == [tmp_path / "run"]
    assert json.loads((runs[0] / "summary.json").read_text())


def test_processes_that_would_train_apart_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WORLD_SIZE", "2")
    check_processes(2)
    with pytest.raises(UserError, match=r"started 2 processes \(WORLD_SIZE\), and each counts 1"):
        check_processes(1)
    monkeypatch.delenv("WORLD_SIZE")
    check_processes(1)


ALONE = {name for name, command in cli.commands().items() if command.processes == "one"}


@pytest.mark.parametrize("name", sorted(ALONE))
def test_commands_that_share_no_work_are_refused_under_a_launcher(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WORLD_SIZE", "2")
    with pytest.raises(UserError, match="would do all of this command"):
        check_launcher(name)
    monkeypatch.setenv("WORLD_SIZE", "1")
    check_launcher(name)


@pytest.mark.parametrize("name", sorted(set(cli.commands()) - ALONE))
def test_commands_that_share_their_work_or_only_read_start_under_a_launcher(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WORLD_SIZE", "8")
    check_launcher(name)


@pytest.mark.parametrize("world", ["two", "0", "-1", ""])
def test_a_number_of_processes_that_is_none_is_refused(world: str) -> None:
    with pytest.raises(UserError, match="no count of processes"):
        started_processes({"WORLD_SIZE": world})


def test_a_launcher_that_started_one_process_of_several_is_refused() -> None:
    cpu = {"ACCELERATE_USE_CPU": "True"}
    assert started_processes(cpu) == 1  # one was asked for
    assert started_processes({**cpu, "MASTER_ADDR": "127.0.0.1", "WORLD_SIZE": "2"}) == 2
    assert started_processes({**cpu, "MASTER_ADDR": "127.0.0.1", "PMI_SIZE": "2"}) == 1
    with pytest.raises(UserError, match="torchrun"):
        started_processes({**cpu, "MASTER_ADDR": "127.0.0.1"})
