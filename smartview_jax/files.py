"""Read and write text files safely and atomically, with errors that name the file."""

import json
import math
import os
import re
import shutil
import signal
import tempfile
import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import yaml
from yaml.composer import Composer

MAX_NESTING_DEPTH = 40
"""Largest number of nested levels in a YAML file; the package's own files have six."""

MAX_NODES = 1_000_000
"""Largest number of entries in a YAML file, counted with all aliases expanded."""

_MAX_MESSAGE_LENGTH = 300
"""Largest number of characters of the YAML parser's message within an error message."""

_write_lock = threading.RLock()
"""Lock that is held while a file, or a set of files, is moved to its final name."""

_temporary_folders: set[Path] = set()
"""Temporary folders with the results of unfinished runs."""


def write_atomically(path: str | os.PathLike[str], content: str | bytes) -> Path:
    """Write a complete file or nothing, by writing a temporary file and renaming it.

    Missing folders are created. An interrupted run leaves an existing file unchanged.
    """
    path = Path(path)
    data = content.encode("utf-8") if isinstance(content, str) else content
    with _write_lock:
        path.parent.mkdir(parents=True, exist_ok=True)
        # The temporary file is in the same folder, because a rename is atomic only within one file
        # system.
        descriptor, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        try:
            with os.fdopen(descriptor, "wb") as file:
                file.write(data)
            # `mkstemp` makes a file that only its owner can read.
            os.chmod(name, 0o644)
            os.replace(name, path)
        except BaseException as error:
            os.unlink(name)
            # A full disk is reported without the file.
            if isinstance(error, OSError) and error.filename is None:
                raise OSError(error.errno, error.strerror, str(path)) from error
            raise
    return path


def refuse_unwritable(folder: str | os.PathLike[str], option: str) -> None:
    """Raise a ValueError if no file can be written to a folder; the folder itself may be missing.

    Args:
        folder: folder for results.
        option: command-line option that named the folder, for the error message.
    """
    folder = Path(folder)
    existing_parent = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    if not existing_parent.is_dir():
        raise ValueError(f"{option}: {existing_parent} is a file; expected a folder to write to")
    # A file is written as a test, because permission bits do not show read-only file systems.
    try:
        with tempfile.TemporaryFile(dir=existing_parent):
            pass
    except OSError as error:
        raise ValueError(
            f"{option}: {existing_parent} cannot be written to: {error.strerror}"
        ) from error


@contextmanager
def file_transaction(
    folder: str | os.PathLike[str], names: Sequence[str] | None = None
) -> Iterator[Path]:
    """Provide a temporary folder for a run's files, and move them to their folder together.

    A run that fails or is interrupted leaves the results of the previous run unchanged. Its
    ValueError names the final folder.

    Args:
        folder: final folder of the results; created if it is missing.
        names: names of all files that such runs may write. A file that this run does not write is
            removed, so that results of different runs are never mixed. By default nothing is
            removed, and all files are moved in the order in which they were written.

    Raises:
        FileExistsError: a file has the folder's name.
    """
    folder = Path(folder)
    refuse_existing(folder)
    existing_parent = next(path for path in (folder, *folder.absolute().parents) if path.is_dir())
    with _temporary_folder(existing_parent, folder.name) as temporary_folder:
        try:
            yield temporary_folder
        except ValueError as error:
            raise ValueError(str(error).replace(str(temporary_folder), str(folder))) from error
        except OSError as error:
            if not str(error.filename or "").startswith(str(temporary_folder)):
                raise
            name = str(error.filename).replace(str(temporary_folder), str(folder))
            raise OSError(error.errno, error.strerror, name) from error
        with _deferred_interrupt():
            folder.mkdir(parents=True, exist_ok=True)
            for name in _written_files(temporary_folder) if names is None else names:
                if (temporary_folder / name).is_file():
                    (folder / name).parent.mkdir(parents=True, exist_ok=True)
                    os.replace(temporary_folder / name, folder / name)
                else:
                    (folder / name).unlink(missing_ok=True)


def _written_files(folder: Path) -> list[str]:
    """Return the paths of the files in a folder, relative to it, the first written first."""
    files = [path for path in folder.rglob("*") if path.is_file()]
    files.sort(key=lambda path: path.stat().st_mtime_ns)
    return [str(path.relative_to(folder)) for path in files]


@contextmanager
def folder_transaction(folder: str | os.PathLike[str]) -> Iterator[Path]:
    """Provide a temporary folder, and give it its final name when everything in it is written.

    A run that fails or is interrupted leaves nothing.

    Args:
        folder: final folder, which must not exist yet or be empty.

    Raises:
        FileExistsError: it has files already; nothing is overwritten.
    """
    folder = Path(folder).absolute()
    if folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
        raise FileExistsError(f"{folder}: exists already; nothing is overwritten")
    folder.parent.mkdir(parents=True, exist_ok=True)
    with _temporary_folder(folder.parent, folder.name) as temporary_folder:
        yield temporary_folder
        # `mkdtemp` makes a folder that only its owner can open.
        os.chmod(temporary_folder, 0o755)
        with _write_lock:
            # An empty folder is replaced by this; one that was filled meanwhile is not.
            os.replace(temporary_folder, folder)


@contextmanager
def _temporary_folder(parent: Path, name: str) -> Iterator[Path]:
    """Provide a folder for unfinished results in the parent of the final ones.

    It is there because a rename is atomic only within one file system.
    """
    folder = Path(tempfile.mkdtemp(dir=parent, prefix=f".{name}."))
    _temporary_folders.add(folder)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)
        _temporary_folders.discard(folder)


@contextmanager
def _deferred_interrupt() -> Iterator[None]:
    """Postpone an interrupt until a set of files is moved completely."""
    pending_signals: list[int] = []
    with _write_lock, ExitStack() as cleanup:
        # Python runs signal handlers only in the main thread, and only there can they be set.
        if threading.current_thread() is threading.main_thread():
            previous_handler = signal.signal(
                signal.SIGINT, lambda number, _: pending_signals.append(number)
            )
            cleanup.callback(signal.signal, signal.SIGINT, previous_handler)
        yield
    if pending_signals:
        raise KeyboardInterrupt


def clean_up_before_exit(timeout: float) -> None:
    """Wait until no file is being moved, and remove the temporary folders of unfinished runs.

    Call this before ending the process from a thread other than the one that writes.

    Args:
        timeout: longest time to wait, s.
    """
    # Never released: the process ends next, and no other thread may start to write before that.
    _write_lock.acquire(timeout=timeout)
    for folder in list(_temporary_folders):
        shutil.rmtree(folder, ignore_errors=True)


def require_file(path: Path) -> None:
    """Raise a FileNotFoundError if there is no such file, or a folder in its place."""
    if path.is_dir():
        raise FileNotFoundError(f"{path}: is a folder, expected a file")
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")


def refuse_existing(folder: Path, names: Iterable[str] = ()) -> None:
    """Raise a FileExistsError where files cannot be written, or would be overwritten.

    Args:
        folder: the folder, which need not exist.
        names: of its files that must not exist yet.
    """
    if folder.is_file():
        raise FileExistsError(f"{folder}: is a file, expected a folder")
    for path in (folder / name for name in names):
        if path.exists():
            raise FileExistsError(f"{path}: exists already; nothing is overwritten")


def require_folder(path: Path, expected: str = "a folder") -> None:
    """Raise a FileNotFoundError if there is no such folder, or a file in its place.

    Args:
        path: of the folder.
        expected: what it should be, for the message.
    """
    if path.is_file():
        raise FileNotFoundError(f"{path}: is a file, expected {expected}")
    if not path.is_dir():
        raise FileNotFoundError(f"{path}: no such folder")


def read_text(path: str | os.PathLike[str]) -> str:
    """Return the text of a UTF-8 file, without the byte-order mark that some programs write.

    Raises:
        FileNotFoundError: the file is missing.
        ValueError: it is not UTF-8; the message has the position of the first wrong byte.
    """
    path = Path(path)
    require_file(path)
    try:
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: not readable as UTF-8 text: {error}") from error


def read_yaml(path: str | os.PathLike[str]) -> dict[Any, Any]:
    """Read the mapping in a YAML (or JSON) file; its keys may also be numbers.

    Raises:
        FileNotFoundError: the file is missing.
        ValueError: it is not YAML, has a key twice, has more than `MAX_NESTING_DEPTH` levels or
            `MAX_NODES` entries, or is not a mapping at the top level.
    """
    content = parse_yaml(read_text(path), path)
    if content is None:
        raise ValueError(f"{path}: the file is empty")
    if not isinstance(content, dict):
        raise ValueError(f"{path}: expected a mapping, found {type(content).__name__}")
    return content


def parse_json(text: str, path: str | os.PathLike[str]) -> Any:
    """Parse strict JSON: unique keys, finite numbers; errors name the file and the line.

    Raises:
        ValueError: the text is not strict JSON.
    """

    def refuse(name: str) -> float:
        raise ValueError(f"{name} is not a number in JSON")

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        # Python's parser would silently keep the last of two equal keys.
        content = dict(pairs)
        if len(content) < len(pairs):
            keys = [key for key, _ in pairs]
            twice = next(key for key in keys if keys.count(key) > 1)
            raise ValueError(f"key {twice!r} comes twice in one mapping")
        return content

    try:
        return json.loads(text, parse_constant=refuse, object_pairs_hook=unique)
    except json.JSONDecodeError as error:
        raise ValueError(
            f"{path}: not readable as JSON: line {error.lineno}, column {error.colno}: {error.msg}"
        ) from None
    except RecursionError:
        raise ValueError(f"{path}: not readable as JSON: nested too deeply") from None
    except ValueError as error:
        raise ValueError(f"{path}: not readable as JSON: {error}") from None


def parse_yaml(
    text: str, path: str | os.PathLike[str], loader: "type[StrictYamlLoader] | None" = None
) -> Any:
    """Parse a YAML text; errors name the file.

    Args:
        text: one YAML document.
        path: path of the file with the text, for error messages.
        loader: a loader with further tags; by default `StrictYamlLoader`.

    Raises:
        ValueError: the loader does not accept the text.
    """
    try:
        return yaml.load(text, Loader=loader or StrictYamlLoader)
    # A scalar that does not fit its tag, such as `!!bool x`, may raise any exception.
    except Exception as error:
        message = " ".join(str(error).split())[:_MAX_MESSAGE_LENGTH]
        if "\\t" in str(error) or re.search(r"^\t", text, re.MULTILINE):
            message += ": a line begins with a tab; YAML wants spaces"
        raise ValueError(f"{path}: not readable as YAML: {message}") from error


if yaml.__with_libyaml__:

    class _SafeLoader(Composer, yaml.CSafeLoader):
        """Read text by libyaml, and compose the nodes in Python, where limits are checked."""

        def __init__(self, stream: str):
            yaml.CSafeLoader.__init__(self, stream)
            Composer.__init__(self)

else:
    _SafeLoader = yaml.SafeLoader  # pyright: ignore[reportAssignmentType]


class StrictYamlLoader(_SafeLoader):
    """A stricter safe YAML loader: unique keys, numbers as in YAML 1.2, bounded nesting.

    YAML 1.1, which PyYAML follows, reads 1e-3 as text, 010 as eight and 1:30 as ninety. The result
    has only mappings, lists, text, numbers, true, false and null; no other object is ever created.
    """

    def __init__(self, stream: str):
        super().__init__(stream)
        self._depth = 0
        self._node_sizes: dict[int, int] = {}

    def compose_node(self, parent: yaml.Node | None, index: Any) -> yaml.Node | None:
        """Compose a node; raise an error where nesting or expanded aliases exceed the limits."""
        if self._depth > MAX_NESTING_DEPTH:
            raise yaml.YAMLError(f"nested deeper than {MAX_NESTING_DEPTH} levels")
        is_alias = self.check_event(yaml.AliasEvent)
        self._depth += 1
        node = super().compose_node(parent, index)
        self._depth -= 1
        # A node gets its size when it is complete, so an alias to a node without one is a cycle.
        if is_alias and id(node) not in self._node_sizes:
            raise yaml.YAMLError("an alias to a node that contains it")
        # size(node) = 1 + sum of the sizes of its parts, with an alias as large as its anchor. This
        # finds a file whose nested aliases would expand to billions of entries, without expanding.
        if node is not None and not is_alias:
            size = 1 + sum(
                self._node_sizes[id(part)] for pair in _child_nodes(node) for part in pair
            )
            if size > MAX_NODES:
                raise yaml.YAMLError(f"more than {MAX_NODES} entries, aliases written out")
            self._node_sizes[id(node)] = size
        return node

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        """Construct a mapping; raise an error where a key occurs twice."""
        seen: set[Any] = set()
        for key, value in node.value:
            # A merge key (`<<`) is no entry itself, and the keys that it adds may be overridden.
            if key.tag == "tag:yaml.org,2002:merge":
                continue
            name = self.construct_object(key, deep=True)
            # `{x: 0,5}` is x: 0 and an entry 5 without a value, which is ignored in some files.
            if node.flow_style and isinstance(name, int | float) and _is_absent(value):
                raise yaml.YAMLError(
                    f"number {name!r} without a name {key.start_mark}: a decimal comma?"
                )
            if isinstance(name, str | int | float) and name in seen:
                raise yaml.YAMLError(f"key {name!r} comes twice, again {key.start_mark}")
            if isinstance(name, str | int | float):
                seen.add(name)
        return super().construct_mapping(node, deep)


def _child_nodes(node: yaml.Node) -> list[tuple[yaml.Node, ...]]:
    """Return the nodes directly inside a node: pairs of key and value, or single elements."""
    if isinstance(node, yaml.MappingNode):
        return node.value
    return [(part,) for part in node.value] if isinstance(node, yaml.SequenceNode) else []


def _is_absent(node: yaml.Node) -> bool:
    """Return whether nothing is written where a value is expected."""
    # The style of an unquoted scalar is "" for libyaml, None for Python's scanner.
    return isinstance(node, yaml.ScalarNode) and node.value == "" and not node.style


def _construct_int(loader: StrictYamlLoader, node: yaml.ScalarNode) -> int:
    return int(loader.construct_scalar(node))


def _construct_float(loader: StrictYamlLoader, node: yaml.ScalarNode) -> float:
    text = loader.construct_scalar(node).lower()
    return float(text.replace(".inf", "inf").replace(".nan", "nan"))


def _install_yaml_1_2_resolvers() -> None:
    """Make the loader read numbers as in YAML 1.2, and dates as text."""
    tags = {name: f"tag:yaml.org,2002:{name}" for name in ("int", "float", "timestamp")}
    StrictYamlLoader.yaml_implicit_resolvers = {
        first: [pair for pair in pairs if pair[0] not in tags.values()]
        for first, pairs in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }
    # The patterns of YAML 1.2's core schema, without its octal and hexadecimal integers.
    int_pattern = re.compile(r"[-+]?[0-9]+\Z")
    float_pattern = re.compile(
        r"(?:[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?"
        r"|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))\Z"
    )
    StrictYamlLoader.add_implicit_resolver(tags["int"], int_pattern, list("-+0123456789"))
    StrictYamlLoader.add_implicit_resolver(tags["float"], float_pattern, list("-+0123456789."))
    StrictYamlLoader.add_constructor(tags["int"], _construct_int)
    StrictYamlLoader.add_constructor(tags["float"], _construct_float)


_install_yaml_1_2_resolvers()


class _YamlDumper(yaml.Dumper):
    """A dumper that quotes every text that YAML 1.1 or 1.2 would read as something else.

    PyYAML's own dumper leaves 1e3 unquoted, which is text in YAML 1.1 and a thousand in YAML 1.2.
    """

    def analyze_scalar(self, scalar: str) -> Any:
        """Return how a text may be written: with U+0085, which PyYAML loses, only escaped."""
        analysis = super().analyze_scalar(scalar)
        if "\x85" in scalar:
            analysis.allow_flow_plain = analysis.allow_block_plain = False
            analysis.allow_single_quoted = analysis.allow_block = False
        return analysis


# A copy, so that other users of PyYAML keep their rules. Numbers are written by the rules of YAML
# 1.1, which therefore come first.
_YamlDumper.yaml_implicit_resolvers = {
    first: yaml.Dumper.yaml_implicit_resolvers.get(first, [])
    + StrictYamlLoader.yaml_implicit_resolvers.get(first, [])
    for first in {**yaml.Dumper.yaml_implicit_resolvers, **StrictYamlLoader.yaml_implicit_resolvers}
}


def dump_yaml(content: Mapping[str, Any]) -> str:
    """Return readable YAML text: keys in the given order, short lists on one line."""
    return yaml.dump(
        content,
        Dumper=_YamlDumper,
        sort_keys=False,
        default_flow_style=None,
        width=100,
        allow_unicode=True,
    )


_NO_YAML_CHARACTERS = re.compile("[\x7f-\x9f\u2028\u2029\ud800-\udfff\ufeff\ufffe\uffff]")
"""Characters that JSON allows in a text but YAML refuses or takes as the end of a line."""


def finite_or_null(number: float) -> float | None:
    """Return a number as files have it: None for infinity and NaN, which JSON does not know."""
    return float(number) if math.isfinite(number) else None


def dump_json(content: Mapping[str, Any]) -> str:
    """Return readable JSON text, keys in the given order, that a YAML reader reads equally."""
    # Not `ensure_ascii`: YAML would read the two escapes of one emoji as two characters.
    text = json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False)
    return _NO_YAML_CHARACTERS.sub(lambda match: f"\\u{ord(match[0]):04x}", text) + "\n"
