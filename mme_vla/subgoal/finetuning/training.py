"""Fine-tuning a Qwen3-VL subgoal predictor with LoRA, as in the paper.

`mme-vla subgoal-train rows=<folder>/grounded.jsonl` (several GPUs:
`torchrun --nproc-per-node 4 -m …`)

The adapter ends up in `<output>/adapter`: `subgoal=qwenvl subgoal.adapter=<output>/adapter`
predicts with it.
"""

import os
from pathlib import Path
from typing import TYPE_CHECKING

from mme_vla.config.devices import find_device
from mme_vla.errors import UserError, counted, missing_extra, require
from mme_vla.subgoal.finetuning.rows import SETS, Collator, RowDataset
from mme_vla.subgoal.models.qwen3vl import VLM, load_model
from mme_vla.utils import write_json

if TYPE_CHECKING:
    from omegaconf import DictConfig


MODEL = "Qwen/Qwen3-VL-4B-Instruct"
_ARGUMENTS = {
    "model": MODEL,
    "train_type": "lora",  # of ms-swift 3.9 and later 3.x; version 4 calls it tuner_type
    "lora_rank": 16,
    "lora_alpha": 32,
    "target_modules": ["all-linear"],
    "freeze_vit": True,
    "freeze_aligner": True,
    "learning_rate": 1e-4,
    "warmup_ratio": 0.05,
    "num_train_epochs": 2,
    "max_length": 3200,
    "torch_dtype": "bfloat16",
    "per_device_train_batch_size": 4,
    "gradient_accumulation_steps": 4,  # times four GPUs: 64 rows a step; 3 gives the paper's 48
    "deepspeed": "zero2",
    "save_steps": 100,
    "logging_steps": 5,
}


def write_arguments(folder: Path, name: str) -> Path:
    """Write `swift_<name>.json` beside the rows, for ms-swift.

    It has to run in that folder: paths in the rows are relative to it.
    """
    path = folder / f"swift_{name}.json"
    arguments = {**_ARGUMENTS, "dataset": [f"{name}.jsonl"], "output_dir": f"swift_{name}"}
    write_json(path, arguments, indent=1)
    return path


# All linear layers of the language model; the vision tower and the merger stay as they are.
TARGETS = r".*language_model.*\.(q_proj|k_proj|v_proj|o_proj|gate_proj|up_proj|down_proj)"
ADAPTER = "adapter"
ZERO2 = {
    "zero_optimization": {
        "stage": 2,
        "overlap_comm": True,
        "contiguous_gradients": True,
        "reduce_scatter": True,
    },
    "bf16": {"enabled": "auto"},
    "gradient_clipping": "auto",
    "gradient_accumulation_steps": "auto",
    "train_batch_size": "auto",
    "train_micro_batch_size_per_gpu": "auto",
}


def accumulation(batch: int, per_device: int, processes: int) -> int:
    """Return the batches of a step, so that all processes together read `batch` rows."""
    rows_at_once = per_device * processes
    require(
        min(batch, per_device) >= 1 and batch % rows_at_once == 0,
        f"batch={batch} is no positive multiple of per_device_batch={per_device} times {processes}"
        " processes; choose numbers that divide.",
    )
    return batch // rows_at_once


def find_checkpoint(output: Path, resume: str | None) -> str | None:
    """Return the checkpoint to continue from; None for a new run."""
    checkpoints = sorted(
        output.glob("checkpoint-*"), key=lambda path: int(path.name.split("-")[-1])
    )
    if resume is None:
        if checkpoints or (output / ADAPTER).exists():
            raise UserError(
                f"{output} holds a run: continue with resume=auto, or choose another output."
            )
        return None
    if resume == "auto":
        return str(checkpoints[-1]) if checkpoints else None
    if not Path(resume).is_dir():
        raise UserError(
            f"resume={resume!r}: there is no such checkpoint folder; auto takes the newest of the"
            " run."
        )
    return resume


def fine_tune(cfg: "DictConfig") -> Path:
    """Train as configs/subgoal_train.yaml and the command line say; return the adapter's folder."""
    try:
        from peft import LoraConfig, get_peft_model
        from transformers import Trainer, TrainingArguments, set_seed
    except ImportError:
        raise missing_extra("Fine-tuning Qwen3-VL", "vlm") from None

    output = Path(cfg.output)
    checkpoint = find_checkpoint(output, cfg.resume)
    device = str(find_device(str(cfg.device)))
    # A number below 1 would mean "no limit" to transformers.
    require(
        cfg.epochs > 0 and (cfg.steps is None or cfg.steps >= 1),
        f"epochs={cfg.epochs} must be above 0, and steps={cfg.steps} 1 or more, or null.",
    )
    set_seed(cfg.seed)
    model, processor = load_model(cfg.vlm, "bfloat16" if device != "cpu" else "float32")
    rows = RowDataset(cfg.rows, processor.tokenizer, cfg.max_length)
    if rows.left_out:
        print(
            f"Left out: {counted(rows.left_out, 'row')} of more than max_length={cfg.max_length}"
            " tokens."
        )
    lora = LoraConfig(
        r=cfg.lora.rank,
        lora_alpha=cfg.lora.alpha,
        lora_dropout=cfg.lora.dropout,
        target_modules=TARGETS,
        task_type="CAUSAL_LM",
    )
    processes = int(os.environ.get("WORLD_SIZE", "1"))
    try:
        vlm = VLM(get_peft_model(model, lora), processor)
        vlm.model.config.use_cache = False
        arguments = TrainingArguments(
            output_dir=str(output),
            per_device_train_batch_size=cfg.per_device_batch,
            gradient_accumulation_steps=accumulation(cfg.batch, cfg.per_device_batch, processes),
            num_train_epochs=cfg.epochs,
            max_steps=-1 if cfg.steps is None else cfg.steps,
            learning_rate=cfg.lr,
            lr_scheduler_type="cosine",
            warmup_steps=cfg.warmup,  # below 1 it is a share of all steps
            weight_decay=cfg.weight_decay,
            adam_beta2=0.95,
            max_grad_norm=1.0,
            bf16=device != "cpu",
            use_cpu=device == "cpu",
            gradient_checkpointing=cfg.gradient_checkpointing,
            gradient_checkpointing_kwargs={"use_reentrant": False},
            dataloader_num_workers=cfg.workers,
            remove_unused_columns=False,
            seed=cfg.seed,
            data_seed=cfg.seed,
            logging_steps=cfg.log_every,
            save_steps=cfg.save_every,
            save_total_limit=cfg.keep,
            report_to=[] if cfg.report_to is None else [cfg.report_to],
            deepspeed=ZERO2 if cfg.deepspeed == "zero2" else cfg.deepspeed,
        )
        trainer = Trainer(
            model=vlm.model,
            args=arguments,
            train_dataset=rows,
            data_collator=Collator(vlm),
        )
    except (ImportError, ValueError) as error:  # such as a missing package deepspeed
        raise UserError(f"The settings of the training do not work: {error}") from None
    trainer.train(resume_from_checkpoint=checkpoint)
    if trainer.is_world_process_zero():
        vlm.model.save_pretrained(output / ADAPTER)
        name, kind = SETS.get(Path(cfg.rows).stem, SETS["grounded"])
        print(
            f"{output / ADAPTER}: subgoal={name} subgoal.kind={kind}"
            f" subgoal.adapter={output / ADAPTER} predicts with it."
        )
    return output / ADAPTER
