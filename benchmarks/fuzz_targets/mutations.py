"""Ways to damage a file, chosen by a random generator and by what the file's name says is in it."""

import json
import os
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

Mutation = Callable[[random.Random, Path], None]
DEPTH = 1_000_000


def flip_bit(rng: random.Random, path: Path) -> None:
    _flip(rng, path, 1)


def flip_bits(rng: random.Random, path: Path) -> None:
    _flip(rng, path, rng.randint(2, 64))


def truncate(rng: random.Random, path: Path) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: rng.randrange(max(len(data), 1))])


def append(rng: random.Random, path: Path) -> None:
    path.write_bytes(path.read_bytes() + rng.randbytes(rng.randint(1, 200)))


def insert(rng: random.Random, path: Path) -> None:
    data = path.read_bytes()
    at = rng.randrange(len(data) + 1)
    path.write_bytes(data[:at] + rng.randbytes(rng.randint(1, 20)) + data[at:])


def cut_out(rng: random.Random, path: Path) -> None:
    data = path.read_bytes()
    at = rng.randrange(max(len(data), 1))
    path.write_bytes(data[:at] + data[at + rng.randint(1, 100) :])


def zero_block(rng: random.Random, path: Path) -> None:
    data = bytearray(path.read_bytes())
    at = rng.randrange(max(len(data), 1))
    size = min(rng.randint(1, 512), len(data) - at)
    data[at : at + size] = bytes(size)
    path.write_bytes(data)


def nothing_but_noise(rng: random.Random, path: Path) -> None:
    path.write_bytes(rng.randbytes(rng.randint(0, 4096)))


def folder(rng: random.Random, path: Path) -> None:
    path.unlink()
    path.mkdir()


def pipe(rng: random.Random, path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def device(rng: random.Random, path: Path) -> None:
    path.unlink()
    path.symlink_to(rng.choice(["/dev/zero", "/dev/null", "/dev/urandom"]))


def link(rng: random.Random, path: Path) -> None:
    path.unlink()
    path.symlink_to(rng.choice([path.name, "nowhere", "/etc/hostname"]))


def missing(rng: random.Random, path: Path) -> None:
    path.unlink()


BYTES: tuple[Mutation, ...] = (
    flip_bit, flip_bits, truncate, append, insert, cut_out, zero_block, nothing_but_noise,
    folder, pipe, device, link, missing,
)  # fmt: skip


def delete_value(rng: random.Random, path: Path) -> None:
    _at_random(rng, path, lambda box, key: box.pop(key))


def retype_value(rng: random.Random, path: Path) -> None:
    other = rng.choice([None, True, "text", [], {}, -1, 0, 1.5, 1e300, ["a"], {"a": 1}, "\ud800", ""])
    _at_random(rng, path, lambda box, key: box.__setitem__(key, other))


def odd_number(rng: random.Random, path: Path) -> None:
    number = rng.choice(["9" * 5001, "-" + "9" * 400, "1e999", "NaN", "-Infinity", str(2**63), str(-(2**64)), "-0"])
    _raw_value(rng, path, number)


def deep_value(rng: random.Random, path: Path) -> None:
    _raw_value(rng, path, rng.choice(["[" * DEPTH + "]" * DEPTH, '{"a":' * DEPTH + "1" + "}" * DEPTH]))


def deep_file(rng: random.Random, path: Path) -> None:
    path.write_text(rng.choice(["[", '{"a":']) * DEPTH)


def long_value(rng: random.Random, path: Path) -> None:
    _raw_value(rng, path, json.dumps("x" * 200_000))


def rename_key(rng: random.Random, path: Path) -> None:
    def change(box: Any, key: Any) -> None:
        value = box.pop(key)
        box.update({f"{key}x": value}) if isinstance(box, dict) else box.append(value)

    _at_random(rng, path, change)


def other_outermost(rng: random.Random, path: Path) -> None:
    path.write_text(rng.choice(["[]", "null", '"text"', "17", "{}", "true", "[[1]]"]))


def other_encoding(rng: random.Random, path: Path) -> None:
    text = path.read_text(errors="replace")
    path.write_bytes(rng.choice([text.encode("utf-16"), b"\xff\xfe" + text.encode(), text.encode("utf-8-sig")]))


JSON: tuple[Mutation, ...] = (
    delete_value, retype_value, odd_number, deep_value, deep_file, long_value, rename_key, other_outermost,
    other_encoding,
)  # fmt: skip


def other_array(rng: random.Random, path: Path) -> None:
    import numpy as np

    old = np.load(path)
    new = rng.choice([
        old.astype(np.int8), old.astype("<U8"), old.astype(old.dtype.newbyteorder()), old[:-1], old.reshape(-1),
        old.astype(np.float64), np.asfortranarray(old), np.zeros((0, *old.shape[1:]), old.dtype), old * 0,
    ])  # fmt: skip
    np.save(path, new)


def other_scores(rng: random.Random, path: Path) -> None:
    import numpy as np

    with np.load(path) as stored:
        arrays = dict(stored)
    name = rng.choice(sorted(arrays))
    old = arrays[name]
    arrays[name] = rng.choice([old.astype("<U8"), old[:-1], old.astype(np.float64), -old - 1, old.reshape(-1, 1)])
    if rng.random() < 0.3:
        del arrays[name]
    np.savez(path, **arrays)


def other_table(rng: random.Random, path: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    table = pq.ParquetFile(path).read()
    name = rng.choice(table.column_names)
    at, values = table.column_names.index(name), table[name].to_pylist()
    change = rng.choice(["drop", "text", "null", "rows", "empty", "negative", "large", "short", "nan", "rename"])
    if change == "drop":
        table = table.drop_columns([name])
    elif change == "rows":
        table = table.slice(0, rng.randrange(table.num_rows))
    elif change == "empty":
        table = table.slice(0, 0)
    elif change == "rename":
        table = table.rename_columns([f"{n}x" if n == name else n for n in table.column_names])
    else:
        row = rng.randrange(len(values))
        values = [str(v) for v in values] if change == "text" else values
        if change == "null":
            values[row] = None
        numbers = {"negative": -5, "large": 2**60, "nan": float("nan")}
        if change in numbers:
            values[row] = [numbers[change]] * len(values[row]) if isinstance(values[row], list) else numbers[change]
        if change == "short" and isinstance(values[row], list):
            values[row] = values[row][:-1]
        kind = table[name].type
        try:
            column = pa.array(values, None if change == "text" else kind)
        except (pa.ArrowInvalid, pa.ArrowTypeError, OverflowError):
            column = pa.array([str(value) for value in values])
        table = table.set_column(at, name, column)
    pq.write_table(table, path)


def other_group(rng: random.Random, path: Path) -> None:
    import h5py
    import numpy as np

    names: list[str] = []
    with h5py.File(path, "a") as file:
        file.visit(names.append)
        name = rng.choice(names)
        old = file[name][()] if isinstance(file[name], h5py.Dataset) else None
        del file[name]
        odd = [np.float32(np.nan), b"\xff\xfe", "text", np.zeros((2, 2), np.int64), np.zeros(0), 10**9, -1]
        change = rng.choice(["drop", "odd", "shorter", "float"])
        if change == "odd" or (old is None and change != "drop"):
            file[name] = rng.choice(odd)
        elif change == "shorter" and getattr(old, "ndim", 0):
            file[name] = old[:-1]
        elif change == "float" and getattr(old, "dtype", None) is not None and old.dtype.kind in "fiu":
            file[name] = np.asarray(old, np.float64) * np.inf


OF_KIND: dict[str, tuple[Mutation, ...]] = {
    ".json": JSON, ".jsonl": JSON, ".npy": (other_array,), ".npz": (other_scores,), ".parquet": (other_table,) * 4,
    ".h5": (other_group,) * 5,
}  # fmt: skip


def mutate(rng: random.Random, path: Path) -> str:
    """Damage a file in one way; return the way's name."""
    mutation = rng.choice([*BYTES, *OF_KIND.get(path.suffix, ()) * 2])
    mutation(rng, path)
    return mutation.__name__


def _flip(rng: random.Random, path: Path, count: int) -> None:
    data = bytearray(path.read_bytes())
    for _ in range(count if data else 0):
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    path.write_bytes(data)


def _lines(path: Path) -> tuple[list[str], str]:
    """The JSON texts of a file and what joins them."""
    text = path.read_text()
    return (text.rstrip("\n").split("\n"), "\n") if path.suffix == ".jsonl" else ([text], "")


def _at_random(rng: random.Random, path: Path, change: Callable[[Any, Any], Any]) -> None:
    """Change one value, however deep, of one JSON text of a file."""
    lines, joint = _lines(path)
    which = rng.randrange(len(lines))
    root = json.loads(lines[which])
    places: list[tuple[Any, Any]] = []

    def collect(value: Any) -> None:
        keys = list(value) if isinstance(value, dict) else range(len(value)) if isinstance(value, list) else ()
        for key in keys:
            places.append((value, key))
            collect(value[key])

    collect(root)
    if places:
        change(*rng.choice(places))
    lines[which] = json.dumps(root)
    path.write_text(joint.join(lines) + "\n")


def _raw_value(rng: random.Random, path: Path, text: str) -> None:
    """Put `text`, as it stands, in the place of one value."""
    mark = "\u2620"
    _at_random(rng, path, lambda box, key: box.__setitem__(key, mark))
    path.write_text(path.read_text().replace(json.dumps(mark), text))
