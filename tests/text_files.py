"""Files that a person wrote with a mistake in them."""


def edit(path, old, new):
    """Replace the first occurrence of a text, which must be there."""
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
