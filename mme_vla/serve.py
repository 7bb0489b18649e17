"""`python -m mme_vla.serve checkpoint=…`: serve a policy (configs/serve.yaml)."""

import asyncio
import logging
import os
import signal
import sys
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

from omegaconf import DictConfig, OmegaConf

from mme_vla.config import cli
from mme_vla.errors import UserError

if TYPE_CHECKING:
    import torch

    from mme_vla.policy import MMEPolicy
    from mme_vla.serving.server import PolicyServer

# Threads that wait asleep leave the event loop its core; it counts only when set before PyTorch is imported.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

logger = logging.getLogger("mme_vla.serving")


@cli("serve")
def main(cfg: DictConfig) -> None:
    """Serve `checkpoint`, or a fresh `model`, until it is told to stop.

    Raises:
        UserError: anything in the settings or the checkpoint that cannot work, before a client is accepted.
    """
    from mme_vla.serving.server import PolicyServer
    from mme_vla.serving.settings import ServeSettings

    config = OmegaConf.to_container(cfg, resolve=True)
    assert isinstance(config, dict)
    settings = ServeSettings.from_dict({str(key): value for key, value in config.items()})
    _log_to_terminal()
    policy, name = load(cfg)
    server = PolicyServer(policy, settings, name=name, trained=cfg.checkpoint is not None)
    if not settings.local_only and settings.api_key is None:
        logger.warning("host=%s without api_key: whoever reaches this port can use it", settings.host)
    if server.metadata["subgoal"] is not None:
        logger.info("reads the key %r of each request; without it, the goal alone", server.metadata["subgoal"])
    asyncio.run(run(server))


def load(cfg: DictConfig) -> "tuple[MMEPolicy, str]":
    """The policy to serve, on its device, and what to call it.

    Raises:
        UserError: neither a checkpoint nor a model is named, or both.
    """
    from mme_vla.build import build_from_config
    from mme_vla.policy import MMEPolicy
    from mme_vla.training.checkpoint import resolve_checkpoint

    device = _device(cfg.device)
    named = _named_groups()
    if cfg.checkpoint is not None:
        if named:
            raise UserError(f"A checkpoint brings its own model: leave out {' '.join(named)}.")
        source = Path(str(cfg.checkpoint)).expanduser()
        where = str(resolve_checkpoint(source)) if source.exists() else str(cfg.checkpoint)
        policy = MMEPolicy.from_pretrained(where, device=device, dtype=cfg.dtype, revision=cfg.revision)
        name = str(policy.config.get("name", "policy"))
        logger.info("%s from %s, on %s", name, where, device)
        return policy, name
    if not any(word.startswith("model=") for word in named):
        raise UserError(
            "Name what to serve: checkpoint=<folder>, or model=<model> for fresh weights to try a client out."
        )
    from mme_vla.testing import unit_stats

    if cfg.dtype != "float32":
        raise UserError(f"dtype={cfg.dtype} is for checkpoints; fresh weights are float32.")
    policy = build_from_config(cfg).to(device)
    policy.require_processor().stats = unit_stats()
    logger.warning("%s is UNTRAINED: its actions mean nothing; use it to try a client out", cfg.name)
    return policy, str(cfg.name)


async def run(server: "PolicyServer") -> None:
    """Start, wait for SIGTERM or Ctrl-C, stop; a second signal does not wait for what is running."""
    loop, asked = asyncio.get_running_loop(), asyncio.Event()
    serving = asyncio.current_task()
    assert serving is not None

    def stop() -> None:
        if asked.is_set():
            serving.cancel()
        asked.set()

    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, stop)
    await server.start()
    host = f"[{server.settings.host}]" if ":" in server.settings.host else server.settings.host
    logger.info("ready at ws://%s:%d and http://%s:%d (healthz, metadata, stats)", *(host, server.port) * 2)
    await asked.wait()
    logger.info("stopping: no new clients, requests that are running are finished")
    try:
        await server.stop()
    except asyncio.CancelledError:
        logger.warning("stopped at once; requests were cut off")
        os._exit(1)  # the policy's thread cannot be interrupted
    logger.info("stopped · %s", server.stats.line())


def _device(name: str) -> "torch.device":
    import torch

    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    try:
        device = torch.device(name)
    except RuntimeError:
        raise UserError(f"device={name!r} is not a device; choose auto, cpu, cuda or cuda:<number>.") from None
    if device.type == "cuda" and not torch.cuda.is_available():
        raise UserError(f"device={name}: PyTorch sees no GPU here; use device=cpu.")
    return device


def _named_groups() -> list[str]:
    """Words of the command line that choose a model."""
    from hydra.core.hydra_config import HydraConfig

    given = HydraConfig.get().overrides.task if HydraConfig.initialized() else []
    groups = ("model", "backbone", "memory", "integration", "processor")
    return [word for word in given if word.lstrip("+").split("=")[0].split(".")[0] in groups]


def _log_to_terminal() -> None:
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(logging.Formatter("%(asctime)s %(message)s", "%H:%M:%S"))
    logger.setLevel(logging.INFO)
    logger.handlers = [handler]
    logger.propagate = False
    warnings.showwarning = lambda message, *_, **__: logger.warning("%s", message)


if __name__ == "__main__":
    main()
