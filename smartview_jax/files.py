"""Reading and writing text files: safely, atomically, with errors that name the file."""

import os
import re
import shutil
import signal
import tempfile
import threading
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import yaml

DEEPEST = 40
"""Levels of nesting that a YAML file may have; the library's own have six."""

MOST_NODES = 1_000_000
"""Entries that a YAML file may have when its aliases are written out."""

_LONGEST_MESSAGE = 300


_writing = threading.RLock()
"""Held while a file, or a set of files, is put into place."""

_unfinished: set[Path] = set()
"""Folders with the results of a run that is not yet done."""


def write_atomically(path: str | os.PathLike[str], content: str | bytes) -> Path:
    """Write a whole file or nothing: a temporary name beside it, then a rename.

    Folders that are missing are made. An interrupted run leaves the old file as it was.
    """
    path = Path(path)
    data = content.encode("utf-8") if isinstance(content, str) else content
    with _writing:
        path.parent.mkdir(parents=True, exist_ok=True)
        descriptor, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        try:
            with os.fdopen(descriptor, "wb") as file:
                file.write(data)
            os.chmod(name, 0o644)
            os.replace(name, path)
        except BaseException:
            os.unlink(name)
            raise
    return path


def refuse_unwritable(folder: str | os.PathLike[str], option: str) -> None:
    """Raise a ValueError if no file can be written to a folder; what is missing can be made.

    Args:
        folder: where results will go.
        option: that named it, for the message.
    """
    folder = Path(folder)
    above = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    if not above.is_dir():
        raise ValueError(f"{option}: {above} is a file; expected a folder to write to")
    try:
        with tempfile.TemporaryFile(dir=above):
            pass
    except OSError as error:
        raise ValueError(f"{option}: {above} cannot be written to: {error.strerror}") from error


@contextmanager
def written_together(folder: str | os.PathLike[str], names: Sequence[str]) -> Iterator[Path]:
    """Give a folder to write a run's results to; at the end all take their place at once.

    A run that fails or is interrupted leaves the results of the last one as they were.

    Args:
        folder: where the results go; made if it is missing.
        names: of every file that such runs write; one that this run does not is removed, so that
            results of different runs never stand side by side.
    """
    folder = Path(folder)
    near = next(path for path in (folder, *folder.absolute().parents) if path.is_dir())
    made = Path(tempfile.mkdtemp(dir=near, prefix=f".{folder.name}."))
    _unfinished.add(made)
    try:
        yield made
        with _undisturbed():
            folder.mkdir(parents=True, exist_ok=True)
            for name in names:
                if (made / name).is_file():
                    os.replace(made / name, folder / name)
                else:
                    (folder / name).unlink(missing_ok=True)
    finally:
        shutil.rmtree(made, ignore_errors=True)
        _unfinished.discard(made)


@contextmanager
def _undisturbed() -> Iterator[None]:
    """Put off an interrupt until a set of files is in its place."""
    asked: list[int] = []
    with _writing, ExitStack() as after:
        # Python hears signals in its main thread alone.
        if threading.current_thread() is threading.main_thread():
            before = signal.signal(signal.SIGINT, lambda number, _: asked.append(number))
            after.callback(signal.signal, signal.SIGINT, before)
        yield
    if asked:
        raise KeyboardInterrupt


def leave_nothing_half_written(patience: float) -> None:
    """Wait until no file is being put into place, and remove a run's unfinished results.

    For whoever ends the process without a word to the thread that writes.

    Args:
        patience: longest wait, s.
    """
    _writing.acquire(timeout=patience)
    for folder in list(_unfinished):
        shutil.rmtree(folder, ignore_errors=True)


def read_text(path: str | os.PathLike[str]) -> str:
    """Return the text of a UTF-8 file, without the byte-order mark that some programs begin with.

    Raises:
        FileNotFoundError: the file is missing.
        ValueError: it is not UTF-8; the message has the place of the first wrong byte.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    try:
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: not readable as UTF-8 text: {error}") from error


def read_yaml(path: str | os.PathLike[str]) -> dict[Any, Any]:
    """Read the mapping in a YAML (or JSON) file; its keys may be numbers, too.

    Raises:
        FileNotFoundError: the file is missing.
        ValueError: it is not YAML, has a key twice, is nested or repeated beyond all need, or is
            not a mapping at the top level.
    """
    content = parse_yaml(read_text(path), path)
    if not isinstance(content, dict):
        raise ValueError(f"{path}: expected a mapping, found {type(content).__name__}")
    return content


def parse_yaml(
    text: str, path: str | os.PathLike[str], loader: "type[PlainLoader] | None" = None
) -> Any:
    """Return what a YAML text holds; errors name the file it is from.

    Args:
        text: of one document.
        path: where the text is from, for messages.
        loader: knows tags besides the plain ones.

    Raises:
        ValueError: it is not YAML that the loader takes.
    """
    try:
        return yaml.load(text, Loader=loader or PlainLoader)
    # A scalar that does not fit its tag (`!!bool x`) ends in whatever its constructor runs into.
    except Exception as error:
        words = " ".join(str(error).split())[:_LONGEST_MESSAGE]
        raise ValueError(f"{path}: not readable as YAML: {words}") from error


class PlainLoader(yaml.SafeLoader):
    """The safe loader, stricter: each key once, numbers as YAML 1.2 has them, bounded nesting.

    YAML 1.1, which PyYAML follows, reads 1e-3 as text, 010 as eight and 1:30 as ninety. Nothing
    here makes objects: mappings, lists, text, numbers, true and false, and null.
    """

    def __init__(self, stream: str):
        super().__init__(stream)
        self._depth = 0
        self._sizes: dict[int, int] = {}

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """Refuse what is nested deeper, or by aliases grows larger, than any file of use."""
        if self._depth > DEEPEST:
            raise yaml.YAMLError(f"nested deeper than {DEEPEST} levels")
        is_alias = self.check_event(yaml.AliasEvent)
        self._depth += 1
        node = super().compose_node(parent, index)
        self._depth -= 1
        if is_alias and id(node) not in self._sizes:
            raise yaml.YAMLError("an alias to what it stands in")
        if node is not None and not is_alias:
            size = 1 + sum(self._sizes[id(part)] for pair in _parts(node) for part in pair)
            if size > MOST_NODES:
                raise yaml.YAMLError(f"more than {MOST_NODES} entries, aliases written out")
            self._sizes[id(node)] = size
        return node

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Build a mapping in which no key comes twice."""
        seen: set[Any] = set()
        for key, _ in node.value:
            if key.tag == "tag:yaml.org,2002:merge":
                continue
            name = self.construct_object(key, deep=True)
            if isinstance(name, str | int | float) and name in seen:
                raise yaml.YAMLError(f"key {name!r} comes twice, again {key.start_mark}")
            if isinstance(name, str | int | float):
                seen.add(name)
        return super().construct_mapping(node, deep)


def _parts(node: yaml.Node) -> list[tuple[yaml.Node, ...]]:
    if isinstance(node, yaml.MappingNode):
        return node.value
    return [(part,) for part in node.value] if isinstance(node, yaml.SequenceNode) else []


def _whole_number(loader: PlainLoader, node: yaml.ScalarNode) -> int:
    return int(loader.construct_scalar(node))


def _number(loader: PlainLoader, node: yaml.ScalarNode) -> float:
    text = loader.construct_scalar(node).lower()
    return float(text.replace(".inf", "inf").replace(".nan", "nan"))


def _numbers_of_yaml_1_2() -> None:
    """Give the loader the core schema's numbers in place of YAML 1.1's, and no dates."""
    tags = {name: f"tag:yaml.org,2002:{name}" for name in ("int", "float", "timestamp")}
    PlainLoader.yaml_implicit_resolvers = {
        first: [pair for pair in pairs if pair[0] not in tags.values()]
        for first, pairs in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }
    whole = re.compile(r"[-+]?[0-9]+\Z")
    number = re.compile(
        r"(?:[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?"
        r"|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))\Z"
    )
    PlainLoader.add_implicit_resolver(tags["int"], whole, list("-+0123456789"))
    PlainLoader.add_implicit_resolver(tags["float"], number, list("-+0123456789."))
    PlainLoader.add_constructor(tags["int"], _whole_number)
    PlainLoader.add_constructor(tags["float"], _number)


_numbers_of_yaml_1_2()


def dump_yaml(content: dict[str, Any]) -> str:
    """YAML text that a person can read: keys in the given order, short lists on one line."""
    return yaml.dump(
        content, sort_keys=False, default_flow_style=None, width=100, allow_unicode=True
    )
