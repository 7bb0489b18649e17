"""Words that the tasks' sentences share."""

ORDINALS = ("first", "second", "third", "fourth", "fifth", "sixth", "seventh", "eighth", "ninth", "tenth")
NUMBERS = ("zero", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine", "ten")


def ordinal(index: int) -> str:
    """Return `first` for 0, `second` for 1, and so on; figures from `11th` on."""
    if index < len(ORDINALS):
        return ORDINALS[index]
    count = index + 1
    teens = 10 < count % 100 < 14
    return f"{count}{'th' if teens else {1: 'st', 2: 'nd', 3: 'rd'}.get(count % 10, 'th')}"


def number(count: int) -> str:
    """Return `one` for 1, `two` for 2, and so on; figures from 11 on."""
    return NUMBERS[count] if count < len(NUMBERS) else str(count)
