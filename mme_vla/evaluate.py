"""`python -m mme_vla.evaluate`: the command is mme_vla/commands/evaluate.py."""

from mme_vla.commands.evaluate import main

if __name__ == "__main__":
    main()
