"""`python -m mme_vla.serving.vla_eval`: the command is mme_vla/commands/harness.py."""

from mme_vla.commands import run

if __name__ == "__main__":
    run("harness")
