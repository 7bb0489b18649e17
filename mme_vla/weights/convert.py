"""`python -m mme_vla.weights.convert`: the command is mme_vla/commands/weights.py."""

from mme_vla.commands import run

if __name__ == "__main__":
    run("weights")
