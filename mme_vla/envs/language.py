"""Words that the tasks' sentences share."""

ORDINALS = ("first", "second", "third", "fourth", "fifth", "sixth", "seventh", "eighth", "ninth", "tenth")
NUMBERS = ("zero", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten")


def ordinal(index: int) -> str:
    """Return `first` for 0, `second` for 1, and so on."""
    return ORDINALS[index]


def number(count: int) -> str:
    """Return `one` for 1, `two` for 2, and so on."""
    return NUMBERS[count]
