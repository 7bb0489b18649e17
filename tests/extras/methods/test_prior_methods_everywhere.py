"""Every prior method trains, resumes, is evaluated, served and probed as any policy of the library,
at tiny size.
"""

import io
from collections.abc import Callable
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from rich.console import Console

from helpers.depth_env import make_depth_env, readings
from helpers.h5_files import write_file
from helpers.prior_vla_runs import TOWERS, UNTESTED, losses, run
from helpers.rollout_fakes import InlineEnvs, roll
from helpers.scripted_env import SIZE, make_scripted_env
from helpers.serving_fakes import Served, challenge
from helpers.tiers import slow_or_nightly
from mme_vla.cli.inspect_checkpoint import show_checkpoint
from mme_vla.config.composition import compose
from mme_vla.data.convert import ConvertOptions, convert
from mme_vla.data.hdf5 import find_files, list_episodes
from mme_vla.data.sources import open_sources
from mme_vla.envs.vector.pool import Job
from mme_vla.errors import UserError
from mme_vla.evaluation.results.paper import average, chunk_flops, paper_method
from mme_vla.extras.probing import lines
from mme_vla.extras.probing.arms import read_arms
from mme_vla.extras.probing.lines import MomentLine
from mme_vla.extras.probing.offline import probe_offline
from mme_vla.extras.probing.recordings import all_recordings
from mme_vla.extras.probing.settings import OfflineSettings
from mme_vla.policy.base import Policy
from mme_vla.policy.build import policy_config
from mme_vla.policy.tensor_files import load_tensors

LLAMA = [*TOWERS, "backbone.vlm.depth=1", "backbone.vlm.width=32", "backbone.vlm.mlp_dim=32"]
OFT = [*LLAMA, "backbone.vision.image_size=32", "backbone.vision.patch_size=2"]
SHORT = {
    "diffusion_policy": [
        "backbone.diffusion_steps=4",
        "backbone.widths=[16,32]",
        "backbone.picture=[40,40]",
    ],
    **{f"openvla_oft{kind}": OFT for kind in ("", "_simplesg", "_tokendrop_context")},
    "memoryvla": [
        *LLAMA,
        "backbone.vision.image_size=28",
        "backbone.head.depth=1",
        "processor.group_size=3",
    ],
    "sam2act_plus": ["train.warmup=1"],
    "simplememvla": [
        "processor.max_words=4",
        "processor.seconds=4",
        "backbone.head.depth=1",
        "backbone.vlm.vision_config.depth=1",
        "backbone.vlm.text_config.num_hidden_layers=2",
        "backbone.vlm.text_config.full_attention_interval=2",
    ],
}
OTHER_ROWS = ["openvla_oft_groundsg", "openvla_oft_framesamp_context"]
PAPER_ROWS = [*(model for model in SHORT if model != "simplememvla"), *OTHER_ROWS]
pytestmark = pytest.mark.filterwarnings("ignore:.*loses its end")


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], str]:
    """What a model is trained on and probed with: the sample, or recordings with depth for those
    that read it.
    """

    @cache
    def with_depth() -> str:
        folder = tmp_path_factory.mktemp("keyframes")
        write_file(
            folder / "record_dataset_VideoUnmask.h5", [40, 44], [12, 12], poses=True, depth=True
        )
        convert(
            list_episodes(find_files([folder])),
            folder / "out",
            ConvertOptions(images="png", keyframes=True),
        )
        return str(folder / "out")

    return lambda model: with_depth() if model == "sam2act_plus" else "sample"


@pytest.fixture(scope="module")
def trained(
    data: Callable[[str], str], tmp_path_factory: pytest.TempPathFactory
) -> Callable[[str], Path]:
    """The run of a model after one update."""
    pytest.importorskip(
        "diffusers", reason="needs the prior methods' packages: uv sync --inexact --extra baselines"
    )

    @cache
    def one_update(model: str) -> Path:
        folder = tmp_path_factory.mktemp(model) / "run"
        update(model, data(model), folder, "train.steps=1")
        return folder

    return one_update


def update(model: str, data: str, folder: Path, *words: str) -> Path:
    """Train a model on two samples an update; the last checkpoint."""
    small = [*SHORT[model], f"data.sources=[{data}]", "train.batch_size=2", *words]
    return run(model, folder, *small, short=UNTESTED)


@pytest.fixture(scope="module")
def loaded(trained: Callable[[str], Path]) -> Callable[[str], Policy]:
    return cache(lambda model: Policy.from_pretrained(trained(model)).eval())


RESUMED = {
    "memoryvla": ("memoryvla", []),
    "decaying rates": (
        "diffusion_policy",
        [
            "train.schedule=cosine",
            "train.schedule_steps=3",
            "train.ema_warmup=true",
            "train.warmup_from_zero=true",
            "train.warmup=1",
            "train.decay_min_dim=2",
        ],
    ),
    "adapters": ("openvla_oft", ["finetune=oft", "finetune.rank=2"]),
    "another optimizer": ("sam2act_plus", ["train.optimizer=lamb"]),
    "a memory of frames": (
        "memoryvla",
        ["memory=framesamp", "memory.every=8", "processor.group_size=1"],
    ),
    "a recurrent memory": ("memoryvla", ["memory=ttt", "memory.grid=4"]),
}


@pytest.mark.parametrize(
    "case", slow_or_nightly(RESUMED, lambda case: case in ("adapters", "a recurrent memory"))
)
def test_it_trains_by_the_command_and_resumes_to_the_bit(
    case: str, data: Callable[[str], str], tmp_path: Path
) -> None:
    pytest.importorskip(
        "diffusers", reason="needs the prior methods' packages: uv sync --inexact --extra baselines"
    )
    model, words = RESUMED[case]
    full, parts = tmp_path / "whole", tmp_path / "parts"
    straight = load_tensors(update(model, data(model), full, *words, "train.steps=2"))
    update(model, data(model), parts, *words, "train.steps=1")
    last = update(
        model, data(model), tmp_path / "unused", *words, "train.steps=2", f"resume={parts}"
    )
    assert last == parts / "checkpoints" / "step_000002"
    assert (
        losses(parts) == losses(full)
        and len(losses(parts)) == 2
        and np.isfinite(losses(parts)).all()
    )
    resumed = load_tensors(last)
    assert all(torch.equal(tensor, resumed[name]) for name, tensor in straight.items())
    assert bool(Policy.from_pretrained(last).config.get("adapters")) == (case == "adapters")


@pytest.mark.parametrize("model", SHORT)
def test_it_is_evaluated(model: str, loaded: Callable[[str], Policy]) -> None:
    policy = loaded(model)
    base = make_depth_env if policy.embodiment.readings else make_scripted_env
    envs = InlineEnvs(
        base=base,
        robot=policy.embodiment,
        max_steps=20,
        max_actions=policy.info.max_actions,
    )
    (record,) = roll(policy, [Job("VideoUnmask", "test", 1)], envs, max_steps=20)
    assert (
        record.outcome in ("success", "fail", "timeout") and record.steps > 0 and record.chunks > 0
    )
    assert record.action_space == policy.embodiment.action.space


@pytest.mark.parametrize("model", SHORT)
def test_it_is_served_what_it_answers_itself(model: str, loaded: Callable[[str], Policy]) -> None:
    policy, robot = loaded(model), loaded(model).embodiment
    rng = np.random.default_rng(0)
    front, wrist = (rng.integers(0, 255, (5, SIZE, SIZE, 3), np.uint8) for _ in range(2))
    states, beside = np.full((5, 8), 0.04, np.float32), readings(5)
    images = {"front": front, "wrist": wrist} | {name: beside[name] for name in robot.readings}
    episode = policy.start_episode("pick up the cube", seed=42)
    episode.observe(images, states, np.arange(5) < 4)
    expected = policy.act(episode, 2)
    lists = {f"{name}_list": list(beside[name]) for name in robot.readings}
    with Served(policy) as served, served.client() as client:
        assert client.metadata["readings"] == list(robot.readings)
        reply = client.infer(challenge(front, wrist, states, first=True, **lists))["actions"]
    np.testing.assert_allclose(reply, expected[: robot.action.execute], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("model", SHORT)
def test_it_is_probed_on_recordings(
    model: str, loaded: Callable[[str], Policy], data: Callable[[str], str], tmp_path: Path
) -> None:
    policy = loaded(model)
    recordings = all_recordings(open_sources([data(model)], policy.embodiment))
    settings = OfflineSettings(draws=2, moments=2, flow_steps=2)
    torch.manual_seed(0)
    results = probe_offline(
        policy,
        read_arms(["nodemo"]),
        recordings[:1],
        recordings,
        tmp_path / "lines.jsonl",
        settings,
    )
    moments = [line for line in results if isinstance(line, MomentLine)]
    assert len(moments) == 2 and {line.recording for line in moments} == {recordings[0].name}
    assert all(np.isfinite(line.change) for line in moments)
    assert lines.read(tmp_path / "lines.jsonl")[0] == results


def test_sam2act_is_reported_which_depth_a_request_lacks(loaded: Callable[[str], Policy]) -> None:
    policy, frames, states = (
        loaded("sam2act_plus"),
        np.zeros((2, SIZE, SIZE, 3), np.uint8),
        np.zeros((2, 8), np.float32),
    )
    lists = readings(2, listed=True)
    request = challenge(frames, frames, states, first=True, **lists)
    wrong = {
        "lacks the key 'wrist_depth_list'": {
            k: v for k, v in request.items() if k != "wrist_depth_list"
        },
        "front_depth_list must be depth in millimetres, one number a pixel": request
        | {"front_depth_list": []},
        r"front_depth_list must have one number a pixel of the image \[64, 64\]": request
        | {"front_depth_list": [np.zeros((8, 8))] * 2},
        "front_depth_list must be millimetres": request
        | {"front_depth_list": [-d for d in lists["front_depth_list"]]},
        r"wrist_camera_extrinsic_list must be an array of numbers \[frames, 3, 4\]": request
        | {"wrist_camera_extrinsic_list": ["x", "y"]},
        "front_depth_list has 1": request | {"front_depth_list": lists["front_depth_list"][:1]},
        "add_buffer has no place for them": {
            "add_buffer": True,
            "images": frames[:, None],
            "state": states,
        },
    }
    with Served(policy) as served:
        for reason, message in wrong.items():
            with served.client() as client, pytest.raises(UserError, match=reason):
                client.infer(message)


def test_sam2act_takes_depth_of_the_current_frame_in_the_other_schema(
    loaded: Callable[[str], Policy],
) -> None:
    policy, image = loaded("sam2act_plus"), np.full((SIZE, SIZE, 3), 9, np.uint8)
    beside = readings(1)
    episode = policy.start_episode("pick up the cube", seed=42)
    episode.observe(
        {"front": image[None], "wrist": image[None], **beside}, np.full((1, 8), 0.04, np.float32)
    )
    message = {
        "observation/image": image,
        "observation/wrist_image": image,
        "prompt": "pick up the cube",
    }
    message |= {"observation/state": np.full(8, 0.04, np.float32)}
    message |= {f"observation/{name}": values[0] for name, values in beside.items()}
    with Served(policy) as served, served.client() as client:
        np.testing.assert_array_equal(client.infer(message)["actions"], policy.act(episode))
        client.infer(message)
        client.reset()
        np.testing.assert_array_equal(client.infer(message)["actions"], policy.act(episode))


@pytest.mark.parametrize("model", SHORT)
def test_inspect_names_its_parts(
    model: str, trained: Callable[[str], Path], loaded: Callable[[str], Policy]
) -> None:
    policy = loaded(model)
    parts = {policy.finetune_spec.component_of(name) for name, _ in policy.named_parameters()}
    console = Console(record=True, width=200, file=io.StringIO())
    show_checkpoint(trained(model), console, everything=True)
    output = console.export_text()
    assert "action" in parts and all(
        word in output for word in ("parameters", "normalisation", model, *parts)
    )


@pytest.mark.parametrize("model", PAPER_ROWS)
def test_it_stands_beside_its_paper_row(model: str) -> None:
    subgoal = {"openvla_oft_simplesg": "qwenvl", "openvla_oft_groundsg": "qwenvl"}.get(model)
    method = paper_method(model, subgoal)
    assert method is not None and method.family == "prior" and 0 <= average(method.name).mean < 30
    assert chunk_flops()[model] > 10**9


@pytest.mark.parametrize("model", ["framesamp_modul", "diffusion_policy", "openvla_oft"])
def test_an_environments_robot_is_that_of_every_model_without_another(model: str) -> None:
    words = [f"model={model}", "env=mikasa"]
    assert policy_config(compose("train", words))["embodiment"]["name"] == "mikasa"
    selected = policy_config(compose("train", [*words, "embodiment=robomme_ee_delta"]))
    assert selected["embodiment"]["name"] == "robomme_ee_delta"


@pytest.mark.parametrize(
    ("recipe", "name"),
    [
        ("diffusion_policy", "diffusion_policy"),
        ("openvla_oft", "openvla_oft"),
        ("memoryvla", "memoryvla"),
        ("sam2act_first", "sam2act_plus"),
        ("sam2act_memory", "sam2act_plus"),
    ],
)
def test_a_recipe_at_full_size_has_the_name_that_the_papers_row_has(recipe: str, name: str) -> None:
    assert compose("train", [f"experiment={recipe}"]).name == name
