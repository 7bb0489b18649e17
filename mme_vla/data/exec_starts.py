"""`python -m mme_vla.data.exec_starts`: the command is mme_vla/commands/exec_starts.py."""

from mme_vla.commands import run

if __name__ == "__main__":
    run("exec_starts")
