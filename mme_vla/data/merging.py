"""Makes LeRobot's merging of datasets quick: most of its time goes into reading statistics that it then leaves out."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any


@contextmanager
def episodes_without_statistics() -> Iterator[None]:
    """While this lasts, LeRobot reads a dataset's list of episodes at once, and without their statistics.

    It asks the `datasets` library, whose time grows with the square of the number of columns: of a dozen features that
    are two hundred, nearly all of them statistics, and a fifth of a second for every episode that is merged.
    """
    from lerobot.datasets import dataset_metadata

    theirs = dataset_metadata.load_episodes
    dataset_metadata.load_episodes = _columns
    try:
        yield
    finally:
        dataset_metadata.load_episodes = theirs


def _columns(root: Path) -> dict[str, list[Any]]:
    import pyarrow as pa
    import pyarrow.parquet as pq

    tables = []
    for file in sorted((root / "meta" / "episodes").glob("*/*.parquet")):
        names = [name for name in pq.read_schema(file).names if not name.startswith("stats/")]
        tables.append(pq.read_table(file, columns=names))
    columns: dict[str, list[Any]] = pa.concat_tables(tables).to_pydict()
    return columns
