r"""Record the safety net: what this version reads, computes and answers, as every later version has
to.

    python tests/net/record.py                    # everything anew, into tests/data/net
    python tests/net/record.py models replies     # these parts alone

Run it from the root of a clone with all extras, on a CPU with one thread. It writes:

- `models.tar.xz`: a saved policy of every file in `configs/model`, at its smallest sizes. The
  weights are numbers that follow from the names of the tensors (`models.weight`), so the archive
  holds the header of each weight file and the few tensors that follow no rule. `models.restore`
  writes the complete files again, byte for byte.
- `models.json.xz`: of each of these policies the loss of one batch, and the actions after one short
  episode.
- `replies.json`: mistaken command lines (`replies.MISTAKES`), each with the exit code, the text and
  the words of the text that a later reply has to have: quoted values, suggestions, keys and files.
- `runs.tar.xz`: a converted dataset, its cache, training runs (plain, with adapters, in two
  shards), an evaluation with its receipt, a probe, a report card, and rows of nanoMME's board.
- `runs.json.xz`: what the commands say of them, and the losses of the runs when they are continued.
- `formats.tar.xz`: a policy in the formats of LeRobot, openpi and the released code, and a dataset
  with videos. `formats.json`: what `inspect` counts in it, and a hash of nano's vision tower.
- `earlier.tar.xz`, which nothing writes again: a finished run in two shards with claims, and one
  started from Python, as version 0.1.0 left them.
- `times.json`: seconds and imported modules of `import mme_vla` and `mme-vla --help`. Only modules
  are compared.

`tests/net/test_net.py` compares. Never record again to make that test pass: a failure means that
users' files can no longer be read, that figures have changed, or that a message has lost what it
said. Record again only after a change of meaning that the changelog announces, and only the part
that it concerns.
"""

import json
import lzma
import os
import signal
import sys
import tempfile
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")
REPOSITORY = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(REPOSITORY / folder) for folder in ("", "tests", "scripts")]
NET = REPOSITORY / "tests" / "data" / "net"
LONGEST = 120
"""Seconds that a mistake may take to be answered."""


def write(name: str, content: Any) -> None:
    """Write a JSON file, compressed if its name ends with `.xz`."""
    text = json.dumps(content, indent=1, ensure_ascii=False) + "\n"
    data = text.encode()
    (NET / name).write_bytes(lzma.compress(data, preset=9) if name.endswith(".xz") else data)


def record_models(scratch: Path) -> None:
    """Checkpoints of all models, and their figures."""
    import mme_vla
    from net import models
    from net.archives import pack

    results: dict[str, Any] = {}
    for file in sorted((REPOSITORY / "configs" / "model").glob("*.yaml")):
        folder = scratch / "models" / file.stem
        models.build(file.stem, folder, scratch / "built" / file.stem)
        results[file.stem] = models.figures(mme_vla.Policy.from_pretrained(folder))
        models.strip(folder)
        print(file.stem, results[file.stem]["loss"], flush=True)
    pack(scratch / "models", NET / "models.tar.xz")
    write("models.json.xz", results)


def record_replies(scratch: Path) -> None:
    """The replies to mistaken command lines."""
    from net import replies

    folder, results = replies.prepare(scratch / "mistakes", NET / "models.tar.xz"), {}
    signal.signal(signal.SIGALRM, too_long)
    for line in replies.mistakes():
        signal.alarm(LONGEST)
        try:
            results[line] = replies.reply(line, folder)
        except Exception as error:  # a defect is no reply to keep
            print(f"{line}: left out, {type(error).__name__}: {error}", flush=True)
            continue
        finally:
            signal.alarm(0)
        if not results[line]["code"]:
            print(f"{line}: was accepted", flush=True)
    write("replies.json", results)


def too_long(number: int, frame: object) -> None:
    raise TimeoutError(f"took more than {LONGEST} s")


def record_runs(scratch: Path) -> None:
    """A dataset, runs on it, an evaluation, a probe and a report card."""
    from net import models, runs
    from net.archives import command, inside, pack, unpack

    place, policy = (
        scratch / "runs",
        unpack(NET / "models.tar.xz", scratch / "models") / runs.POLICY,
    )
    place.mkdir()
    models.restore(policy)
    with inside(place):
        runs.make_dataset()
        runs.train()
        runs.make_board()
        command("evaluate", *runs.EVALUATE)
        Path("policy").symlink_to(policy)
        command("probe", *runs.PROBE)
        command("probe", *runs.CARD)
        Path("policy").unlink()
        for file in [file for file in Path().rglob("*") if file.is_file()]:
            if file.suffix in (".html", ".png") and file.parts[0] in (
                "probe",
                "card",
            ):  # for people alone
                file.unlink()
            elif file.name == "summary.json":
                file.write_text(file.read_text().replace(f"{place}/", ""))
    pack(place, NET / "runs.tar.xz")


def record_figures(scratch: Path) -> None:
    """What the commands say of the runs."""
    import mme_vla
    from net import models, runs
    from net.archives import EndedError, inside, unpack

    place, saved = (
        unpack(NET / "runs.tar.xz", scratch / "runs"),
        unpack(NET / "models.tar.xz", scratch / "models"),
    )
    expected = json.loads(lzma.decompress((NET / "models.json.xz").read_bytes()))
    without_loss = [model for model, figures in expected.items() if figures["loss"] is None]
    for model in {runs.POLICY, *without_loss}:
        models.restore(saved / model)
    results: dict[str, Any] = {}
    with inside(place):
        Path("policy").symlink_to(saved / runs.POLICY)
        results["actions"] = {
            run: models.figures(mme_vla.Policy.from_pretrained(Path("training", run)))["actions"]
            for run in runs.RUNS
        }
        results["dataset"] = runs.dataset()
        results["results"] = runs.result_rows()
        results["probe"] = runs.probed()
        results["card"] = runs.card()
        results["board"] = runs.board()
        results["first_loss"] = {}
        for model in without_loss:
            try:
                results["first_loss"][model] = runs.first_loss(model, saved / model)
            except EndedError as error:  # SAM2Act+ finds no keyframe in a dataset this small
                print(error, flush=True)
        results["resumed"] = {run: runs.resume(run) for run in runs.RUNS}
    write("runs.json.xz", results)


def record_formats(scratch: Path) -> None:
    """The exports of a policy, a dataset with videos, and what commands say of them."""
    from net import formats, models
    from net.archives import inside, pack, unpack

    saved = unpack(NET / "models.tar.xz", scratch / "models") / formats.POLICY
    models.restore(saved)
    place = scratch / "formats"
    place.mkdir()
    saved.rename(place / "policy")
    with inside(place):
        formats.make()
        pack(place, NET / "formats.tar.xz")
        content = {"inspected": formats.inspected(), "nano_tower": formats.nano_tower()}
    write("formats.json", content)


def record_times(scratch: Path) -> None:
    """Seconds and modules of an import and of a help text."""
    from net import times

    write(
        "times.json",
        {name: times.measure(words, repeats=5) for name, words in times.COMMANDS.items()},
    )


PARTS = {
    "models": record_models,
    "replies": record_replies,
    "runs": record_runs,
    "figures": record_figures,
    "formats": record_formats,
    "times": record_times,
}


def main(parts: list[str]) -> None:
    NET.mkdir(parents=True, exist_ok=True)
    for part in parts or PARTS:
        with tempfile.TemporaryDirectory() as place:
            PARTS[part](Path(place))


if __name__ == "__main__":
    main(sys.argv[1:])
