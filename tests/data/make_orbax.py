"""How the Orbax checkpoints in this folder were made: by Orbax itself, of golden parameters of the
released code.

    # needs orbax-checkpoint, jax and safetensors; nothing of this library
    python make_orbax.py GOLDEN_FOLDER

`orbax_run`: a run as the released code leaves it (OCDBT), parameters of the golden
TokenDrop-modulator model. `orbax_plain`: three leaves in the plain zarr layout, without the outer
`params` and `value`, one of them in bfloat16. `orbax_run.json`: sha256 of every leaf's float32
bytes, shape and name.
"""

import hashlib
import json
import shutil
import sys
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import orbax.checkpoint as ocp
from safetensors.numpy import load_file

CASE = "perceptual-tokendrop-modul"
HERE = Path(__file__).resolve().parent
STATS = {"mean": [0.0] * 8, "std": [1.0] * 8, "q01": [-1.0] * 8, "q99": [0.5 + i for i in range(8)]}


def nested(leaves: dict[str, Any]) -> dict[str, Any]:
    tree: dict[str, Any] = {}
    for path, leaf in leaves.items():
        *folders, last = path.split("/")
        node = tree
        for folder in folders:
            node = node.setdefault(folder, {})
        node[last] = leaf
    return tree


def main(golden: Path) -> None:
    stored = load_file(golden / f"model_{CASE}.safetensors")
    leaves = {
        name.removeprefix("params/"): leaf
        for name, leaf in stored.items()
        if name.startswith("params/")
    }
    run, base = HERE / "orbax_run", HERE / "orbax_plain"
    for folder in (run, base):
        shutil.rmtree(folder, ignore_errors=True)
    checkpointer = ocp.PyTreeCheckpointer()
    full = nested({f"params/{name}/value": jnp.asarray(leaf) for name, leaf in leaves.items()})
    checkpointer.save(run / "100" / "params", full)
    (run / "history_config.txt").write_text(f"{CASE}.yaml")
    assets = run / "100" / "assets" / "robomme"
    assets.mkdir(parents=True)
    (assets / "norm_stats.json").write_text(
        json.dumps({"norm_stats": {"state": STATS, "actions": STATS}})
    )
    sums = {
        name: hashlib.sha256(f"{name}{leaf.shape}".encode() + leaf.tobytes()).hexdigest()
        for name, leaf in sorted(leaves.items())
    }
    (HERE / "orbax_run.json").write_text(json.dumps(sums, indent=1) + "\n")
    few = {
        "PaliGemma/img/embedding/bias": jnp.arange(6, dtype=jnp.float32),
        "time_mlp_in/kernel": jnp.arange(6, dtype=jnp.bfloat16).reshape(2, 3) / 4,
        "scale": jnp.float32(0.01),
    }
    ocp.PyTreeCheckpointer(use_ocdbt=False).save(base, nested(few))
    for marker in HERE.glob("orbax_*/**/commit_success.txt"):
        marker.unlink()  # it names the folder on the machine that wrote it


if __name__ == "__main__":
    main(Path(sys.argv[1]))
