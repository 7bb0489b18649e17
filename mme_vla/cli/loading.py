"""The policy a command is about: a checkpoint, or a model with fresh weights for
trying things out.
"""

import logging
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple, Self

import torch
from hydra.core.hydra_config import HydraConfig
from omegaconf import OmegaConf

from mme_vla.config.devices import find_device
from mme_vla.config.sections import PathText, PositiveInt, read_section
from mme_vla.embodiment import Embodiment
from mme_vla.errors import UserError, check_choice, require
from mme_vla.evaluation.records import display_name
from mme_vla.policy.base import Policy
from mme_vla.policy.build import build_from_config
from mme_vla.policy.run_folders import locate_checkpoint, shipped_name
from mme_vla.policy.sections import SECTIONS, PolicySections
from mme_vla.processing.normalise import NormStats
from mme_vla.serving.remote.settings import ServerChoice
from mme_vla.speed.compiler import keep_compiled_code, missing_compiler


@dataclass(frozen=True)
class PolicyChoice:
    """The keys of a command that say which policy it is about.

    config: all of the command's configuration, plain. Without a checkpoint its model is built.
    server: a server that has the policy, in place of a checkpoint; it is asked for the robot
        `embodiment`, and `execute` actions of a chunk are executed.
    """

    name: PathText
    checkpoint: PathText | None
    revision: str | None
    device: str
    dtype: str
    trust_plugins: bool
    config: Mapping[str, Any]
    server: ServerChoice | None = None
    embodiment: Any = None
    execute: PositiveInt | None = None
    flow_steps: PositiveInt | None = None

    @classmethod
    def from_config(cls, config: Mapping[str, Any]) -> Self:
        """Read a composed configuration, plain and resolved."""
        choice = read_section(cls, config, others=True, config={}, server=None)
        return replace(choice, config=config, server=ServerChoice.from_config(config))


class LoadedPolicy(NamedTuple):
    """A policy on its device. source: the checkpoint folder or repository it is from; None with
    fresh weights.
    """

    policy: Policy
    name: str
    source: str | None


def load_policy(
    choice: PolicyChoice,
    verb: str,
    logger: logging.Logger,
    device: torch.device | None = None,
) -> LoadedPolicy:
    """Load `checkpoint`, or build `model` with fresh weights and say so.

    Args:
        choice: what the command line says.
        verb: what the command does with the policy, for messages.
        logger: takes a line on what was loaded.
        device: instead of the configured one.
    """
    if choice.server is not None:
        return _connect(choice, choice.server, logger)
    device = find_device(choice.device) if device is None else device
    # What a checkpoint brings along, so that it cannot be set beside one.
    named = words_of("model", *set(SECTIONS) - {"plugins"})
    if choice.checkpoint is not None:
        if named:
            raise UserError(f"A checkpoint brings its own model: leave out {' '.join(named)}.")
        where = locate_checkpoint(choice.checkpoint)
        policy = Policy.from_pretrained(
            where,
            device=device,
            dtype=choice.dtype,
            revision=choice.revision,
            trust_plugins=choice.trust_plugins,
        )
        name = str(PolicySections.of(policy.config).name or "policy")
        title = display_name(name, shipped_name(Path(where)) or where)
        logger.info("%s from %s, on %s", title, where, device)
        return LoadedPolicy(policy, name, where)
    require(
        any(word.startswith("model=") for word in named),
        f"Name what to {verb}: checkpoint=<folder>, or model=<model> with fresh weights, to try"
        " things out.",
    )
    require(
        choice.dtype in ("auto", "float32"),
        f"dtype={choice.dtype} is for checkpoints; fresh weights are float32.",
    )
    policy = build_from_config(OmegaConf.create(dict(choice.config))).to(device)
    robot = policy.embodiment
    policy.require_processor().stats = NormStats.unit(robot.state.width, robot.action.width)
    logger.warning(
        "%s is UNTRAINED: its actions mean nothing; use it to try things out", choice.name
    )
    return LoadedPolicy(policy, choice.name, None)


def _connect(choice: PolicyChoice, server: ServerChoice, logger: logging.Logger) -> LoadedPolicy:
    """The policy that a server has."""
    from mme_vla.serving.remote.policy import RemotePolicy  # the extra `serve`

    require(
        choice.checkpoint is None,
        f"server={server.server} and checkpoint={choice.checkpoint} are two policies: leave out"
        " one.",
    )
    named = words_of("model", *set(SECTIONS) - {"plugins", "embodiment"})
    if named:
        raise UserError(f"A server brings its own model: leave out {' '.join(named)}.")
    require(
        choice.flow_steps is None,
        f"flow_steps={choice.flow_steps}: a server chooses its own; leave it out, or"
        " set it where the server is started.",
    )
    robot = Embodiment.from_dict(choice.embodiment)
    policy = RemotePolicy(server, robot, choice.execute)
    assert policy.info.identity is not None
    name = policy.info.identity.model
    protocol = policy.protocol.name
    if policy.detected is not None:
        protocol += f" ({policy.detected})"
    logger.info("%s at %s, protocol %s", name, server.server, protocol)
    if policy.info.max_running is not None:
        logger.info("episodes at the same time: at most %d", policy.info.max_running)
    return LoadedPolicy(policy, name, None)


def release(policy: Policy) -> None:
    """Close the connections of a policy that a server computes."""
    if policy.info.server is None:
        return
    from mme_vla.serving.remote.policy import RemotePolicy  # the extra `serve`

    if isinstance(policy, RemotePolicy):
        policy.close()


SAMPLING = ("auto", "eager", "graph", "compiled")
"""How a command computes chunks: `sampling` of configs/evaluate.yaml and configs/serve.yaml."""


def prepare_sampling(policy: Policy, sampling: str, logger: logging.Logger) -> None:
    """Compile the policy's sampler as the configuration asks; `auto`: one CUDA graph a chunk where
    there is a GPU.
    """
    check_choice("sampling", sampling, SAMPLING)
    on_gpu = policy.device.type == "cuda"
    if sampling == "graph" and not on_gpu:
        raise UserError(
            f"sampling=graph needs a GPU, and the policy is on {policy.device}: leave"
            " sampling=auto."
        )
    if sampling == "eager" or (sampling == "auto" and not on_gpu):
        return
    begun = time.perf_counter()
    layers = sampling == "compiled"
    if layers:
        folder = keep_compiled_code()
        missing = missing_compiler(policy.device)
        if missing is None:
            logger.info("compiling layers: a minute or more at first, later starts read %s", folder)
        else:
            layers = False
            logger.warning(
                "sampling=compiled: layers stay eager, since %s is missing. Install it, or set"
                " sampling=auto.",
                missing,
            )
    if not policy.compile_sampling(layers, logger.info if layers else lambda text: None):
        require(
            sampling == "auto",
            f"sampling={sampling}: {type(policy).__name__} has no sampler that can be compiled. Set"
            " sampling=eager.",
        )
        return
    logger.info("sampler compiled in %.1f s (sampling=%s)", time.perf_counter() - begun, sampling)


def words_of(*keys: str) -> list[str]:
    """The words of the command line that set one of these keys or groups, or something below."""
    overrides = HydraConfig.get().overrides.task if HydraConfig.initialized() else []
    matches = []
    for word in overrides:
        key = word.lstrip("+~").split("=")[0]
        if any(key == name or key.startswith((f"{name}.", f"{name}@")) for name in keys):
            matches.append(word)
    return matches
