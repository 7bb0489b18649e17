"""`diffusion_policy` computes what its authors' code computes: golden cases of their modules,
losses and samples.
"""

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from helpers.baselines import baselines_folder, case, relative_error, rule_weight

pytest.importorskip("diffusers")

from mme_vla.embodiment.robomme import ROBOMME_JOINT
from mme_vla.extras.methods.diffusion_policy import model
from mme_vla.extras.methods.diffusion_policy.model import (
    ConditionedUnit,
    SpatialSoftmax,
    StepSinusoid,
    cell_centres,
)
from mme_vla.extras.methods.diffusion_policy.policy import DiffusionPolicy
from mme_vla.extras.methods.diffusion_policy.processor import DiffusionBatch, text_features
from mme_vla.extras.methods.diffusion_policy.weights import diffusion_adapter
from mme_vla.policy.build import build_policy
from mme_vla.processing.normalise import (
    NormStats,
    QuantileStats,
    RunningStats,
    normalize,
    unnormalize,
)
from mme_vla.training.optim import EMA, clip_gradients, make_optimizer, scheduled_rate
from mme_vla.training.settings import TrainSettings

SINGLE, SAMPLES, GRADIENTS = 2e-5, 1e-4, 5e-3  # a CPU without AVX-512 has gradients 2e-3 away


@pytest.fixture(scope="module")
def folder() -> Path:
    return baselines_folder("diffusion_policy")


def models(folder: Path) -> list[str]:
    return sorted(path.stem for path in folder.glob("model_obs*.json"))


def close(actual: Tensor, expected: Tensor, tolerance: float = SINGLE) -> None:
    assert relative_error(actual, expected) <= tolerance


def built(about: dict[str, Any]) -> DiffusionPolicy:
    """The policy of a golden case, its sizes from the case's description and its
    weights by rule.
    """
    options = about["config"]
    shape, (state,), (action,) = (
        options["shape_meta"][name]["shape"] for name in ("image", "state", "action")
    )
    policy = build_policy(
        "diffusion_policy",
        backbone={
            "picture": shape[1:],
            "crop": options["image_aug"]["crop_ratio"],
            "keypoints": options["obs_encoder"]["num_kp"],
            "text_dim": options["text_embed_dim"],
            "text_hidden": options["text_mlp_hidden"],
            "text_width": options["text_proj_dim"],
            "widths": options["down_dims"],
            "kernel": options["kernel_size"],
            "groups": options["n_groups"],
            "step_width": options["diffusion_step_embed_dim"],
            "diffusion_steps": options["noise_scheduler"]["num_train_timesteps"],
        },
        embodiment={
            "state": {"width": state},
            "action": {
                "width": action,
                "names": None,
                "units": None,
                "horizon": options["action_pred_horizon"],
                "execute": options["action_exec_horizon"],
            },
        },
        processor={"window": options["obs_horizon"]},
    )
    assert isinstance(policy, DiffusionPolicy)
    weights = {
        name: rule_weight(name, tuple(of), about["weight_seed"])
        for name, of in about["parameters"].items()
    }
    adapter = diffusion_adapter(policy)
    policy.load_state_dict(adapter.translate(weights, policy.state_dict(), "the golden case"))
    return policy


def batch_of(arrays: dict[str, Tensor], policy: DiffusionPolicy) -> DiffusionBatch:
    images = arrays["in/image"].unflatten(2, (2, 3))
    text = arrays["in/text_emb"][:, 0] if arrays["in/text_emb"].ndim == 3 else arrays["in/text_emb"]
    return DiffusionBatch(images, arrays["in/state"], text, arrays["in/action"])


@pytest.fixture(scope="module")
def golden(folder: Path) -> dict[str, tuple[DiffusionPolicy, dict[str, Tensor], dict[str, Any]]]:
    cases = {}
    for name in models(folder):
        arrays, about = case(folder, name)
        cases[name] = (built(about), arrays, about)
    assert cases
    return cases


def test_the_condition_and_the_loss_of_every_golden_model(golden: Any) -> None:
    for policy, arrays, about in golden.values():
        assert sum(p.numel() for p in policy.parameters()) == about["parameter_count"]
        batch, corner = batch_of(arrays, policy), tuple(about["crop_top_left"])
        with torch.no_grad():
            close(policy.condition(batch), arrays["out/global_cond_eval"])
            condition = policy.condition(batch, corner=corner)
        close(condition, arrays["out/global_cond_train"])
        draws = {"noise": arrays["in/noise"], "step": torch.tensor(about["timesteps"])}
        schedule = model.noise_schedule(policy.sizes.diffusion_steps)
        noisy = schedule.add_noise(batch.actions, draws["noise"], draws["step"])
        close(noisy, arrays["out/noisy_action"])
        close(policy.backbone.unet(noisy, draws["step"], condition), arrays["out/predicted_noise"])
        loss, _ = policy(batch, draws, corner)
        close(loss, arrays["out/loss"])


def test_what_lies_between_in_every_golden_model(golden: Any) -> None:
    for policy, arrays, about in golden.values():
        network, unet = policy.backbone, policy.backbone.unet
        captured: dict[str, Tensor] = {}

        def keep(name: str, captured: dict[str, Tensor] = captured) -> Any:
            return lambda module, inputs, out: captured.__setitem__(name, out.detach())

        hooked = {
            "feature_map": network.image_encoder,
            "keypoint_logits": network.image_pool[0].nets,
            "keypoints": network.image_pool[0],
            "text_feature": network.text_proj,
            "step_sinusoid": unet.diffusion_step_encoder[0],
            "step_embedding": unet.diffusion_step_encoder,
            "down0_block0_before_film": unet.down_modules[0][0].blocks[0],
            "mid": unet.mid_modules[1],
        }
        for i, (_, unit, half) in enumerate(unet.down_modules):
            hooked |= {f"skip{i}": unit, f"down{i}": half}
        hooked |= {f"up{i}": twice for i, (_, _, twice) in enumerate(unet.up_modules)}
        handles = [module.register_forward_hook(keep(name)) for name, module in hooked.items()]
        draws = {"noise": arrays["in/noise"], "step": torch.tensor(about["timesteps"])}
        policy(batch_of(arrays, policy), draws, tuple(about["crop_top_left"]))
        for handle in handles:
            handle.remove()
        for name, actual in captured.items():
            expected = arrays[f"out/{name}"]
            if name == "text_feature" and len(actual) < len(expected):
                # they repeat it for every step of the window
                actual = actual.repeat_interleave(len(expected) // len(actual), 0)
            close(actual, expected.reshape(actual.shape) if name == "text_feature" else expected)


def test_the_gradient_of_every_parameter(golden: Any) -> None:
    for policy, arrays, about in golden.values():
        policy.zero_grad()
        draws = {"noise": arrays["in/noise"], "step": torch.tensor(about["timesteps"])}
        policy(batch_of(arrays, policy), draws, tuple(about["crop_top_left"]))[0].backward()
        names = {
            target: pieces[0].path for target, pieces in diffusion_adapter(policy).table.items()
        }
        largest, ratios = max(about["grad_l2"].values()), []
        for target, parameter in policy.named_parameters():
            expected = about["grad_l2"][names[target]]
            actual = 0.0 if parameter.grad is None else parameter.grad.norm().item()
            ratios.append(1 + (actual - expected) / max(expected, 1e-4 * largest))
        close(torch.tensor(ratios), torch.ones(len(ratios)), GRADIENTS)


def test_a_sample_and_what_is_executed_of_it(golden: Any) -> None:
    for policy, arrays, _ in golden.values():
        batch = batch_of(arrays, policy)
        draws = {
            "noise": arrays["in/sample_noise"],
            "added": arrays["in/step_noise"].transpose(0, 1),
        }
        chunk = policy.sample_actions(batch, draws)
        close(chunk, arrays["out/sampled_chunk"], SAMPLES)
        executed = chunk[:, policy.n_past_steps :][:, : policy.embodiment.action.execute]
        close(executed, arrays["out/executed_actions"], SAMPLES)


@pytest.mark.nightly
def test_the_released_size_to_the_number_and_what_it_computes(folder: Path) -> None:
    arrays, about = case(folder, "full_size")
    meta = build_policy("diffusion_policy", backbone="dp", device="meta")
    assert sum(p.numel() for p in meta.parameters()) == about["parameter_count"]
    policy = built(about)
    batch = batch_of(arrays, policy)
    draws = {"noise": arrays["in/noise"], "step": torch.tensor(about["timesteps"])}
    with torch.no_grad():
        close(policy.condition(batch), arrays["out/global_cond_eval"])
        loss, _ = policy(batch, draws, tuple(about["crop_top_left"]))
    close(loss, arrays["out/loss"])
    draws = {"noise": arrays["in/sample_noise"], "added": arrays["in/step_noise"].transpose(0, 1)}
    close(policy.sample_actions(batch, draws), arrays["out/sampled_chunk"], SAMPLES)


def test_the_schedule_and_single_steps_of_it(folder: Path) -> None:
    arrays, _ = case(folder, "units")
    schedule = model.noise_schedule(len(arrays["schedule/betas"]))
    for name in ("betas", "alphas_cumprod"):
        close(getattr(schedule, name), arrays[f"schedule/{name}"], 1e-6)
    schedule.set_timesteps(len(arrays["schedule/betas"]))
    assert torch.equal(schedule.timesteps, arrays["schedule/timesteps"].to(schedule.timesteps))
    variances = [float(schedule._get_variance(t)) for t in range(len(arrays["schedule/variance"]))]
    assert variances == pytest.approx(arrays["schedule/variance"].tolist(), rel=1e-6, abs=1e-12)
    steps = [int(name.rpartition("_")[2]) for name in arrays if name.startswith("ddpm/prev_at_")]
    assert steps
    for step in steps:
        x, eps, z = (arrays[f"ddpm/{name}"] for name in ("x", "eps", "z"))
        close(model.denoise_once(schedule, eps, step, x, z), arrays[f"ddpm/prev_at_{step}"])
        close(schedule.step(eps, step, x).pred_original_sample, arrays[f"ddpm/x0_at_{step}"])


def test_a_conditioning_unit_with_and_without_a_shortcut(folder: Path) -> None:
    arrays, _ = case(folder, "units")
    for kind in sorted({name.split("/")[0] for name in arrays if name.startswith("film")}):
        weights = {
            n.removeprefix(f"{kind}/param/"): x
            for n, x in arrays.items()
            if n.startswith(f"{kind}/param/")
        }
        out, channels, kernel = weights["blocks.0.block.0.weight"].shape
        condition, x = arrays.get(f"{kind}/cond", arrays["film/cond"]), arrays[f"{kind}/x"]
        errors = []
        for groups in (g for g in range(1, out + 1) if out % g == 0):
            # the case does not say how many
            unit = ConditionedUnit(channels, out, condition.shape[1], kernel, groups)
            unit.load_state_dict(weights)
            errors.append(float((unit(x, condition) - arrays[f"{kind}/y"]).abs().max().detach()))
        assert min(errors) <= SINGLE * float(arrays[f"{kind}/y"].abs().max())


def test_keypoints_and_the_embedded_step(folder: Path) -> None:
    arrays, _ = case(folder, "units")
    weight = arrays["spatial_softmax/weight"]
    pool = SpatialSoftmax(weight.shape[1], weight.shape[0])
    pool.load_state_dict({"nets.weight": weight, "nets.bias": arrays["spatial_softmax/bias"]})
    with torch.no_grad():
        close(pool(arrays["spatial_softmax/x"]), arrays["spatial_softmax/y"])
    close(
        cell_centres(*arrays["spatial_softmax/x"].shape[-2:]),
        arrays["spatial_softmax/pos_grid"],
        1e-6,
    )
    close(StepSinusoid(arrays["sinusoid/y"].shape[1])(arrays["sinusoid/t"]), arrays["sinusoid/y"])


def statistics_of(arrays: dict[str, Tensor], kind: str) -> QuantileStats:
    values = {name: arrays[f"stats/{kind}/{name}"].tolist() for name in ("min", "max")}
    fields = {name: arrays.get(f"stats/{kind}/{name}") for name in ("mean", "std", "q01", "q99")}
    lists = {name: values["min"] if x is None else x.tolist() for name, x in fields.items()}
    return QuantileStats.from_dict(
        {**lists, "q99": values["max"] if fields["q99"] is None else lists["q99"], **values}
    )


def test_statistics_and_normalisation_by_extremes(folder: Path) -> None:
    arrays, _ = case(folder, "units")
    running = RunningStats()
    for name in sorted(name for name in arrays if name.startswith("stats/in")):
        running.update(arrays[name].numpy())
    statistics = running.result(extremes=True)
    expected = statistics_of(arrays, "state")
    for name in ("min", "max", "mean", "std", "q01", "q99"):
        close(
            torch.from_numpy(getattr(statistics, name)), torch.from_numpy(getattr(expected, name))
        )
    for kind in ("state", "action"):
        stats = statistics_of(arrays, kind)
        close(
            normalize(arrays[f"minmax/{kind}"].float(), stats, "extremes"),
            arrays[f"minmax/{kind}_n"].float(),
        )
    back = unnormalize(
        arrays["minmax/action_n"].float(), statistics_of(arrays, "action"), "extremes"
    )
    close(back, arrays["minmax/action_back"].float())


def test_the_text_feature_of_a_small_clip(folder: Path) -> None:
    transformers = pytest.importorskip("transformers")
    arrays, about = case(folder, "clip_text")
    tower = transformers.CLIPTextModelWithProjection(
        transformers.CLIPTextConfig(**about["text_config"])
    ).eval()
    weights = {
        name.removeprefix("param/"): x for name, x in arrays.items() if name.startswith("param/")
    }
    missing, unexpected = tower.load_state_dict(weights, strict=False)
    assert not [name for name in missing if "position_ids" not in name] and not unexpected
    close(
        text_features(tower, arrays["in/input_ids"], arrays["in/attention_mask"]),
        arrays["out/text_emb"],
    )


def test_updates_with_their_optimizer_schedule_and_averages(folder: Path, golden: Any) -> None:
    arrays, about = case(folder, "training")
    largest = max(golden, key=lambda name: golden[name][2]["config"]["obs_horizon"])
    policy = built({**golden[largest][2], "weight_seed": about["weight_seed"]})
    corner = tuple(about.get("crop_top_left", golden[largest][2]["crop_top_left"]))
    recipe = {
        "lr": 1e-4,
        "betas": (0.95, 0.999),
        "eps": 1e-8,
        "weight_decay": 1e-6,
        "decay_min_dim": 2,
    }
    settings = TrainSettings(
        steps=10, batch_size=1, warmup=about["warmup"], warmup_from_zero=True, schedule="cosine",
        schedule_steps=about["schedule_steps"], **recipe,
    )  # fmt: skip
    parameters = dict(policy.named_parameters())
    optimizer, ema = (
        make_optimizer(parameters.values(), settings),
        EMA(parameters, 0.9999, warmup=True),
    )
    targets = {pieces[0].path: name for name, pieces in diffusion_adapter(policy).table.items()}
    for step, update in enumerate(about["updates"]):
        rate = scheduled_rate(step, settings)
        assert rate == pytest.approx(update["lr"], abs=1e-12)
        assert ema.decay_after(step) == pytest.approx(update["ema_decay"], abs=1e-9)
        for group in optimizer.param_groups:
            group["lr"] = rate
        draws = {"noise": arrays["in/noise"][step], "step": arrays["in/timesteps"][step].long()}
        loss, _ = policy(batch_of(arrays, policy), draws, corner)
        loss.backward()
        norm = clip_gradients([p.grad for p in parameters.values() if p.grad is not None], 1.0)
        # after updates by such gradients
        assert loss.item() == pytest.approx(update["loss"], rel=5e-4)
        assert float(norm) == pytest.approx(update["grad_norm"], rel=GRADIENTS)
        optimizer.step()
        optimizer.zero_grad()
        ema.update(step)
        averages = ema.tensors()
        for name, expected in arrays.items():
            kind, _, source = name.removeprefix(f"out/step{step}/").partition("/")
            if name.startswith(f"out/step{step}/") and kind in ("param", "ema"):
                actual = (parameters if kind == "param" else averages)[targets[source]]
                close(actual.detach(), expected, SAMPLES)


def test_the_rates_of_the_released_schedule(folder: Path) -> None:
    about = json.loads((folder / "training.json").read_text())
    settings = TrainSettings(
        steps=200_000, batch_size=1, lr=1e-4, warmup=500, warmup_from_zero=True, schedule="cosine",
        schedule_steps=1_000_000,
    )  # fmt: skip
    for step, rate in zip(
        about["lr_default_schedule_steps"], about["lr_default_schedule"], strict=True
    ):
        assert scheduled_rate(step, settings) == pytest.approx(rate, rel=1e-6, abs=1e-15)


def test_a_served_episode(folder: Path, golden: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    arrays, about = case(folder, "serving")
    fitting = [
        of for of in golden.values() if of[2]["config"]["obs_horizon"] == about["obs_horizon"]
    ]
    policy = built(
        {**fitting[0][2], **{key: about[key] for key in ("weight_seed",) if key in about}}
    )
    processor = policy.require_processor()
    processor.stats = NormStats(statistics_of(arrays, "state"), statistics_of(arrays, "action"))
    processor.samples = replace(processor.samples, consecutive=False)  # as that server does
    processor.text = lambda goal: arrays["in/text_emb"]
    requests: list[Tensor] = []
    condition = policy.condition

    def watched(batch: DiffusionBatch, memory: Any = None, corner: Any = None) -> Tensor:
        requests.append(condition(batch, memory, corner))
        return requests[-1]

    monkeypatch.setattr(policy, "condition", watched)
    calls = sorted({name.split("/")[0] for name in arrays if name.startswith("call")})
    begins = {
        0,
        *(int(number) + 1 for number in re.findall(r"\d+", about["note"])),
    }  # "reset after call 1"
    for number, call in enumerate(calls):
        if number in begins:
            episode = policy.start_episode("the goal")
        draws = {
            "noise": arrays[f"{call}/sample_noise"][0],
            "added": arrays[f"{call}/step_noise"][:, 0],
        }
        monkeypatch.setattr(episode, "draw", lambda draws=draws: draws)
        views = {name: arrays[f"{call}/{name}"].numpy() for name in ROBOMME_JOINT.camera_names}
        episode.set_view(views, arrays[f"{call}/state"].float().numpy())
        actions = policy.act(episode)[: about["action_exec_horizon"]]
        close(requests[-1], arrays[f"{call}/global_cond"], SAMPLES)
        close(torch.from_numpy(actions).double(), arrays[f"{call}/actions"].double(), SAMPLES)
