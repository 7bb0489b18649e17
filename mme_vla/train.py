"""`python -m mme_vla.train`: the command is mme_vla/commands/train.py."""

from mme_vla.commands import run

if __name__ == "__main__":
    run("train")
