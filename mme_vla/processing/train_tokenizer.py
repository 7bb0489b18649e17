"""`python -m mme_vla.processing.train_tokenizer`: the command is mme_vla/commands/train_tokenizer.py."""

from mme_vla.commands import run

if __name__ == "__main__":
    run("train_tokenizer")
