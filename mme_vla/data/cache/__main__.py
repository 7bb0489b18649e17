"""`python -m mme_vla.data.cache`: the command is mme_vla/commands/cache.py."""

from mme_vla.commands.cache import main

if __name__ == "__main__":
    main()
