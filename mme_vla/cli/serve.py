"""`python -m mme_vla.serve checkpoint=…`: serve a policy (configs/serve.yaml)."""

import asyncio
import logging
import os
import signal

from omegaconf import DictConfig

from mme_vla.cli.command import log_to_terminal
from mme_vla.cli.loading import PolicyChoice, load_policy, prepare_sampling
from mme_vla.policy.build import policy_config
from mme_vla.policy.saving import local_folder
from mme_vla.policy.self_check import NO_CHECK, IncomparableError, compare
from mme_vla.serving.server import PolicyServer
from mme_vla.serving.settings import ServeSettings, is_local

logger = logging.getLogger("mme_vla.serving")


def main(cfg: DictConfig) -> None:
    """Serve `checkpoint`, or a fresh `model`, until SIGTERM or Ctrl-C."""
    config = policy_config(cfg)
    settings = ServeSettings.from_dict(config)
    choice = PolicyChoice.from_config(config)
    log_to_terminal(logger, clock=True)
    policy, name, source = load_policy(choice, "serve", logger)
    if source is not None:
        # Whether the policy predicts what it predicted where it was trained.
        try:
            result = compare(policy, local_folder(source, choice.revision))
        except IncomparableError as error:
            logger.warning("%s", error)
        else:
            if result is None:
                logger.info("%s", NO_CHECK)
            elif result.passed:
                logger.info("%s", result.line)
            else:
                logger.warning("%s", result.line)
    prepare_sampling(policy, str(cfg.sampling), logger)
    trained = choice.checkpoint is not None
    server = PolicyServer(policy, settings, name=name, trained=trained, source=source)
    if not is_local(settings.host) and settings.api_key is None:
        logger.warning(
            "host=%s without api_key: every client that reaches this port can use it", settings.host
        )
    if server.metadata["subgoal"] is not None:
        logger.info(
            "reads the key %r of each request; without it, the goal alone",
            server.metadata["subgoal"],
        )
    asyncio.run(run(server))


async def run(server: PolicyServer) -> None:
    """Start, wait for SIGTERM or Ctrl-C, stop; a second signal does not wait for what
    is running.
    """
    loop = asyncio.get_running_loop()
    stop_requested = asyncio.Event()
    serving = asyncio.current_task()
    assert serving is not None

    def stop() -> None:
        if stop_requested.is_set():
            serving.cancel()
        stop_requested.set()

    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, stop)
    await server.start()
    host = f"[{server.settings.host}]" if ":" in server.settings.host else server.settings.host
    logger.info(
        "ready at ws://%s:%d and http://%s:%d (healthz, metadata, stats)", *(host, server.port) * 2
    )
    await stop_requested.wait()
    logger.info("stopping: no new clients, requests that are running are finished")
    try:
        await server.stop()
    except asyncio.CancelledError:
        logger.warning("stopped at once; requests were cut off")
        os._exit(1)  # the policy's thread cannot be interrupted
    logger.info("stopped · %s", server.stats.line(server.n_clients))
