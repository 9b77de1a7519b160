"""Write and read traces and programs by pickle, restricted to listed classes.

Unpickling imports and calls whatever the file names. Here a name that is not listed is refused
before anything is imported.
"""

import enum
import io
import pickle
from typing import Any

import equinox as eqx
import jax
from jax.experimental.serialize_executable import _JaxPjrtUnpickler

_PACKAGE = __name__.partition(".")[0]

_LIBRARY_CLASSES = {
    ("equinox._enum", "EnumerationItem"),
    ("jaxlie._se2", "SE2"),
    ("jaxlie._se3", "SE3"),
    ("jaxlie._so2", "SO2"),
    ("jaxlie._so3", "SO3"),
    ("optimistix._solution", "RESULTS"),
}
"""Module and name of each library class that the result of a program may contain."""

_PROGRAM_CLASSES = {
    ("jax", "P"),
    ("jax._src.core", "ManualAxisType"),
    ("jax._src.core", "MemorySpace"),
    ("jax._src.core", "ShapedArray"),
    ("jax._src.interpreters.pxla", "AllArgsInfo"),
    ("jax._src.interpreters.pxla", "UnloadedMeshExecutable"),
    ("jax._src.layout", "AutoLayoutSingleton"),
    ("jax._src.layout", "Layout"),
    ("jax._src.linear_util", "DebugInfo"),
    ("jax._src.mesh", "AbstractMesh"),
    ("jax._src.named_sharding", "_unpickle_named_sharding"),
    ("jax._src.sharding_impls", "_unpickle_single_device_sharding"),
    ("jax._src.stages", "ArgInfo"),
    ("jaxlib._jax", "DeviceList"),
    ("numpy", "dtype"),
}
"""Module and name of everything that JAX writes into an executable on one CPU.

Another version of JAX may write other names: every process then compiles its programs again, and a
test fails.
"""


def pickled_trace(tree: Any) -> bytes | None:
    """Return a tree as bytes; None if `unpickled_trace` would refuse it."""
    try:
        content = pickle.dumps(tree, protocol=5)
        unpickled_trace(content)
    # A class that cannot be pickled, such as a local one, may raise any exception.
    except Exception:
        return None
    return content


def unpickled_trace(content: bytes) -> Any:
    """Return the tree that `pickled_trace` wrote.

    Raises:
        pickle.UnpicklingError: the content names something other than a data class of this package
            or a listed class of a library.
    """
    return _TraceReader(io.BytesIO(content)).load()


def unpickled_program(content: bytes, array_count: int, output_count: int) -> jax.stages.Compiled:
    """Return the executable on the first CPU that JAX's `serialize` wrote.

    Args:
        content: the bytes that `serialize` wrote.
        array_count: number of arrays in the arguments.
        output_count: number of arrays in the result.

    Raises:
        pickle.UnpicklingError: the content names something other than the parts of an executable.
    """
    devices = jax.devices()[:1]
    reader = _ProgramReader(io.BytesIO(content), devices[0].client, devices)
    executable, argument_kinds, without_keywords = reader.load()
    arguments = jax.tree.structure((tuple(range(array_count)), {}))
    result = jax.tree.structure(list(range(output_count)))
    return jax.stages.Compiled(
        executable.load(),
        [],
        arguments.unflatten(argument_kinds),
        result,
        no_kwargs=without_keywords,
    )


class _TraceReader(pickle.Unpickler):
    """Reads data classes of this package, and listed classes of libraries."""

    def find_class(self, module_name: str, global_name: str) -> Any:
        """Return a class that may be in a trace."""
        if (module_name, global_name) in _LIBRARY_CLASSES:
            return super().find_class(module_name, global_name)
        # A name with a dot could refer to something that the module imported.
        if module_name.partition(".")[0] == _PACKAGE and "." not in global_name:
            cls = super().find_class(module_name, global_name)
            if _is_data_class(cls) and cls.__module__ == module_name:
                return cls
        raise pickle.UnpicklingError(f"{module_name}.{global_name} may not be in a trace")


class _ProgramReader(_JaxPjrtUnpickler):
    """Reads the parts of an executable."""

    def find_class(self, module_name: str, global_name: str) -> Any:
        """Return a class or function that may be in a program."""
        if (module_name, global_name) in _PROGRAM_CLASSES:
            return super().find_class(module_name, global_name)
        # Python before 3.11.4 pickles a member of an enumeration as an attribute of its class.
        if (module_name, global_name) == ("builtins", "getattr"):
            return _member
        raise pickle.UnpicklingError(f"{module_name}.{global_name} may not be in a program")


def _member(enumeration: Any, name: str) -> Any:
    """Return the member of an enumeration; nothing else has its attributes read."""
    if not isinstance(enumeration, enum.EnumMeta):
        raise pickle.UnpicklingError(f"{enumeration!r}: its attributes may not be in a program")
    return enumeration[name]


def _is_data_class(candidate: Any) -> bool:
    """Return whether an object is a class that only holds data; constructing it runs no code."""
    if not isinstance(candidate, type):
        return False
    return issubclass(candidate, eqx.Module) or (
        issubclass(candidate, tuple) and hasattr(candidate, "_fields")
    )
