"""`python -m mme_vla.data.cache`: the command is mme_vla/commands/cache.py."""

from mme_vla.commands import run

if __name__ == "__main__":
    run("cache")
