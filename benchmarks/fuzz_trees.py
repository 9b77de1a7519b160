"""Mistakes in YAML and JSON: entries, values, and what the languages offer beyond them."""

import copy
import json
import random
from collections.abc import Callable
from typing import Any

import yaml

from .fuzz_numbers import MANY_DIGITS
from .fuzz_text import Mutation, of_text

MANY_LEVELS = 2000
"""Levels of a nesting that is far too deep."""

NASTY: tuple[Any, ...] = (
    *(None, True, False, 0, -1, 1, 0.5, -0.5, 7, 2**31, 2**63, 2**70, -(2**70), 10**30),
    *(1e-300, 5e-324, -0.0, 1e6, 1e300, -1e300, float("nan"), float("inf"), -float("inf")),
    *("", " ", "a", "1", "0x10", "1e999", "nan", "true", "null", "~", "\u0660", "a\u0000b"),
    *("../..", "/etc/passwd", "C:\\x", "con", "a\nb", "<script>", "{", "{0}", "{view.__class__}"),
    *("*" * 300, "%s%n", "$(id)", "\u202e", "é" * 201, "__proto__", "=1+1"),
    *([], {}, [[]], [None], [1, 2], [float("nan")] * 3, {"a": 1}, {1: 2}, {"model": {}}),
    *(["a"] * 1000, [[1, 2], [3]], [0.0, 0.0, 0.0, 0.0], [1e200] * 3, [True, False, True]),
)
"""Values that stand where they should not."""

TOKENS = (
    *"nan -inf 1e999 -1 0 1_0 \u0661 0x1f 1e-3 010 1:30 true null ~ '' \"\" * &a *a !!int".split(),
    *(
        "yes",
        "off",
        "? [1]",
        "- ",
        "&a [*a]",
        "2024-13-45",
        "=",
        "|",
        ">-",
        "!",
        "@",
        "`",
        "%",
        "#",
    ),
    *("[" * 300, "{" * 300, "9" * MANY_DIGITS, "1" * 400, "," * 50, '"', "---", "...", "\t"),
    *("1" * 30 + ":30.5", "\ud7ff", "*/", "]]>", "&lt;", "&#0;", "\\u0000", "\\ud800", "\\x"),
)
"""Text that stands where it should not."""

TAGS = (
    *("!!bool x", "!!timestamp x", "!!python/none", "!!binary x", "!!set x", "!!omap [a]"),
    *("!!float x", "!!int 1.5", "!!str 1", "!!null 1", "!!map [1]", "!!seq {a: 1}", "!local x"),
    *("!!python/object/apply:os.getcwd []", "!!python/name:os.system ''", "!!float 0x1p3"),
)
"""YAML's tags, with values that do not fit them."""


def other_words(text: str, rng: random.Random) -> str | None:
    """Put something else in the place of a number or a word."""
    return _in_place(text, rng.choice(TOKENS), rng)


def _in_place(text: str, word: str, rng: random.Random) -> str | None:
    ends = [k for k, letter in enumerate(text) if letter in " ,:[]{}\n<>=\"'"]
    if len(ends) < 2:
        return None
    k = rng.randrange(len(ends) - 1)
    return text[: ends[k] + 1] + word + text[ends[k + 1] :]


def of_tree(change: Callable[[Any, Any, random.Random], None]) -> Mutation:
    """Return the mutation of a YAML or JSON file that changes an entry of a mapping or a list."""

    def changed(text: str, rng: random.Random) -> str | None:
        is_json = text.lstrip().startswith("{")
        try:
            tree = json.loads(text) if is_json else yaml.load(text, Loader=yaml.SafeLoader)
        except Exception:
            tree = None
        if not isinstance(tree, dict | list) or not tree:
            return None
        tree = copy.deepcopy(tree)
        node: Any = tree
        while True:
            key = rng.choice(list(node) if isinstance(node, dict) else list(range(len(node))))
            inner = node[key]
            if not isinstance(inner, dict | list) or not inner or rng.random() < 0.15:
                break
            node = inner
        change(node, key, rng)
        if is_json:
            return json.dumps(tree, indent=1)
        return yaml.dump(tree, Dumper=yaml.CSafeDumper, sort_keys=False, allow_unicode=True)

    return of_text(changed)


def _lose(node: Any, key: Any, rng: random.Random) -> None:
    del node[key]


def _misspell(node: Any, key: Any, rng: random.Random) -> None:
    if isinstance(node, dict):
        value = node.pop(key)
        names = (f"{key}x", str(key)[:-1], str(key).upper(), 7, "end", "model", "", "__proto__")
        node[rng.choice(names)] = value
    else:
        node.insert(key, node[key])


def _repeat(node: Any, key: Any, rng: random.Random) -> None:
    if isinstance(node, list):
        node.append(rng.choice((node[key], rng.choice(NASTY))))
    else:
        node[f"{key}_2"] = node[key]


def _shuffle(node: Any, key: Any, rng: random.Random) -> None:
    values = list(node.values()) if isinstance(node, dict) else list(node)
    rng.shuffle(values)
    for k, value in zip(
        list(node) if isinstance(node, dict) else range(len(node)), values, strict=True
    ):
        node[k] = value


def _replace(node: Any, key: Any, rng: random.Random) -> None:
    node[key] = rng.choice(NASTY)


def _wrap(node: Any, key: Any, rng: random.Random) -> None:
    value = node[key]
    node[key] = rng.choice(([value], {"a": value}, str(value), [value] * 3))


def _unwrap(node: Any, key: Any, rng: random.Random) -> None:
    value = node[key]
    if isinstance(value, dict | list) and value:
        node[key] = next(iter(value.values())) if isinstance(value, dict) else value[0]
    else:
        node[key] = None


def _round(node: Any, key: Any, rng: random.Random) -> None:
    value = node[key]
    if isinstance(value, bool) or not isinstance(value, int | float):
        node[key] = rng.choice(NASTY)
    else:
        node[key] = (
            int(value) if isinstance(value, float) else rng.choice((float(value), value + 1))
        )


def _nested(text: str, rng: random.Random) -> str | None:
    opening = rng.choice("[{")
    closing = "]" if opening == "[" else "}"
    depth = rng.choice((50, MANY_LEVELS, 50 * MANY_LEVELS))
    return _in_place(text, opening * depth + closing * rng.choice((0, depth)), rng)


def _aliases(text: str, rng: random.Random) -> str:
    levels = "".join(f"b{k}: &b{k} [{', '.join([f'*b{k - 1}'] * 9)}]\n" for k in range(1, 10))
    bomb = f"b0: &b0 [{', '.join('x' * 9)}]\n{levels}"
    return bomb + text if rng.random() < 0.5 else text + bomb


def _merged(text: str, rng: random.Random) -> str:
    lines = text.split("\n")
    k = rng.randrange(len(lines))
    merge = rng.choice(("<<: {a: 1}", "<<: [1]", "<<: 1", "<<: {end: 1}", "<<: &m {<<: *m}"))
    indent = " " * (len(lines[k]) - len(lines[k].lstrip()))
    return "\n".join([*lines[:k], indent + merge, *lines[k:]])


def _repeated_key(text: str, rng: random.Random) -> str | None:
    lines = text.split("\n")
    keyed = [k for k, line in enumerate(lines) if ":" in line]
    if not keyed:
        return None
    k = rng.choice(keyed)
    line = lines[k] if not lines[k].rstrip().endswith(":") else lines[k] + " 1"
    comma = "," if line.lstrip().startswith('"') and not line.rstrip().endswith(",") else ""
    return "\n".join([*lines[:k], line + comma, *lines[k:]])


TREES: dict[str, Mutation] = {
    "another word": of_text(other_words),
    "tag": of_text(lambda text, rng: _in_place(text, " " + rng.choice(TAGS), rng)),
    "very deep nesting": of_text(_nested),
    "alias bomb": of_text(_aliases),
    "merge key": of_text(_merged),
    "key twice": of_text(_repeated_key),
    "two documents": of_text(lambda text, rng: f"{text}\n---\n{rng.choice((text, 'a: 1'))}"),
    "entry lost": of_tree(_lose),
    "key misspelt": of_tree(_misspell),
    "entry more": of_tree(_repeat),
    "values exchanged": of_tree(_shuffle),
    "another value": of_tree(_replace),
    "value in a list": of_tree(_wrap),
    "list as its first value": of_tree(_unwrap),
    "another type of number": of_tree(_round),
}
"""Mistakes in YAML and JSON; text files of other kinds have some of them, too."""
