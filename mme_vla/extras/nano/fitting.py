"""One policy of a nano run: built, trained on demonstrations, and evaluated in closed loop; each
once.
"""

import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch
from omegaconf import OmegaConf
from torch.utils.flop_counter import FlopCounterMode

from mme_vla.config.composition import compose, resolved
from mme_vla.config.naming import digest
from mme_vla.config.plugins import import_plugins, plugins_of
from mme_vla.config.sections import read_section
from mme_vla.embodiment import Embodiment
from mme_vla.errors import UserError, brief, counted, listed, require
from mme_vla.extras.nano.demonstrations import Demonstration
from mme_vla.extras.nano.learning import Decisions, choice_errors, position_error, statistics
from mme_vla.extras.nano.rows import CONFIG, TRAINED
from mme_vla.extras.nano.settings import LearningSettings
from mme_vla.extras.nano.tokens import FrameTokens, TokenStore
from mme_vla.memory.perturbation import build_transforms
from mme_vla.policy.build import build_from_config
from mme_vla.policy.finetune import apply_finetuning, copy_tower
from mme_vla.policy.mme import MMEPolicy, mme_of
from mme_vla.policy.sections import PolicySections
from mme_vla.policy.training_identity import KEY as TRAINING
from mme_vla.policy.training_identity import identify, identity_of
from mme_vla.training.checkpoint import checkpoints_in, read_state, tidy
from mme_vla.training.logging import ProgressLine, open_loggers
from mme_vla.training.loop import Trainer
from mme_vla.training.order import Validation
from mme_vla.training.runs import CHECKPOINTS, METRICS, check_content, claim_run, differing_keys
from mme_vla.training.settings import KeepRule, TrainSettings
from mme_vla.utils import FolderLock, read_json, read_lines, write_json

HELD_OUT = 10  # One demonstration in so many only measures the loss


def compose_policy(
    model: str,
    memories: Mapping[str, Mapping[str, Any]],
    words: Sequence[str],
    extra_dirs: Sequence[Path] = (),
    plugins: Sequence[str] = (),
    budget: int | None = None,
) -> dict[str, Any]:
    """Compose one model at nano size, as plain values, and import its plugins.

    model: a file of configs/model.
    memories: settings of each memory by its name, used where the model has it.
    words: overrides that all models share, such as `embodiment=robomme_waypoint_front`.
    extra_dirs: further trees, as `--config-dir` adds them.
    plugins: modules that the model needs beside its own.
    budget: memory tokens, instead of those of `memories`.
    """
    base = compose("policy", [f"model={model}", *words], extra_dirs=extra_dirs)
    settings: dict[str, Any] = {}
    if base.memory is not None:
        settings |= memories.get(str(base.memory.name), {})
        if budget is not None:
            settings["budget"] = budget
    memory_words = [f"memory.{key}={value}" for key, value in settings.items()]
    composed = compose("policy", [f"model={model}", *words, *memory_words], extra_dirs=extra_dirs)
    composed.plugins = list(dict.fromkeys([*plugins, *plugins_of(composed, model)]))
    import_plugins(composed.plugins)
    return resolved(composed)


def build(config: Mapping[str, Any]) -> MMEPolicy:
    """A policy with fresh weights but for its tower, which does not learn."""
    policy = mme_of(build_from_config(OmegaConf.create(dict(config))), "nanoMME")
    if policy.augment:
        raise UserError(
            "policy.augment=true changes images, and nano policies learn from tokens: set it to"
            " false."
        )
    apply_finetuning(policy, freeze_vision=True)
    return policy


@dataclass(frozen=True)
class Training:
    """One training of a row.

    row: what the page calls it.
    seed: the training's own, as in `config`.
    config: as `compose_policy` gives it.
    settings, learning: the sections `train` and `learning`.
    folder: of the run.
    files: demonstrations; one in `HELD_OUT` only measures.
    store: their tokens.
    tower_seed: of the tower's weights where they are fresh.
    """

    row: str
    seed: int
    config: Mapping[str, Any]
    settings: Mapping[str, Any]
    learning: Mapping[str, Any]
    folder: Path
    files: Sequence[Path]
    store: TokenStore
    tower_seed: int = 0

    @property
    def content(self) -> list[str]:
        """Digests of the demonstrations."""
        acts = Embodiment.from_dict(PolicySections.of(self.config).embodiment).action
        return list(content_of(tuple(self.files), tuple(acts.choice)))

    @property
    def full_config(self) -> dict[str, Any]:
        """All that the trained policy follows from, with digests of the demonstrations as
        `data.content`.
        """
        sections = {
            "train": dict(self.settings),
            "learning": dict(self.learning),
            "data": {"content": self.content},
        }
        return {**self.config, **sections}

    @property
    def done(self) -> bool:
        """Whether there is nothing left to do.

        Raises:
            UserError: the folder holds a training of other settings or on other demonstrations.
        """
        if not (self.folder / TRAINED).is_file():
            return False
        now, then = self.full_config, read_state(self.checkpoint)["config"]
        changed = differing_keys(then, now)
        if then["train"]["steps"] != now["train"]["steps"]:
            changed["train.steps"] = (then["train"]["steps"], now["train"]["steps"])
        about = read_json(self.folder / TRAINED, "a training's end")
        data = identify(now, self.content)["data"]
        if about["data"] != data:
            changed["the demonstrations' digest"] = (about["data"], data)
        differences = []
        for key, (old, new) in changed.items():
            differences.append(f"{key} was {brief(old)}, and is {brief(new)}")
        require(
            not differences,
            f"{self.folder} holds a training with other settings: {listed(differences)}. Choose"
            " another output, or move that folder away.",
        )
        return True

    @property
    def checkpoint(self) -> Path:
        """The last checkpoint of a training that is done."""
        return checkpoints_in(self.folder / CHECKPOINTS)[-1]


def train_in_process(job: Training) -> Path:
    """`train` with one thread, for several processes side by side."""
    torch.set_num_threads(1)
    return train(job)


def _remove_drafts(folder: Path) -> None:
    """Remove what a training left that ended before its first checkpoint; other things in it are
    refused later.
    """
    drafts = folder / CHECKPOINTS
    if drafts.is_dir():
        tidy(drafts, KeepRule())
        if any(drafts.iterdir()):
            return
        drafts.rmdir()
    (folder / METRICS).unlink(missing_ok=True)


def train(job: Training) -> Path:
    """Train a policy, or continue with it; the last checkpoint."""
    from accelerate import Accelerator

    if job.done:
        return job.checkpoint
    started = time.perf_counter()
    started_cpu = time.process_time()
    folder = job.folder
    full_config = job.full_config
    content = job.content
    train_settings = TrainSettings.from_dict(job.settings, job.seed)
    resume = str(folder) if checkpoints_in(folder / CHECKPOINTS) else None
    if resume is None:
        with FolderLock(folder, "training run"):  # it may have ended before its first checkpoint
            _remove_drafts(folder)
    run, lock = claim_run(folder, True, resume, full_config)
    with ExitStack() as resources:
        resources.push(lock)  # it is held already
        if run.checkpoint is not None:
            check_content(run.checkpoint, content)
        policy = build(job.config)
        if job.tower_seed != job.seed:
            copy_tower(build({**job.config, "seed": job.tower_seed}), policy)
        samples, val_set = prepared(policy, job)
        card = {"data": counted(len(job.files), "demonstration"), "recipe": dict(job.settings)}
        validation = Validation(
            val_set,
            val_set.collate,
            train_settings.val_samples,
            train_settings.batch_size,
            train_settings.seed,
        )
        cost = measured_cost(policy, samples, train_settings.batch_size)
        trainer = Trainer(
            policy,
            samples,
            samples.collate,
            validation,
            train_settings,
            run,
            full_config,
            Accelerator(cpu=True),
            facts={
                TRAINING: identify(full_config, content),
                "card": card,
            },
            name=str(PolicySections.of(full_config).name),
        )
        line = ProgressLine(train_settings.steps, run.step)
        loggers = open_loggers(folder, {}, run.step)
        line.say(
            f"{trainer.describe()}; {counted(len(samples), 'decision')} of"
            f" {counted(len(job.files), 'demonstration')}"
        )
        updates_cpu = time.process_time()
        try:
            with line:
                finished = trainer.run(line, loggers)
        finally:
            loggers.close()
    assert trainer.last_checkpoint is not None
    if not finished:
        raise SystemExit(128 + (trainer.stopped_by or 0))
    spent: dict[str, float | None] = {"update_s": None, "minutes": None, "cpu_minutes": None}
    updates = train_settings.steps - run.step
    if updates:
        spent["update_s"] = (time.process_time() - updates_cpu) / updates
    if run.step == 0:  # what a resumed training took before is not known
        spent["minutes"] = (time.perf_counter() - started) / 60
        spent["cpu_minutes"] = (time.process_time() - started_cpu) / 60

    # The saved policy, as anyone else will load it
    learned = MMEPolicy.from_pretrained(str(trainer.last_checkpoint)).eval()
    config_text = OmegaConf.to_yaml(OmegaConf.create(learned.config))
    (folder / CONFIG).write_text(config_text, encoding="utf-8")
    about = summary(job, learned, len(samples.tasks))
    about |= cost | spent | held_out(learned, val_set, folder)
    write_json(folder / TRAINED, about)
    return trainer.last_checkpoint


def summary(job: Training, policy: MMEPolicy, decisions: int) -> dict[str, Any]:
    """What was trained on what, as `trained.json` says it."""
    identity = identity_of(policy.config)
    assert identity is not None  # `train` has written it
    sections = PolicySections.of(policy.config)
    return {
        "row": job.row,
        "kind": "policy",
        "trained": True,
        "seed": job.seed,
        "steps": job.settings["steps"],
        "updates": job.settings["steps"],
        "batch_size": job.settings["batch_size"],
        "decisions": decisions,
        "demonstrations": dict(Counter(file.parent.name for file in job.files)),
        "data": identity.data,
        "recipe": identity.recipe,
        "weights": identity.weights,
        "tower": job.store.tower,
        "memory": sections.memory.get("name"),
        "integration": sections.integration.get("name"),
        "budget": None if policy.memory is None else policy.memory.budget,
    }


def measured_cost(policy: MMEPolicy, samples: Decisions, batch_size: int) -> dict[str, Any]:
    """Learned parameters, and the floating-point operations of an update and of a decision on ready
    tokens.
    """
    batch = samples.collate([samples[i % len(samples)] for i in range(batch_size)])
    with FlopCounterMode(display=False) as update:
        policy.train()(batch)[0].backward()
    policy.zero_grad(set_to_none=True)
    with FlopCounterMode(display=False) as decision:
        policy.eval().sample_actions(samples.collate([samples[0]]))
    return {
        "parameters": sum(p.numel() for p in policy.parameters() if p.requires_grad),
        "update_flops": update.get_total_flops(), "decision_flops": decision.get_total_flops(),
    }  # fmt: skip


def held_out(policy: MMEPolicy, val_set: Decisions, folder: Path) -> dict[str, Any]:
    """How a trained policy does on demonstrations that it did not learn from."""
    losses = []
    for line in learning_curve(folder):
        if "val/loss" in line:
            losses.append((line["val/loss"], line["step"]))
    metrics: dict[str, Any] = {"val_loss": None, "best_update": None}
    if losses:
        metrics["val_loss"] = losses[-1][0]
        metrics["best_update"] = min(losses)[1]
    if policy.embodiment.action.choice:
        return metrics | asdict(choice_errors(policy, val_set))
    return metrics | {"off_by_m": position_error(policy, val_set).tolist()}


@lru_cache(maxsize=1)  # all trainings of a run have the same
def content_of(files: tuple[Path, ...], choice: tuple[int, ...]) -> tuple[str, ...]:
    """Digests of demonstrations: of their scenes, goals, numbers of decisions and letters, and
    `carried_out`.

    States and poses are left out: they differ in their last bits between processors. A
    demonstration that ends otherwise on another processor has another digest. choice: columns of an
    action's letters, none of motions.
    """
    digests = []
    for file in files:
        made = Demonstration.load(file, images=False)
        targets = made.motions.targets
        letters = targets[:, list(choice)].argmax(1).tolist() if choice else None
        facts = {"decisions": len(targets), "letters": letters}
        facts |= {name: getattr(made, name) for name in ("task", "seed", "difficulty", "goal")}
        if made.carried_out:  # others keep the digest that they had without it
            facts["carried_out"] = True
        digests.append(digest(facts, 64))
    return tuple(digests)


def prepared(policy: MMEPolicy, job: Training) -> tuple[Decisions, Decisions]:
    """Decisions to learn from, and to measure by, which history transforms do not change."""
    learning = read_section(LearningSettings, job.learning, "learning")
    files = job.files
    measured = files[HELD_OUT - 1 :: HELD_OUT] or files[-1:]
    learnt = [file for file in files if file not in measured] or files  # there may be one alone
    processor = policy.require_processor()
    demonstrations = (Demonstration.load(file, images=False) for file in learnt)
    processor.stats = statistics(demonstrations, policy)

    def read(some: Sequence[Path]) -> Iterator[tuple[Demonstration, FrameTokens]]:
        for file in some:
            yield Demonstration.load(file, images=False), job.store.read(file)

    samples = Decisions.of(
        policy,
        read(learnt),
        learning.elsewhere,
        build_transforms(learning.history_transforms),
        job.seed,
        learning.reflect,
        learning.sides,
        oversample=learning.often,
        noise=learning.noise,
        token_noise=learning.blur,
        balanced=learning.balanced,
    )
    return samples, Decisions.of(policy, read(measured), learning.elsewhere)


def learning_curve(folder: Path) -> list[dict[str, float]]:
    """What the run logged, a dictionary a line."""
    return read_lines(folder / "metrics.jsonl", dict, "the log of a run")
