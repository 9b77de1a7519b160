"""Mistakes in numbers: as programs and people spell them, and numbers that cannot be."""

import random
import re
from collections.abc import Callable

from .fuzz_text import FLOAT, Mutation, of_text

MANY_DIGITS = 5000
"""Digits of a number that is far too long."""

_FOUR_FLOATS = re.compile(rf"({FLOAT.pattern})" + rf"([^\w.+-]+)({FLOAT.pattern})" * 3)

_KEYED_QUATERNION = re.compile(r"\b(q?)([wxyz])(\"?: )(-?[0-9]+\.[0-9]+)")


def respelled(spell: Callable[[str], str | None]) -> Mutation:
    """Return the mutation that writes one number in another way, with the same value."""
    return of_text(lambda text, rng: _one_number(text, spell, rng), keeps_values=True)


def renumbered(change: Callable[[float, random.Random], str]) -> Mutation:
    """Return the mutation that puts another number in the place of one."""
    return of_text(
        lambda text, rng: _one_number(text, lambda number: change(float(number), rng), rng)
    )


def _one_number(text: str, change: Callable[[str], str | None], rng: random.Random) -> str | None:
    numbers = list(FLOAT.finditer(text))
    # Not every number can be written in every way.
    for found in rng.sample(numbers, len(numbers)):
        word = change(found[0])
        if word is not None:
            return text[: found.start()] + word + text[found.end() :]
    return None


def _other_digits(zero: str) -> Mutation:
    digits = {str(k): chr(ord(zero) + k) for k in range(10)}
    return respelled(lambda number: "".join(digits.get(x, x) for x in number))


def _grouped(mark: str) -> Callable[[str], str | None]:
    def spell(number: str) -> str | None:
        if "e" in number.lower():
            return None
        # Digits of the fraction are grouped by some programs, too.
        whole, _, rest = number.partition(".")
        return f"{whole}.{rest[:3]}{mark}{rest[3:] or '000'}"

    return spell


def _sexagesimal(number: str) -> str | None:
    # 1.5 is 1:30, as YAML 1.1 reads minutes and seconds; with an exponent there is no such way.
    if "e" in number.lower():
        return None
    whole, _, rest = number.partition(".")
    return f"{whole}:{60.0 * float(f'0.{rest}'):09.6f}"


def _decimal_comma(number: str) -> str:
    return number.replace(".", ",")


def _scaled(number: float, rng: random.Random) -> str:
    return repr(number * rng.choice((1e3, 1e-3, 1e2, 57.29577951308232, 0.017453292519943295)))


def _quaternion(
    text: str, rng: random.Random, change: Callable[[list[str]], list[str]]
) -> str | None:
    """Change four numbers that are a unit quaternion, in a row or by the names w, x, y and z."""
    rows = []
    for k in (found.start() for found in FLOAT.finditer(text)):
        found = _FOUR_FLOATS.match(text, k)
        if found is not None:
            rows.append([found.span(group) for group in (1, 3, 5, 7)])
    keyed = [found.span(4) for found in _KEYED_QUATERNION.finditer(text)]
    rows += [keyed[k : k + 4] for k in range(len(keyed) - 3)]
    units = [
        spans for spans in rows if abs(sum(float(text[a:b]) ** 2 for a, b in spans) - 1.0) < 1e-6
    ]
    if not units:
        return None
    spans = rng.choice(units)
    words = change([text[a:b] for a, b in spans])
    for (a, b), word in sorted(zip(spans, words, strict=True), reverse=True):
        text = text[:a] + word + text[b:]
    return text


def _permuted(text: str, rng: random.Random) -> str | None:
    return _quaternion(text, rng, lambda words: [*words[1:], words[0]])


def _not_normalised(text: str, rng: random.Random) -> str | None:
    factor = rng.choice((0.0, 1e-9, 0.5, 1.001, 2.0, 1e6))
    return _quaternion(text, rng, lambda words: [repr(factor * float(word)) for word in words])


NUMBERS: dict[str, Mutation] = {
    "full-width digits": _other_digits("\uff10"),
    "Arabic digits": _other_digits("\u0660"),
    "mathematical digits": _other_digits("\U0001d7ce"),
    "Unicode minus": respelled(lambda n: n.replace("-", "\u2212") if "-" in n else None),
    "no-break blank in a number": respelled(_grouped("\u00a0")),
    "blank in a number": respelled(_grouped(" ")),
    "underscore in a number": respelled(_grouped("_")),
    "apostrophe in a number": respelled(_grouped("'")),
    "decimal comma": respelled(_decimal_comma),
    "all decimal commas": of_text(
        lambda text, rng: FLOAT.sub(lambda found: _decimal_comma(found[0]), text), True
    ),
    "hexadecimal": respelled(lambda number: float(number).hex()),
    "leading zeros": respelled(lambda n: n.replace("-", "-00") if "-" in n else f"00{n}"),
    "sexagesimal": respelled(_sexagesimal),
    "Fortran exponent": respelled(lambda number: f"{float(number) / 10.0!r}d1"),
    "exponent": respelled(lambda number: f"{float(number):.17e}"),
    "plus sign": respelled(lambda n: f"+{n}" if "-" not in n else None),
    "no digit before the point": respelled(lambda n: n[1:] if n.startswith("0.") else None),
    "unit at a number": respelled(lambda number: f"{number} m"),
    "quotes around a number": respelled(lambda number: f'"{number}"'),
    "brackets around a number": respelled(lambda number: f"({number})"),
    "octal": renumbered(lambda number, rng: rng.choice(("0o17", "017", "0b11", "0x1F"))),
    "1e400": renumbered(lambda number, rng: rng.choice(("1e400", "-1e400", "1e999999999"))),
    "denormal": renumbered(lambda number, rng: rng.choice(("5e-324", "-1e-310", "2.5e-308"))),
    "zero": renumbered(lambda number, rng: rng.choice(("0.0", "-0.0"))),
    "not a number": renumbered(
        lambda number, rng: rng.choice(
            ("nan", ".nan", "NaN", "-nan", "nan(0x1)", "1.#QNAN", "#N/A")
        )
    ),
    "infinite": renumbered(
        lambda number, rng: rng.choice(("inf", "-.inf", ".inf", "Infinity", "1.#INF"))
    ),
    "huge whole number": renumbered(
        lambda number, rng: rng.choice((str(2**70), "9" * MANY_DIGITS))
    ),
    "another number": renumbered(lambda number, rng: repr(rng.choice((1e6, -1e12, 1e-300, 1e300)))),
    "scaled number": renumbered(_scaled),
    "sign changed": renumbered(lambda number, rng: repr(-number)),
    "quaternion permuted": of_text(_permuted),
    "quaternion not normalised": of_text(_not_normalised),
}
"""Mistakes in numbers."""
