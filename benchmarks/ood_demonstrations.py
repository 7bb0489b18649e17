"""The demonstrator on many episodes, with or without images needed: success and stored steps beside
the official ones.

    python benchmarks/ood_demonstrations.py ood results.csv
    python benchmarks/ood_demonstrations.py train results.csv
    python benchmarks/ood_demonstrations.py report results.csv

`ood` runs the 800 rows of RoboMME-OOD, `train` the training episodes of `demo_lengths.csv`. Both
append a row an episode and leave out those that the file already has, so that they can be stopped
and continued. `report` prints Markdown. `MME_VLA_OOD` and `MME_VLA_LENGTHS` name the folder with
`expert_steps.csv` and `cells.csv`, and the file with the official lengths; by default those in
`../shared`.
"""

import argparse
import csv
import os
import statistics
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from mme_vla.envs import metadata
from mme_vla.envs.make import make_task
from mme_vla.envs.robomme.recording.recorder import Recorder
from mme_vla.envs.robomme.robot import control
from mme_vla.envs.robomme.scene.placement import SceneError

SHARED = Path(__file__).resolve().parents[1].parent / "shared"
OOD_FOLDER = Path(os.environ.get("MME_VLA_OOD") or SHARED / "ood")
LENGTHS = Path(os.environ.get("MME_VLA_LENGTHS") or SHARED / "spec" / "demo_lengths.csv")
FIELDS = (
    "split",
    "task",
    "episode",
    "tier",
    "success",
    "execution",
    "video",
    "stored",
    "detours",
    "seconds",
    "error",
)


def read(path: Path) -> list[dict[str, str]]:
    """Rows of a CSV file; none where it is absent."""
    return list(csv.DictReader(path.open(newline=""))) if path.is_file() else []


def run(task: str, options: dict[str, Any]) -> dict[str, Any]:
    """Demonstrate one scene without images."""
    started, detours = time.process_time(), [0]
    sampler = control.plan_free

    def counted(*args: Any, **kwargs: Any) -> Any:
        detours[0] += 1
        return sampler(*args, **kwargs)

    control.plan_free = counted
    try:
        env = make_task(task, render=False, **options)
        try:
            result = Recorder(env, render=False).record()
        finally:
            env.close()
        facts = {
            "success": int(result.success),
            "execution": result.stored - result.video,
            "video": result.video,
            "stored": result.stored,
            "error": result.error or "",
        }
    except SceneError as error:
        facts = {
            "success": 0,
            "execution": 0,
            "video": 0,
            "stored": 0,
            "error": f"no scene: {error}",
        }
    finally:
        control.plan_free = sampler
    return facts | {"detours": detours[0], "seconds": round(time.process_time() - started, 1)}


def jobs(split: str) -> Iterator[tuple[dict[str, Any], dict[str, Any]]]:
    """What identifies an episode, and the options of its task; round by round over the tasks."""
    if split == "ood":
        expert = {
            (row["task"], int(row["episode"])) for row in read(OOD_FOLDER / "expert_steps.csv")
        }
        # Those whose expert's steps are known come first.
        order = {
            t: sorted(range(50), key=lambda n, t=t: (t, n) not in expert)
            for t in metadata.TASK_NAMES
        }
        for task, number in (
            (task, order[task][i]) for i in range(50) for task in metadata.TASK_NAMES
        ):
            spec = metadata.episode(task, "ood", number)
            yield {"task": task, "episode": number, "tier": spec.difficulty}, spec.options
    for row in sorted(read(LENGTHS), key=lambda row: (row["recovery"] != "", int(row["episode"]))):
        if split == "train":
            options = {
                "seed": int(row["seed"]),
                "difficulty": row["difficulty"],
                "recovery": row["recovery"] or None,
            }
            yield (
                {"task": row["task"], "episode": int(row["episode"]), "tier": row["difficulty"]},
                options,
            )


def measure(split: str, path: Path) -> None:
    """Run what the file lacks."""
    if split == "train" and not LENGTHS.is_file():
        raise SystemExit(
            f"There is no {LENGTHS}: MME_VLA_LENGTHS names the file with the official lengths."
        )
    done = {(row["split"], row["task"], int(row["episode"])) for row in read(path)}
    with path.open("a", newline="") as file:
        writer = csv.DictWriter(file, FIELDS)
        if not done:
            writer.writeheader()
        for facts, options in jobs(split):
            if (split, facts["task"], facts["episode"]) not in done:
                writer.writerow({"split": split} | facts | run(facts["task"], options))
                file.flush()


def shares(pairs: Iterable[tuple[int, int]]) -> str:
    """How many pairs (measured, official) are equal and how many within 1 %, and the median
    difference.
    """
    known = list(pairs)
    if not known:
        return "– | – | – | –"
    differences = [abs(local - reference) / reference for local, reference in known]
    equal = sum(difference == 0 for difference in differences)
    near = sum(difference <= 0.01 for difference in differences)
    return f"{len(known)} | {equal} | {near} | {100 * statistics.median(differences):.2f}"


def cause(row: dict[str, str], official: dict[str, str]) -> str:
    """Why a length differs: a sampled detour, an injected recovery, or else contact."""
    if int(row["detours"]):
        return "detour"
    return "recovery" if official.get("recovery") else "contact"


def report(path: Path) -> None:
    """Print tables of what was measured so far."""
    rows = read(path)
    expert = {
        (r["task"], int(r["episode"])): int(r["expert_steps"])
        for r in read(OOD_FOLDER / "expert_steps.csv")
    }
    lengths = {(r["task"], int(r["episode"])): r for r in read(LENGTHS)}
    print(
        "| task | rows | success | compared | equal | within 1 % | median difference, % |\n|---|"
        + "---:|" * 6
    )
    for task in (*metadata.TASK_NAMES, ""):
        mine = [r for r in rows if r["split"] == "ood" and task in ("", r["task"])]
        keys = [((r["task"], int(r["episode"])), int(r["execution"])) for r in mine]
        pairs = [(steps, expert[key]) for key, steps in keys if key in expert]
        print(
            f"| {task or 'all'} | {len(mine)} | {sum(r['success'] == '1' for r in mine)} |"
            f" {shares(pairs)} |"
        )
    for r in rows:
        if r["success"] != "1":
            print(
                f"- {r['split']} {r['task']} {r['episode']} ({r['tier']}): {r['error'] or 'failed'}"
            )
    print(
        "\n| task | compared | equal | within 1 % | median difference, % | detour | recovery |"
        " contact |\n|---|" + "---:|" * 7
    )
    train = [(r, lengths[r["task"], int(r["episode"])]) for r in rows if r["split"] == "train"]
    for task in (*metadata.TASK_NAMES, "", "plain"):
        mine = [
            (r, of)
            for r, of in train
            if task in ("", r["task"])
            or (task == "plain" and not of["recovery"] and r["detours"] == "0")
        ]
        causes = [cause(r, of) for r, of in mine if r["stored"] != of["official"]]
        counts = " | ".join(str(causes.count(name)) for name in ("detour", "recovery", "contact"))
        name = {"": "all", "plain": "without detour or recovery"}.get(task, task)
        print(
            f"| {name} | {shares((int(r['stored']), int(of['official'])) for r, of in mine)} |"
            f" {counts} |"
        )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("what", choices=("ood", "train", "report"))
    parser.add_argument("path", type=Path)
    args = parser.parse_args()
    if args.what == "report":
        report(args.path)
    else:
        measure(args.what, args.path)


if __name__ == "__main__":
    main()
