"""`python -m mme_vla.data.convert`: the command is mme_vla/commands/convert.py."""

from mme_vla.commands import run

if __name__ == "__main__":
    run("convert")
