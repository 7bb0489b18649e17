"""Mistaken command lines, the files that they name, and what must survive of the
replies to them.
"""

import difflib
import re
import shlex
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from net import models
from net.archives import inside, run, unpack

MISTAKES = r"""
# The command itself
trian model=pi05
evalute checkpoint=nano
result outputs
nanno task=VideoUnmask
evaluation checkpoint=nano

# train
train model=tokendrp_expert
train model=framesamp-modul
train --model tokendrop_expert
train --data sample
train model
train pi05
train model = pi05
train model=pi05 lr=1e-3
train model=pi05 train.lrr=1e-3
train model=pi05 trian.steps=3
train model=pi05 train.steps=many
train model=pi05 train.steps=1.5
train model=pi05 train.steps=-5
train model=pi05 train.batch_size=0
train model=pi05 train.device=gpu
train model=pi05 train.warmup=true
train model=pi05 train.schedule=linear
train model=pi05 train.part_lr={vison:0.1}
train model=pi05 policy.augment=maybe
train model=pi05 policy.compute_dtype=float8
train model=pi05 policy.name=dreaming
train model=pi05 memory.budget=64
train model=pi05 memory=framesmp
train model=pi05 integration=modulater
train model=pi05 backbone=tinny
train model=pi05 embodiment=squidarm
train model=pi05 finetune=lorra
train model=pi05 finetune=lora finetune.rank=0
train model=pi05 logger=wandbb
train model=pi05 data=roborne
train model=pi05 data=lerobot
train model=pi05 data=lerobot data.sources=[missing]
train model=pi05 data=lerobot data.sources=[not_a_dataset]
train model=pi05 data.val_episodes=all_of_them
train model=framesamp_modul memory.budget=100
train model=framesamp_modul memory.budget=-4
train model=framesamp_modul memory.gird=2
train model=framesamp_modul memory.grid=3
train model=framesamp_modul integration=none
train model=spacetime_modul memory.every=0
train model=mine
train model=pi05 resume=missing
train model=pi05 resume=empty
train model=pi05 init_from=missing
train model=pi05 init_from=cut
train model=pi05 init_from=changed
train model=pi05 plugins=[no_such_module]
train model=pi05 train.steps=[1
train model=pi05 =3
train model=pi05 tasks=[VideoUnmask, StopCube]
train model=pi05 train=quick
train model=pi05 experiment=robome
train --config configs
train --config-dir missing model=pi05
train model=pi05 seed=minus
train model=pi05 train.parallel.strategy=fdsp
train model=pi05 output=file.txt

# cache, convert, record, gallery, exec-starts
cache model=pi05
cache model=framesamp_modl
cache model=framesamp_modul data=lerobot data.sources=[missing]
cache model=framesamp_modul init_from=missing
convert input=missing output=new
convert input=empty output=new
convert output=new
convert input=empty
convert input=empty output=new images=jpg
convert input=empty output=new video.codec=mp4
convert inptu=empty output=new
record tasks=PickXtims episodes=1 output=new
record episodes=1 output=new
record task=PickXtimes output=new
record task=PickXtimes episodes=1
record task=PickXtimes episodes=one output=new
record task=PickXtimes episodes=1 output=not_a_dataset
record task=PickXtimes episodes=1 output=new split=validation
record task=PickXtimes episodes=1 output=new images=gif
record task=PickXtimes episodes=1 output=new frames=some
record task=PickXtimes episodes=1 output=new workers=0
record env=no_such_env task=PickXtimes episodes=1 output=new
gallery --task VideoUmask
gallery task=VideoUmask
exec-starts input=missing output=new.json

# evaluate
evaluate
evaluate nano
evaluate checkpoint=nanno
evaluate checkpoint=missing
evaluate checkpoint=empty
evaluate checkpoint=missing/latest
evaluate checkpoint=outputs/missing
evaluate checkpoint=nano with=[drop:all]
evaluate checkpoint=nano tasks=VideoUmask
evaluate checkpoint=nano task=[VideoUnmask,StopCub]
evaluate checkpoint=nano task=VideoUnmask tasks=StopCube
evaluate checkpoint=nano task=VideoUnmask split=tset
evaluate checkpoint=nano task=VideoUnmask episodes=four
evaluate checkpoint=nano task=VideoUnmask episodes=[900]
evaluate checkpoint=nano task=VideoUnmask episodes=5-2
evaluate checkpoint=nano task=VideoUnmask video=yes
evaluate checkpoint=nano task=VideoUnmask workers=0
evaluate checkpoint=nano task=VideoUnmask max_steps=-1
evaluate checkpoint=nano task=VideoUnmask subgoal=orcale
evaluate checkpoint=nano task=VideoUnmask subgoal=oracle
evaluate checkpoint=nano task=VideoUnmask device=cuda:x
evaluate checkpoint=nano task=VideoUnmask dtype=int8
evaluate checkpoint=nano task=VideoUnmask shard=3/2
evaluate checkpoint=nano task=VideoUnmask shard=first
evaluate checkpoint=nano task=VideoUnmask execute=0
evaluate checkpoint=nano task=VideoUnmask env=robomee
evaluate checkpoint=cut task=VideoUnmask
evaluate checkpoint=changed task=VideoUnmask
evaluate checkpoint=half task=VideoUnmask
evaluate checkpoint = nano
evaluate checkpoint=nano epsiodes=1
evaluate --checkpoint nano

# probe, inspect, results, analyse
probe
probe checkpoint=nano
probe checkpoint=nano recordings=missing
probe checkpoint=nano recordings=not_a_dataset
probe checkpoint=nano with=[dropall]
probe checkpoint=nano with=[dropall] recordings=sample
probe checkpoint=outputs/missing recordings=sample
probe checkpoint=nano with=[drop:many] recordings=not_a_dataset
probe checkpoint=nano offline=false
probe checkpoint=nano offline=false online=true task=VideoUmask
probe checkpoint=groundsg recordings=not_a_dataset
probe checkpoint=nano draws=0 recordings=not_a_dataset
probe compare=[missing]
probe card=yes checkpoint=nano
inspect
inspect checkpoint=missing
inspect checkpoint=nano dataset=sample
inspect checkpoint=cut
inspect checkpoint=changed
inspect dataset=missing
inspect dataset=not_a_dataset
inspect dataset=not_a_dataset episode=first
inspect chekpoint=nano
results
results missing
results empty
results empty --epsiodes 3
results empty --episodes four
results empty --tasks VideoUmask
results verify
results verify missing
results verify empty
analyse
analyse checkpoint=nano
analyse tokens

# serve, play, nano, weights and the rest
serve
serve checkpoint=missing
serve checkpoint=nano port=80000
serve checkpoint=nano port=http
serve checkpoint=nano max_batch=0
serve checkpoint=nano sampling=grpah
serve checkpoint=nano action_space=joints
serve checkpoint=nano limits.frmes=3
serve checkpoint=nano require_key=true
play
play task=VideoUmask
play task=VideoUnmask player=hooman
play task=VideoUnmask player=random episodes=none
play task=VideoUnmask port=-1
nano task=VideoUmask
nano task=VideoUnmask model=nope
nano task=VideoUnmask stage=trian
nano task=VideoUnmask trainings=0
nano task=VideoUnmask memories.framesmp.budget=4
nano task=VideoUnmask nano=nano61
nano board missing
nano board empty
nano bord outputs
weights
weights missing new
weights cut new
weights groundsg new --to lerbot
vision-pretrain steps=none
subgoal-build input=missing output=new
subgoal-build outptu=new
subgoal-train data=missing
docs --biuld
harness
harness checkpoint=missing
harness checkpoint=nano prot=1
"""
"""One command line a line, without `mme-vla`; `prepare` writes the files that they name."""


def mistakes() -> list[str]:
    """The mistaken command lines."""
    return [line for line in MISTAKES.splitlines() if line and not line.startswith("#")]


def prepare(folder: Path, archive: Path) -> Path:
    """Write the files that the mistakes name: a model of one's own, a checkpoint, damaged copies of
    it.
    """
    (folder / "empty").mkdir(parents=True)
    (folder / "not_a_dataset").mkdir()
    (folder / "not_a_dataset" / "data.csv").write_text("a,b\n1,2\n")
    (folder / "file.txt").write_text("text\n")
    (folder / "configs" / "model").mkdir(parents=True)
    (folder / "configs" / "model" / "mine.yaml").write_text(
        "# @package _global_\n"
        "defaults: [{/memory: framesamp}, {/integration: modulator}]\n"
        "name: mine\n"
    )
    unpacked = unpack(archive, folder / "unpacked")
    shutil.move(unpacked / "groundsg", folder / "groundsg")
    shutil.rmtree(unpacked)
    models.restore(folder / "groundsg")
    for name in ("cut", "changed", "half"):
        shutil.copytree(folder / "groundsg", folder / name)
    weights = folder / "cut" / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:1000])
    config = folder / "changed" / "config.json"
    config.write_text(config.read_text().replace('"prompt_length"', '"prompt_lenght"', 1) + " ")
    (folder / "half" / "norm_stats.json").unlink()
    return folder


def reply(line: str, folder: Path) -> dict[str, Any]:
    """The exit code of a command line that runs in `folder`, and its text with that folder and
    times replaced.
    """
    with inside(folder):
        code, out, err = run(*shlex.split(line))
    text = f"{out}\n{err}".strip()
    for place, name in ((folder, "<here>"), (Path(__file__).resolve().parents[2], "<repository>")):
        text = text.replace(str(place), name)
    text = re.sub(r"\d{4}-\d\d-\d\d[_/ T]\d\d[-:]\d\d[-:]\d\d", "<now>", text)
    text = re.sub(r"\b\d\d:\d\d:\d\d\b", "<now>", text)
    return {"code": code, "text": text, "essential": essential(line, text)}


QUOTED = re.compile(r"'([^'\n]{1,120})'|`([^`\n]{1,120})`|\"([^\"\n]{1,120})\"")
KEY = re.compile(
    r"[A-Za-z_][\w.]*=[^\s,;:()'\"`…]*[^\s,;:.()'\"`…]|[A-Za-z_][\w.]*=|--[a-z][a-z-]+"
)
PLACE = re.compile(r"[\w.-]+/[\w./-]*\w|\w+\.(?:json|jsonl|safetensors|yaml|txt)\b")
USAGE = re.compile(r"^usage:.*?(?=^\S*[^\n]*error:|\Z)", re.DOTALL | re.MULTILINE)


def typed(line: str) -> set[str]:
    """Keys, values and options of a command line."""
    words = shlex.split(line)[1:]
    return {
        part
        for word in words
        for part in (word, *word.partition("=")[::2], *re.split(r"[=,\[\]]", word))
        if part
    }


def essential(line: str, text: str) -> list[str]:
    """What a reply names, which later replies have to name, too.

    That is: quoted texts, keys with values, options, files, and whatever of the command line occurs
    in it.
    """
    text = re.sub(r"<repository>\S*", "", USAGE.sub("", text))
    names = {
        word
        for word in typed(line)
        if len(word) > 2 and re.search(rf"(?<!\w){re.escape(word)}(?!\w)", text)
    }
    names |= {next(filter(None, match)) for match in QUOTED.findall(text)}
    names |= {*KEY.findall(text), *PLACE.findall(text)}
    names = {word.partition("<")[0].strip() for word in names}  # what follows is a placeholder
    return sorted(names - {""})


def missing(expected: Mapping[str, Any], text: str) -> list[str]:
    """The essential words of a recorded reply that a new one lacks."""
    return [word for word in expected["essential"] if word not in text]


def difference(expected: str, text: str) -> str:
    """Both replies, for a failed test."""
    return "\n".join(
        difflib.unified_diff(
            expected.splitlines(), text.splitlines(), "recorded", "today", lineterm=""
        )
    )
