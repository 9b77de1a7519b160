"""Read vectors and other lists of numbers from options, such as 0.1,0,0.2."""

import math


def parse_numbers(option: str, text: str, count: int, form: str) -> tuple[float, ...]:
    """Return the finite numbers of an option.

    Parentheses and spaces are accepted, so that a vector can be pasted as it is printed.

    Args:
        option: name of the option, for the error message.
        text: the text given, such as `0.1,0,0.2`.
        count: how many numbers there have to be.
        form: their names and unit, such as `x,y,z (m)`, for the error message.

    Raises:
        ValueError: another count, or a word that is not a finite number.
    """
    words = text.strip().removeprefix("(").removesuffix(")").split(",")
    try:
        numbers = tuple(float(word) for word in words)
    except ValueError:
        numbers = ()
    if len(numbers) != count or not all(map(math.isfinite, numbers)):
        raise ValueError(
            f"{option}: expected {count} numbers between commas, {form}, found {text!r}"
        )
    return numbers
