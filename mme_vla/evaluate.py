"""`python -m mme_vla.evaluate`: the command is mme_vla/commands/evaluate.py."""

from mme_vla.commands import run

if __name__ == "__main__":
    run("evaluate")
