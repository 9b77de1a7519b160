"""Texts that a person wrote with a mistake in them, and texts that the command printed."""


def edit(path, old, new):
    """Replace the first occurrence of a text, which must be there."""
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))


def unwrapped(text):
    """What was printed, without the breaks of its lines."""
    return " ".join(text.split())
