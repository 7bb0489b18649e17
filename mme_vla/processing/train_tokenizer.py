"""`python -m mme_vla.processing.train_tokenizer`: the command is mme_vla/commands/train_tokenizer.py."""

from mme_vla.commands.train_tokenizer import main

if __name__ == "__main__":
    main()
