"""`python -m mme_vla.inspect`: the command is mme_vla/commands/inspect.py."""

from mme_vla.commands.inspect import main

if __name__ == "__main__":
    main()
