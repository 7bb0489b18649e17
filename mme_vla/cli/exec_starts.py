"""`mme-vla exec-starts`: where the conditioning videos of a dataset end, as a side file."""

from pathlib import Path

from omegaconf import DictConfig

from mme_vla.cli.command import cli
from mme_vla.data.exec_starts import annotated_episodes, first_frames
from mme_vla.errors import require
from mme_vla.utils import write_json


@cli("exec_starts")
def main(cfg: DictConfig) -> None:
    """Write the side file as configs/exec_starts.yaml and the command line say."""
    output = Path(cfg.output)
    require(not output.exists(), f"{output} exists: name a new file, nothing is ever written over.")
    episodes = annotated_episodes([cfg.input] if isinstance(cfg.input, str) else list(cfg.input))
    starts = [one.start for one in episodes] if cfg.dataset is None else first_frames(cfg.dataset, episodes)
    write_json(output, {str(episode): start for episode, start in enumerate(starts)})
    videos = sum(start > 0 for start in starts)
    print(f"{output}: {len(starts)} episodes, {videos} of them with a conditioning video.")
