"""`python -m mme_vla.envs.record`: the command is mme_vla/commands/record.py."""

from mme_vla.commands import run

if __name__ == "__main__":
    run("record")
