"""`python -m mme_vla.data.sample`: the command is mme_vla/commands/sample.py."""

from mme_vla.commands import run

if __name__ == "__main__":
    run("sample")
