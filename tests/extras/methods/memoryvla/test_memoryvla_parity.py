"""MemoryVLA: the original's modules, banks, head, training loss and acting, at the golden network's
size.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from helpers.baselines import arrays, baselines_folder, relative_error
from helpers.memoryvla_golden import bank, core, golden_name
from mme_vla.extras.methods.memoryvla.action_head import Schedule
from mme_vla.extras.methods.memoryvla.bank import BankState, EpisodeBank
from mme_vla.extras.methods.memoryvla.model import MemoryVlaCore, cognition_token

TOLERANCE, LONG = (
    1e-4,
    1e-3,
)  # of the largest entry: single modules; gradients, ten steps of sampling, acting
ROLES = ["cog", "per"]


@pytest.fixture(scope="module")
def folder() -> Path:
    return baselines_folder("memoryvla")


@pytest.fixture(scope="module")
def meta(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "meta.json").read_text())  # type: ignore[no-any-return]


@pytest.fixture(scope="module")
def weights(folder: Path) -> dict[str, Tensor]:
    return arrays(folder, "weights")


@pytest.fixture
def network(meta: dict[str, Any], weights: dict[str, Tensor]) -> MemoryVlaCore:
    return core(meta["sizes"], weights)


def near(ours: Tensor, golden: Tensor, tolerance: float = TOLERANCE) -> None:
    assert relative_error(ours, golden) <= tolerance


@torch.no_grad()
def test_memoryvla_modules(folder: Path, network: MemoryVlaCore) -> None:
    golden = arrays(folder, "modules")
    features = golden["se/in"]
    reduced = network.compression.reduced(features)
    near(reduced.transpose(1, 2).reshape(golden["se/reduced"].shape), golden["se/reduced"])
    near(network.compression.weights(reduced)[..., None, None], golden["se/excite"])
    near(network.compression(features), golden["se/out"])
    for role, one in (("cog", network.cognition_bank), ("per", network.perceptual_bank)):
        assert one.time is not None
        near(one.time.features(golden[f"{role}/time/in"]), golden[f"{role}/time/frequencies"])
        near(one.time(golden[f"{role}/time/in"]), golden[f"{role}/time/out"])
        block = [golden[f"{role}/block/{name}"] for name in ("query", "key", "value")]
        near(one.blocks[0](*block), golden[f"{role}/block/out"])
        near(
            one.fuse(golden[f"{role}/gate/a"], golden[f"{role}/gate/b"]), golden[f"{role}/gate/out"]
        )


def stepwise(
    one: EpisodeBank, tokens: Tensor, times: Tensor, ids: Tensor
) -> list[tuple[Tensor, Tensor, BankState]]:
    """Each moment's retrieved and fused tokens and the bank of its episode after it."""
    states: dict[int, BankState] = {}
    out = []
    for moment, time, episode in zip(tokens, times.tolist(), ids.tolist(), strict=True):
        state = states.get(episode, one.init_state(tokens.shape[1]))
        retrieved = one.retrieve([state], moment[None])[0]
        fused = one.read([state], moment[None])[0]
        states[episode] = one.update(state, moment, fused, time)
        out.append((retrieved, fused, states[episode]))
    return out


@pytest.mark.parametrize("role", ROLES)
@torch.no_grad()
def test_memoryvla_banks_of_every_kind(
    folder: Path, meta: dict[str, Any], weights: Any, role: str
) -> None:
    golden = arrays(folder, "bank")
    for name, options in meta["cases"].items():
        if not name.startswith("bank/"):
            continue
        kind = f"{role}/{name.removeprefix('bank/')}"
        one = bank(meta["sizes"], role, weights, options)
        tokens, times = golden[f"{role}/tokens"], golden[f"{role}/times"]
        steps = stepwise(one, tokens, times, torch.zeros_like(times))
        near(torch.stack([fused for _, fused, _ in steps]), golden[f"{kind}/fused"])
        if f"{kind}/retrieved" in golden:
            near(torch.stack([retrieved for retrieved, _, _ in steps]), golden[f"{kind}/retrieved"])
        compare_banks(golden, kind, [state for _, _, state in steps])


def compare_banks(golden: dict[str, Tensor], kind: str, states: list[BankState]) -> None:
    stored = golden[f"{kind}/bank_times"]
    for i, state in enumerate(states):
        assert len(state) == int(golden[f"{kind}/count"][i])
        if int(stored[i].min()) >= -1:
            # −2: the original keeps no time there, and its record no merges
            assert state.merged == int(golden[f"{kind}/merged_at"][i])
            assert state.times.tolist() == stored[i][: len(state)].tolist()
        if f"{kind}/bank_feats" in golden:
            near(state.entries, golden[f"{kind}/bank_feats"][i, : len(state)])


@pytest.mark.parametrize("role", ROLES)
@torch.no_grad()
def test_memoryvla_episodes_interleaved_do_not_meet(
    folder: Path, meta: dict[str, Any], weights: Any, role: str
) -> None:
    golden, kind = arrays(folder, "bank"), f"{role}/interleaved"
    one = bank(meta["sizes"], role, weights)
    tokens, times, ids = (golden[f"{kind}/{name}"] for name in ("tokens", "times", "ids"))
    steps = stepwise(one, tokens, times, ids)
    near(torch.stack([fused for _, fused, _ in steps]), golden[f"{kind}/fused"])
    compare_banks(golden, kind, [state for _, _, state in steps])


@pytest.mark.parametrize("case", ["group", "group_same_id"])
@pytest.mark.parametrize("role", ROLES)
def test_memoryvla_groups_of_a_batch_and_their_gradients(
    folder: Path, meta: dict[str, Any], weights: Any, role: str, case: str
) -> None:
    golden, kind = arrays(folder, "bank"), f"{role}/{case}"
    one = bank(meta["sizes"], role, weights)
    tokens = golden[f"{kind}/tokens"].clone().requires_grad_()
    fused, _ = one.run(
        tokens,
        golden[f"{kind}/times"],
        torch.arange(len(tokens)).split(meta["sizes"]["group_size"]),
    )
    near(fused, golden[f"{kind}/fused"])
    (fused * golden[f"{kind}/cotangent"]).sum().backward()
    assert tokens.grad is not None
    near(tokens.grad, golden[f"{kind}/grad_tokens"], LONG)
    word = {"cog": "cognition_bank", "per": "perceptual_bank"}[role]
    gradients_ = {
        golden_name(f"{word}.{n}").split(".", 1)[1]: p.grad for n, p in one.named_parameters()
    }
    stored = [name for name in golden if name.startswith(f"{kind}/grad/")]
    assert stored
    for name in stored:
        near(gradients_[name.removeprefix(f"{kind}/grad/")], golden[name], LONG)  # type: ignore[arg-type]
    for name, norm in meta["cases"][f"{kind}/grad_l2"].items():
        assert gradients_[name].norm().item() == pytest.approx(norm, rel=LONG), name  # type: ignore[union-attr]


@pytest.mark.parametrize("role", ROLES)
@torch.no_grad()
def test_memoryvla_streams_live_across_batches(
    folder: Path, meta: dict[str, Any], weights: Any, role: str
) -> None:
    golden = arrays(folder, "bank")
    one = bank(meta["sizes"], role, weights)
    episode, state = None, one.init_state(golden[f"{role}/tokens"].shape[1])
    batches = sorted({name.split("/")[1] for name in golden if name.startswith(f"{role}/stream")})
    assert len(batches) > 1
    for name in batches:
        tokens, times, ids = (
            golden[f"{role}/{name}/{what}"] for what in ("tokens", "times", "ids")
        )
        places = torch.arange(len(ids)).split(
            torch.unique_consecutive(ids, return_counts=True)[1].tolist()
        )
        fused = []
        for run in places:
            if int(ids[run[0]]) != episode:
                state = one.init_state(tokens.shape[1])
            output, (state,) = one.run(tokens[run], times[run], [torch.arange(len(run))], [state])
            fused.append(output)
            episode = int(ids[run[0]])
        near(torch.cat(fused), golden[f"{role}/{name}/fused"])
        assert golden[f"{role}/{name}/episodes_left"].tolist() == [episode]


def test_memoryvla_schedule(folder: Path) -> None:
    golden = arrays(folder, "dit")
    schedule = Schedule.cosine(len(golden["schedule/betas"]))
    np.testing.assert_allclose(schedule.betas, golden["schedule/betas"], rtol=1e-12)
    np.testing.assert_allclose(
        schedule.alphas_cumprod, golden["schedule/alphas_cumprod"], rtol=1e-12
    )
    counts = {
        int(name.split("/")[1].removeprefix("ddim"))
        for name in golden
        if name.startswith("schedule/ddim")
    }
    for count in counts:
        visited = schedule.ddim_steps(count)
        assert sorted(golden[f"schedule/ddim{count}/timesteps"].tolist()) == visited.tolist()
        left = np.sort(golden[f"schedule/ddim{count}/alphas_cumprod"].numpy())[::-1]
        np.testing.assert_allclose(schedule.alphas_cumprod[visited], left, rtol=1e-12)
        before = np.sort(golden[f"schedule/ddim{count}/alphas_cumprod_prev"].numpy())[::-1]
        np.testing.assert_allclose([1, *schedule.alphas_cumprod[visited[:-1]]], before, rtol=1e-12)


@torch.no_grad()
def test_memoryvla_head_stage_by_stage(folder: Path, network: MemoryVlaCore) -> None:
    golden, head = arrays(folder, "dit"), network.head
    x, t, z, per = (golden[f"net/{name}"] for name in ("x", "t", "z", "per"))
    tokens = head.tokens(x, t, z)
    near(tokens, golden["net/tokens"])
    perceptual = head.perceptual(per)
    for i, block in enumerate(head.blocks):
        tokens = block(tokens, perceptual)
        near(tokens, golden[f"net/block{i}"])
    near(head(x, t, z, per), golden["net/eps"])
    for name in (name for name in golden if name.startswith("cfg/eps_")):
        scale = float(name.removeprefix("cfg/eps_"))
        near(head.guided(x, t, z, per, scale), golden[name])


def test_memoryvla_head_loss_and_gradients(
    folder: Path, meta: dict[str, Any], network: MemoryVlaCore
) -> None:
    golden = arrays(folder, "dit")
    net = {name: golden[f"net/{name}"].clone().requires_grad_() for name in ("z", "per")}
    draws = {
        "noise": golden["loss/noise"],
        "steps": golden["loss/steps"],
        "drop": golden["loss/drop_draw"],
    }
    near(
        network.schedule.noised(golden["loss/actions"], draws["noise"], draws["steps"]),
        golden["loss/x_t"],
    )
    loss = network.noise_error(golden["loss/actions"], net["z"], net["per"], draws).mean()
    near(loss, golden["loss/value"])
    loss.backward()
    for name, tensor in net.items():
        near(tensor.grad, golden[f"loss/grad_{name}"], LONG)  # type: ignore[arg-type]
    gradients(golden, "loss/grad/", meta["cases"]["dit/loss/grad_l2"], network, "action_model.")


def gradients(
    golden: dict[str, Tensor], stored: str, norms: dict[str, float], network: Any, prefix: str = ""
) -> None:
    grads = {
        golden_name(name): p.grad for name, p in network.named_parameters() if p.grad is not None
    }
    for name in (name for name in golden if name.startswith(stored)):
        actual = grads[prefix + name.removeprefix(stored)]
        near(actual.reshape(golden[name].shape), golden[name], LONG)
    for name, norm in norms.items():
        full = name if name in grads else prefix + name
        assert grads[full].norm().item() == pytest.approx(norm, rel=LONG, abs=1e-9), name


@torch.no_grad()
def test_memoryvla_sampling_path(folder: Path, network: MemoryVlaCore) -> None:
    golden = arrays(folder, "dit")
    z, per = golden["net/z"], golden["net/per"]
    cases = [name for name in golden if name.startswith("sample/ddim")]
    assert cases
    for name in cases:
        count, scale = name.split("/")[1].removeprefix("ddim").split("_cfg")

        def predict(x: Tensor, step: int, scale: float = float(scale)) -> Tensor:
            return network.head.guided(x, torch.full((len(x),), step), z, per, scale)

        path = network.schedule.ddim(golden["sample/start"], int(count), predict)
        near(torch.stack(path), golden[name], LONG)


def test_memoryvla_training_loss_over_two_groups(
    folder: Path, meta: dict[str, Any], network: MemoryVlaCore
) -> None:
    golden = {
        n.removeprefix("train/"): v
        for n, v in arrays(folder, "policy").items()
        if n.startswith("train/")
    }
    hidden, vision = (
        golden["hidden"].clone().requires_grad_(),
        golden["vision"].clone().requires_grad_(),
    )
    cognition = cognition_token(hidden, meta["sizes"]["patches"], golden["attention_mask"].sum(1))
    draws = {"noise": golden["noise"], "steps": golden["steps"], "drop": golden["drop_draw"]}
    groups = torch.arange(len(hidden)).split(meta["sizes"]["group_size"])
    read = network.through(cognition, vision, golden["times"], groups)
    loss = network.noise_error(golden["actions"], *read, draws).mean()
    near(loss, golden["loss"])
    loss.backward()
    near(hidden.grad, golden["grad_hidden"], LONG)  # type: ignore[arg-type]
    near(vision.grad, golden["grad_vision"], LONG)  # type: ignore[arg-type]
    gradients(golden, "grad/", meta["cases"]["policy/train/grad_l2"], network)


@torch.no_grad()
def test_memoryvla_acting_over_a_stream(
    folder: Path, meta: dict[str, Any], network: MemoryVlaCore
) -> None:
    golden = {
        n.removeprefix("act/"): v
        for n, v in arrays(folder, "policy").items()
        if n.startswith("act/")
    }
    state = network.init_state()
    samples = []
    for i in range(len(golden["hidden"])):
        if golden["first"][i]:
            state = network.init_state()
        cognition, vision = golden["hidden"][i : i + 1, -1:], golden["vision"][i : i + 1]
        before = network.read_banks([state], cognition, vision)
        samples.append(network.sample(golden["noise"][i], *before)[0])
        state = network.store(state, cognition[0], vision[0])
    near(torch.stack(samples), golden["samples"], LONG)
    assert state.cognition.times.tolist() == golden["bank_times_cog"].tolist()
    assert state.perceptual.times.tolist() == golden["bank_times_per"].tolist()
