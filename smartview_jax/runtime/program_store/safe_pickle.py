"""Write and read traces and programs by pickle, restricted to the classes that may be in them.

Reading a pickle imports and calls whatever it names. Here a name that is not on a list is refused
before anything is imported.
"""

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
"""Module and name of each class of a library that the result of a program may hold."""

_PROGRAM_CLASSES = {
    ("jax", "P"),
    ("jax._src.core", "ManualAxisType"),
    ("jax._src.core", "MemorySpace"),
    ("jax._src.core", "ShapedArray"),
    ("jax._src.interpreters.pxla", "AllArgsInfo"),
    ("jax._src.interpreters.pxla", "UnloadedMeshExecutable"),
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

Another version of JAX may write other names: its programs are then compiled by every process, and
a test says so.
"""


def pickled_trace(tree: Any) -> bytes | None:
    """Return a tree as bytes; None where it holds what `unpickled_trace` would refuse."""
    try:
        content = pickle.dumps(tree, protocol=5)
        unpickled_trace(content)
    # Which exception a class raises that cannot be pickled, such as a local one, is up to it.
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
        content: what was written.
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
    """Reads data classes of this package, and listed ones of libraries."""

    def find_class(self, module_name: str, global_name: str) -> Any:
        """Return a class that may be in a trace."""
        if (module_name, global_name) in _LIBRARY_CLASSES:
            return super().find_class(module_name, global_name)
        # A name with a dot would reach what the module imported.
        if module_name.partition(".")[0] == _PACKAGE and "." not in global_name:
            found = super().find_class(module_name, global_name)
            if _is_data_class(found) and found.__module__ == module_name:
                return found
        raise pickle.UnpicklingError(f"{module_name}.{global_name} may not be in a trace")


class _ProgramReader(_JaxPjrtUnpickler):
    """Reads the parts of an executable."""

    def find_class(self, module_name: str, global_name: str) -> Any:
        """Return a class or function that may be in a program."""
        if (module_name, global_name) in _PROGRAM_CLASSES:
            return super().find_class(module_name, global_name)
        raise pickle.UnpicklingError(f"{module_name}.{global_name} may not be in a program")


def _is_data_class(found: Any) -> bool:
    """Return whether something is a class that holds data and does nothing when it is made."""
    if not isinstance(found, type):
        return False
    return issubclass(found, eqx.Module) or (issubclass(found, tuple) and hasattr(found, "_fields"))
