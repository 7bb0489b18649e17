"""Golden cases of SimpleMemVLA: arrays, sizes, and its small policy built here with
its parameters.
"""

import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import OmegaConf
from torch import Tensor

from helpers import baselines
from mme_vla.extras.methods.simplememvla.policy import SimpleMemVlaPolicy
from mme_vla.extras.methods.simplememvla.processor import SimpleMemVlaProcessor
from mme_vla.extras.methods.simplememvla.video import Window
from mme_vla.extras.methods.simplememvla.weights import PublishedConfig
from mme_vla.processing.normalise import NormStats, QuantileStats
from mme_vla.weights.load import load_weights


def folder() -> Path:
    return baselines.baselines_folder("simplememvla")


def arrays(name: str) -> dict[str, Tensor]:
    return baselines.arrays(folder(), name)


@cache
def read(name: str) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((folder() / f"{name}.json").read_text())
    return content


def robot_section(config: dict[str, Any]) -> dict[str, Any]:
    """A robot with the sizes of a case; its chunks are executed as far as the prefix of the next
    prompt allows.
    """
    window = Window(
        config["history_video_sec"], config["history_video_fps"], config["native_video_fps"]
    )
    action = {"width": config["action_dim"], "horizon": config["action_horizon"], "relative": []}
    return {
        "name": "golden",
        "cameras": {key.rpartition(".")[2]: {} for key in config["image_keys"]},
        "memory_camera": config["history_image_keys"][0].rpartition(".")[2],
        "state": {"width": config["state_dim"]},
        "action": {
            **action,
            "execute": min(2 * window.stride, config["action_horizon"]),
            "frames": 1,
        },
        "fps": config["native_video_fps"],
        "conditioning_video": True,
    }


def sections(**processor: Any) -> dict[str, Any]:
    meta = read("meta")
    config, pixels = meta["config"], meta["processor"]
    bounds = [pixels["min_pixels"], pixels["max_pixels"]]
    composed = OmegaConf.create({"backbone": {}, "processor": {}})
    PublishedConfig.read(config, "the golden data").configure(composed)
    read_sections: Any = OmegaConf.to_container(composed)
    backbone = read_sections["backbone"]
    settings = {
        "name": "simplememvla",
        **read_sections["processor"],
        "tokenizer": str(folder() / "tokenizer.json"),
    }
    return {
        "name": "simplememvla",
        "policy": {"name": "simplememvla"},
        "embodiment": robot_section(config),
        "backbone": {**backbone, "image_size": pixels["patch"] * pixels["merge"]},
        "processor": {**settings, "video_pixels": bounds, "image_pixels": bounds, **processor},
        "memory": None,
        "integration": None,
    }


def statistics() -> NormStats:
    stats = read("meta")["stats"]

    def of(feature: str) -> QuantileStats:
        mean, std = (np.asarray(stats[feature][key]) for key in ("mean", "std"))
        return QuantileStats(mean, std, mean - 3 * std, mean + 3 * std)

    return NormStats(of("observation.state"), of("action"))


def published(target: Path) -> Path:
    """The case as a folder of the authors' layout."""
    from safetensors.torch import save_file

    target.mkdir(parents=True, exist_ok=True)
    meta = read("meta")
    save_file(arrays("weights"), target / "model.safetensors", metadata={"format": "pt"})
    (target / "config.json").write_text(json.dumps(meta["config"] | {"model_type": "simplememvla"}))
    (target / "stats.json").write_text(json.dumps(meta["stats"]))
    (target / "tokenizer.json").write_bytes((folder() / "tokenizer.json").read_bytes())
    return target


def golden_policy(target: Path, **processor: Any) -> SimpleMemVlaPolicy:
    """The case's policy, its weights read from a folder of the authors' layout.

    Args:
        target: where the folder is written. processor: settings instead of the case's.
    """
    config = sections(**processor)
    built = SimpleMemVlaPolicy.from_config(config, SimpleMemVlaProcessor.from_sections(config))
    if not processor:
        load_weights(built, published(target))
    else:  # of another video: the weights alone
        state = arrays("weights")
        built.load_state_dict(state)
    assert built.processor is not None
    built.processor.stats = statistics()
    return built.eval()


def frames(prefix: str = "") -> dict[str, np.ndarray]:
    with np.load(folder() / "frames.npz") as archive:
        return {name: archive[prefix + name] for name in ("front", "wrist")}
