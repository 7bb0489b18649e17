"""`mme-vla cache model=… data=…`: build vision caches; `torchrun` shares the episodes out."""

from dataclasses import dataclass

from omegaconf import DictConfig

from mme_vla.config.composition import resolved
from mme_vla.config.devices import process_device
from mme_vla.config.sections import read_section
from mme_vla.data.cache import cache_folder, fingerprint
from mme_vla.data.cache_building import build_cache, clear_cache, estimate, process_rank
from mme_vla.data.sources import open_sources
from mme_vla.errors import UserError, counted, require
from mme_vla.policy.build import build_from_config
from mme_vla.training.runs import start_from, weights_to_start_from
from mme_vla.training.settings import TrainRun
from mme_vla.utils import FolderLock


@dataclass(frozen=True)
class CacheRun:
    """The keys of `configs/cache.yaml` beside those of a training."""

    device: str
    dry_run: bool
    rebuild: bool


def main(cfg: DictConfig) -> None:
    """Build, or with dry_run only estimate, the caches that configs/cache.yaml and the command line
    describe.
    """
    config = resolved(cfg)
    command = read_section(CacheRun, config, others=True)
    training = TrainRun.from_config(config)
    settings = training.data.cache
    rank, world = process_rank()
    require(
        not command.rebuild or world <= 1,
        "rebuild=true removes files that other processes write: run it once without torchrun"
        " first.",
    )
    init_from = weights_to_start_from(training.init_from)
    policy = build_from_config(cfg, fresh_backbone=init_from is None)
    if init_from is not None:
        print(start_from(policy, init_from))
    device = process_device(command.device)
    memory = policy.to(device).memory
    if memory is None:
        raise UserError(f"model={training.name} has no memory: there is nothing to cache.")
    tower = policy.vision_fingerprint()
    dtype = str(policy.info.history_dtype).removeprefix("torch.")
    for source in open_sources(training.data.sources, policy.embodiment):
        expected = fingerprint(source, memory.storage, tower, dtype)
        folder = cache_folder(settings.root, source, expected)
        if command.dry_run:
            n_frames, n_bytes, seconds = estimate(
                source, memory, policy.encode_frames, dtype, settings.batch_size
            )
            print(
                f"{source.name}: {n_frames} of {int(source.lengths.sum())} frames to encode,"
                f" {n_bytes / 1e9:.3g} GB at {folder}, about {seconds:.0f} s in one process on"
                f" {device}"
            )
            continue
        if rank == 0:
            source.verify()  # its images are all about to be read, and for the last time
        # Beside the folder, and one for each share: processes that take other shares, or train, are
        # welcome.
        with FolderLock(
            folder.parent, "build of this vision cache", f".{folder.name}.{rank}of{world}.lock"
        ):
            if command.rebuild:
                clear_cache(folder)
            n_encoded = build_cache(
                source,
                memory,
                policy.encode_frames,
                folder,
                expected,
                batch_size=settings.batch_size,
            )
        encoded = counted(n_encoded, "episode")
        print(f"{source.name}: {encoded} encoded, {len(source)} in all, at {folder}")
