"""`mme-vla convert input=<files or folders> output=<new folder>`: HDF5 demonstrations to one
dataset.
"""

from pathlib import Path

from omegaconf import DictConfig

from mme_vla.config.sections import read_section
from mme_vla.data.convert import ConvertOptions, convert
from mme_vla.data.hdf5 import find_files, list_episodes
from mme_vla.errors import counted, listed, require


def main(cfg: DictConfig) -> None:
    """Convert as configs/convert.yaml and the command line say."""
    inputs = [cfg.input] if isinstance(cfg.input, str) else list(cfg.input)
    episodes = list_episodes(find_files(inputs))
    if cfg.episodes is not None:
        indices = set(cfg.episodes)
        missing = indices.difference(ref.index for ref in episodes)
        require(
            not missing,
            f"episodes names {listed(missing)}, which none of the files has; they have"
            f" {listed(sorted({ref.index for ref in episodes}))}.",
        )
        episodes = [ref for ref in episodes if ref.index in indices]
    output = Path(cfg.output)
    options = {"images": cfg.images, "fps": cfg.fps, "keyframes": cfg.keyframes, "names": cfg.names}
    n_converted = convert(
        episodes, output, read_section(ConvertOptions, cfg.video, "video", **options)
    )
    already = len(episodes) - n_converted
    print(
        f"{output}: {counted(len(episodes), 'episode')} ({n_converted} written now,"
        f" {already} already there)."
    )
