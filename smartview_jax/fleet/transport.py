"""Send objects to other processes as bytes.

Equinox registers each module that `pickle` creates as one that is being initialised, and never
removes it: every data set and every fit that a process receives would stay in its memory for ever
(Equinox 0.13). Here modules are created as Equinox's own unflattening does (`module_of`).
"""

import io
import pickle
from typing import Any

import equinox as eqx

from ..runtime.modules import module_of


def to_bytes(value: Any) -> bytes:
    """Return an object as bytes for `from_bytes`; errors of `pickle` are of several types."""
    stream = io.BytesIO()
    _Pickler(stream, pickle.HIGHEST_PROTOCOL).dump(value)
    return stream.getvalue()


def from_bytes(data: bytes) -> Any:
    """Return the object of `to_bytes`."""
    return pickle.loads(data)


class _Pickler(pickle.Pickler):
    """A pickler that writes modules in a way that leaves nothing behind where they are read."""

    def reducer_override(self, value: Any) -> Any:
        """Return how to create a module again; leave other objects to `pickle`."""
        if isinstance(value, eqx.Module):
            return module_of, (type(value), dict(vars(value)))
        return NotImplemented
