"""Poses as rows of numbers, in the formats that robots and files use, by name.

A codec turns rows into transforms and back. Units are stated, never guessed: `length_unit` is m or
mm, `angle_unit` rad or deg. Vendors' own units are mm and degrees, except UR (m, rad).
"""

import dataclasses
from collections.abc import Callable, Sequence

import jax.numpy as jnp
import numpy as np
from jaxlie import SE3, SO3
from jaxtyping import Array, Float

from .euler import rotation_from_ypr, rotation_from_zyz, ypr_from_rotation, zyz_from_rotation
from .oat import oat_from_rotation, rotation_from_oat
from .rigid import check_rigid

LENGTH_UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
ANGLE_UNITS = {"rad": 1.0, "deg": float(np.pi / 180.0)}

_UNIT_TOLERANCE = 1e-3
"""How far a quaternion's length may be from 1: files have few digits."""


@dataclasses.dataclass(frozen=True)
class PoseCodec:
    """One way of writing a rigid transform as a row of numbers.

    Attributes:
        name: of the format.
        columns: what each number is.
        angles: which columns are angles, by index.
        lengths: which columns are lengths, by index.
        to_rotation: rotation from the columns after x, y, z.
        from_rotation: the inverse.
    """

    name: str
    columns: tuple[str, ...]
    angles: tuple[int, ...]
    lengths: tuple[int, ...]
    to_rotation: Callable[[Array], SO3]
    from_rotation: Callable[[SO3], Array]

    def decode(
        self,
        rows: np.ndarray,
        length_unit: str = "m",
        angle_unit: str = "rad",
        labels: Sequence[str] | None = None,
    ) -> SE3:
        """Transforms of rows `(n, columns)`.

        Raises:
            ValueError: an unknown unit, a wrong number of columns, or a row that is no rigid
                transform, named by its label (by default its number).
        """
        numbers = np.array(rows, dtype=float)
        if numbers.ndim != 2 or numbers.shape[1] != len(self.columns):
            raise ValueError(
                f"{self.name}: expected rows of {len(self.columns)} numbers "
                f"({', '.join(self.columns)}), found shape {numbers.shape}"
            )
        names = tuple(map(str, range(len(numbers)) if labels is None else labels))
        for name, row in zip(names, numbers, strict=True):
            if not np.isfinite(row).all():
                raise ValueError(f"{self.name}: row {name} contains NaN or infinity")
        numbers = numbers * self._units(length_unit, angle_unit)
        if self.name == "matrix":
            return _from_matrices(numbers, names)
        if self.name.startswith(("quaternion", "abb")):
            _check_quaternions(self.name, numbers[:, 3:], names)
        rotation = self.to_rotation(jnp.asarray(numbers[:, 3:]))
        return SE3.from_rotation_and_translation(rotation, jnp.asarray(numbers[:, :3]))

    def encode(
        self, poses: SE3, length_unit: str = "m", angle_unit: str = "rad"
    ) -> Float[np.ndarray, "rows columns"]:
        """Rows of transforms `(n)`."""
        if self.name == "matrix":
            numbers = np.asarray(poses.as_matrix()).reshape(-1, 16)
        else:
            rotation = np.asarray(self.from_rotation(poses.rotation()))
            numbers = np.concatenate([np.asarray(poses.translation()), rotation], axis=1)
        return numbers / self._units(length_unit, angle_unit)

    def _units(self, length_unit: str, angle_unit: str) -> np.ndarray:
        for unit, known, what in (
            (length_unit, LENGTH_UNITS, "length_unit"),
            (angle_unit, ANGLE_UNITS, "angle_unit"),
        ):
            if unit not in known:
                raise ValueError(f"{what} is one of {', '.join(known)}; found {unit!r}")
        units = np.ones(len(self.columns))
        units[list(self.lengths)] = LENGTH_UNITS[length_unit]
        units[list(self.angles)] = ANGLE_UNITS[angle_unit]
        return units


def _from_matrices(numbers: np.ndarray, names: tuple[str, ...]) -> SE3:
    matrices = numbers.reshape(-1, 4, 4)
    problems = check_rigid(matrices, names)
    if problems:
        raise ValueError("; ".join(f"row {name}: {text}" for name, text in problems.items()))
    return SE3.from_matrix(jnp.asarray(matrices))


def _check_quaternions(codec: str, quaternions: np.ndarray, names: tuple[str, ...]) -> None:
    for name, length in zip(names, np.linalg.norm(quaternions, axis=1), strict=True):
        if abs(length - 1.0) > _UNIT_TOLERANCE:
            raise ValueError(f"{codec}: row {name} has a quaternion of length {length:.6g}, not 1")


def _unit(quaternion: Array) -> Array:
    return quaternion / jnp.linalg.norm(quaternion, axis=-1, keepdims=True)


def _wxyz(quaternion: Array) -> SO3:
    return SO3(_unit(quaternion))


def _xyzw(quaternion: Array) -> SO3:
    return SO3(_unit(jnp.concatenate([quaternion[..., 3:], quaternion[..., :3]], axis=-1)))


def _to_xyzw(rotation: SO3) -> Array:
    return jnp.concatenate([rotation.wxyz[..., 1:], rotation.wxyz[..., :1]], axis=-1)


def _reverse(function: Callable[[Array], SO3]) -> Callable[[Array], SO3]:
    return lambda angles: function(angles[..., ::-1])


_XYZ = ("x", "y", "z")
_LENGTHS, _ANGLES = (0, 1, 2), (3, 4, 5)


def _angles(
    name: str,
    columns: tuple[str, str, str],
    to_rotation: Callable[[Array], SO3],
    from_rotation: Callable[[SO3], Array],
) -> PoseCodec:
    return PoseCodec(name, (*_XYZ, *columns), _ANGLES, _LENGTHS, to_rotation, from_rotation)


def _quaternion(
    name: str,
    columns: tuple[str, ...],
    to_rotation: Callable[[Array], SO3],
    from_rotation: Callable[[SO3], Array],
) -> PoseCodec:
    return PoseCodec(name, (*_XYZ, *columns), (), _LENGTHS, to_rotation, from_rotation)


_MATRIX_COLUMNS = tuple(f"m{i}{j}" for i in range(4) for j in range(4))

POSE_CODECS: dict[str, PoseCodec] = {
    codec.name: codec
    for codec in (
        PoseCodec(
            "matrix", _MATRIX_COLUMNS, (), (3, 7, 11), lambda _: SO3.identity(), lambda r: r.wxyz
        ),
        _quaternion("quaternion_xyzw", ("qx", "qy", "qz", "qw"), _xyzw, _to_xyzw),
        _quaternion("quaternion_wxyz", ("qw", "qx", "qy", "qz"), _wxyz, lambda r: r.wxyz),
        _angles("rotation_vector", ("rx", "ry", "rz"), SO3.exp, lambda r: r.log()),
        _angles("yaw_pitch_roll", ("yaw", "pitch", "roll"), rotation_from_ypr, ypr_from_rotation),
        _angles("val_oat", ("O", "A", "T"), rotation_from_oat, oat_from_rotation),
        # Kawasaki: Rz(O) Ry(A) Rz(T), not VAL's angles of the same names.
        _angles("kawasaki_oat", ("O", "A", "T"), rotation_from_zyz, zyz_from_rotation),
        # KUKA: A about z, B about y, C about x, in that order.
        _angles("kuka_abc", ("A", "B", "C"), rotation_from_ypr, ypr_from_rotation),
        _angles("ur", ("rx", "ry", "rz"), SO3.exp, lambda r: r.log()),
        # Fanuc: W about x, P about y, R about z; R = Rz(R) Ry(P) Rx(W).
        _angles(
            "fanuc_wpr",
            ("W", "P", "R"),
            _reverse(rotation_from_ypr),
            lambda r: ypr_from_rotation(r)[..., ::-1],
        ),
        _quaternion("abb", ("q1", "q2", "q3", "q4"), _wxyz, lambda r: r.wxyz),
    )
}
"""Every pose format, by name."""


def pose_codec(name: str) -> PoseCodec:
    """The codec of a pose format.

    Raises:
        ValueError: an unknown name; the message lists those there are.
    """
    if name not in POSE_CODECS:
        raise ValueError(f"pose format is one of {', '.join(POSE_CODECS)}; found {name!r}")
    return POSE_CODECS[name]
