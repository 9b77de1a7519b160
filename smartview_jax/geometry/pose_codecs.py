"""Read and write poses as rows of numbers in named formats of robots and files.

A codec converts rows to transforms and back. Units are stated by the caller, never guessed. Rows
are read with NumPy, so that reading a file compiles no JAX program.

The formats, and the units that the vendors' own programs use, are

| name | rotation | columns after x, y, z | units |
|---|---|---|---|
| `matrix` | 4x4, row by row | (sixteen in all) | |
| `quaternion_xyzw`, `quaternion_wxyz` | unit quaternion | as named | |
| `rotation_vector` | axis times angle | rx, ry, rz | |
| `yaw_pitch_roll` | Rz(yaw) Ry(pitch) Rx(roll), Eq. 16 | yaw, pitch, roll | |
| `val_oat` | Rz(O) Rx(A) M0 Rz(T), Eq. 18 | O, A, T | mm, deg |
| `kawasaki_oat` | Rz(O) Ry(A) Rz(T) | O, A, T | mm, deg |
| `kuka_abc` | Rz(A) Ry(B) Rx(C) | A, B, C | mm, deg |
| `ur` | axis times angle | rx, ry, rz | m, rad in programs; mm, rad on the pendant |
| `fanuc_wpr` | Rz(R) Ry(P) Rx(W) | W, P, R | mm, deg |
| `abb` | unit quaternion, real part first | q1, q2, q3, q4 | mm |
| `staubli_val3` | Rx(rx) Ry(ry) Rz(rz) [2, 3] | rx, ry, rz | mm, deg |
| `doosan` | Rz(A) Ry(B) Rz(C) [2, 4] | A, B, C | mm, deg |
| `comau` | Rz(A) Ry(E) Rz(R) [2] | A, E, R | mm, deg |
| `xarm` | Rz(yaw) Ry(pitch) Rx(roll) [5] | roll, pitch, yaw | mm, deg |
| `yaskawa` | Rz(rz) Ry(ry) Rx(rx) [1, 2, 4] | rx, ry, rz | mm, deg |
| `denso`, `techman` | Rz(rz) Ry(ry) Rx(rx) [2] | rx, ry, rz | mm, deg |
| `mitsubishi` | Rz(C) Ry(B) Rx(A) [2] | A, B, C | mm, deg |
| `epson` | Rz(U) Ry(V) Rx(W) [2] | U, V, W | mm, deg |
| `euler_XYZ_fixed` ... `euler_ZYZ_moving` | any (`euler.py`) | angle1, angle2, angle3 | |

References: [1] the vendors' pose formats as collected in the manual of Basler's rc_visard, chapter
"Pose formats", for all without a number too; VAL's in `oat.py`. [2] Mech-Mind, "Euler angles:
definition and convention", docs.mech-mind.net, whose sxyz is XYZ fixed and rzyx ZYX moving, with
MELFA for Mitsubishi and TM for Techman. [3] COMPAS II, lecture 2, "Robot TCP orientations", ETH
Zurich. [4] Vathos, "Rotations", docs.vathos.net. [5] UFACTORY, xArm user
manual, "Motion characteristics": R = Rz(yaw) Ry(pitch) Rx(roll).
"""

import dataclasses
from collections.abc import Callable, Sequence
from itertools import compress

import numpy as np
from jaxlie import SE3, SO3
from jaxtyping import Array, Float

from ..argument_checks import require_one_of
from ..runtime.array_namespace import to_device
from ..runtime.compilation import one_program
from .euler import EULER_CONVENTIONS, axis_rotations
from .host import host_exponentials, host_matrices, host_poses, host_transforms
from .oat import VAL_M0, oat_from_rotation
from .rigid_transforms import check_rigid

LENGTH_UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
"""Size of each known unit of length, m."""

ANGLE_UNITS = {"rad": 1.0, "deg": float(np.pi / 180.0)}
"""Size of each known unit of angle, rad."""

_QUATERNION_NORM_TOLERANCE = 1e-3
"""Largest accepted difference of a quaternion's length from 1; files have few digits."""

_MAX_RADIANS = 4.0 * np.pi
"""Largest accepted angle, rad; a larger number must be in degrees."""

_MAX_NAMED_ROWS = 5
"""Largest number of bad rows that a message names; with a wrong format all rows are bad."""

_SI, _MM_DEG = ("m", "rad"), ("mm", "deg")


@dataclasses.dataclass(frozen=True)
class PoseCodec:
    """A format that writes a rigid transform as a row of numbers.

    Attributes:
        name: name of the format.
        columns: name of each number.
        length_columns: indices of the columns that are lengths.
        angle_columns: indices of the columns that are angles.
        to_numbers: converts rows `(n, columns)` in m and rad to the numbers `(n, 7)` of `SE3`.
        from_se3: converts transforms `(*batch)` to rows `(*batch, columns)` in m and rad.
        check: returns an error text for each of the labelled rows `(n, columns)` that is not a
            rigid transform.
        units: units of length and angle that the manufacturer's own programs use.
    """

    name: str
    columns: tuple[str, ...]
    length_columns: tuple[int, ...]
    angle_columns: tuple[int, ...]
    to_numbers: Callable[[np.ndarray], np.ndarray]
    from_se3: Callable[[SE3], np.ndarray | Array]
    check: Callable[[np.ndarray, tuple[str, ...]], list[str]]
    units: tuple[str, str] = ("m", "rad")

    def decode(
        self,
        rows: np.ndarray | Array,
        length_unit: str = "m",
        angle_unit: str = "rad",
        labels: Sequence[str] | None = None,
    ) -> SE3:
        """Return the transforms `(*batch)` that rows `(*batch, columns)` describe.

        Args:
            rows: the numbers, in the stated units.
            length_unit: a key of `LENGTH_UNITS`.
            angle_unit: a key of `ANGLE_UNITS`.
            labels: one name per row, for messages; by default the row's number.

        Raises:
            ValueError: an unknown unit, a wrong number of columns or labels, angles too large for
                radians, or a row that is not a rigid transform, named by its label.
        """
        numbers = np.array(rows, dtype=float)
        if numbers.ndim == 0 or numbers.shape[-1] != len(self.columns):
            raise ValueError(
                f"{self.name}: expected rows of {len(self.columns)} numbers "
                f"({', '.join(self.columns)}), found shape {numbers.shape}"
            )
        magnitudes = np.abs(numbers[..., list(self.angle_columns)])
        if angle_unit == "rad" and (magnitudes[np.isfinite(magnitudes)] > _MAX_RADIANS).any():
            raise ValueError(
                f"{self.name}: angles up to {np.nanmax(magnitudes):.4g} are too large for radians; "
                "for degrees state angle_unit: deg"
            )
        numbers = numbers * self._unit_factors(length_unit, angle_unit)
        # The checks need a flat list of rows, with one label for each.
        flat = numbers.reshape(-1, len(self.columns))
        names = tuple(map(str, range(len(flat)) if labels is None else labels))
        if len(names) != len(flat):
            raise ValueError(f"{self.name}: {len(flat)} rows, but {len(names)} labels")
        self._require_rigid(flat, names)
        return SE3(to_device(self.to_numbers(flat).reshape(*numbers.shape[:-1], 7)))

    def encode(
        self, poses: SE3, length_unit: str = "m", angle_unit: str = "rad"
    ) -> Float[np.ndarray, "*batch columns"]:
        """Return transforms `(*batch)` as rows `(*batch, columns)` in the stated units.

        Raises:
            ValueError: an unknown unit.
        """
        return np.asarray(self.from_se3(poses)) / self._unit_factors(length_unit, angle_unit)

    def _require_rigid(self, rows: np.ndarray, names: tuple[str, ...]) -> None:
        """Raise a ValueError that names the rows that are not rigid transforms, if any."""
        problems = [
            f"row {name} contains NaN or infinity ({', '.join(compress(self.columns, wrong))})"
            for name, wrong in zip(names, ~np.isfinite(rows), strict=True)
            if wrong.any()
        ]
        problems = problems or self.check(rows, names)
        if problems:
            more = len(problems) - _MAX_NAMED_ROWS
            rest = f"; and {more} more of {len(rows)} rows" if more > 0 else ""
            raise ValueError(f"{self.name}: {'; '.join(problems[:_MAX_NAMED_ROWS])}{rest}")

    def _unit_factors(self, length_unit: str, angle_unit: str) -> np.ndarray:
        """Return the factor of each column that converts it to m or rad.

        Raises:
            ValueError: an unknown unit.
        """
        require_one_of("length_unit", length_unit, LENGTH_UNITS)
        require_one_of("angle_unit", angle_unit, ANGLE_UNITS)
        factors = np.ones(len(self.columns))
        factors[list(self.length_columns)] = LENGTH_UNITS[length_unit]
        factors[list(self.angle_columns)] = ANGLE_UNITS[angle_unit]
        return factors


def _matrix_codec() -> PoseCodec:
    """Return the codec of 4x4 matrices, written row by row."""

    def check(rows: np.ndarray, names: tuple[str, ...]) -> list[str]:
        """Return an error text for each row that is not a rigid transform."""
        problems = check_rigid(rows.reshape(-1, 4, 4), names)
        return [f"row {name}: {text}" for name, text in problems.items()]

    return PoseCodec(
        name="matrix",
        columns=tuple(f"m{i}{j}" for i in range(4) for j in range(4)),
        length_columns=(3, 7, 11),
        angle_columns=(),
        to_numbers=lambda rows: np.asarray(host_transforms(rows.reshape(-1, 4, 4)).wxyz_xyz),
        from_se3=lambda poses: host_matrices(poses).reshape(*poses.get_batch_axes(), 16),
        check=check,
    )


def _quaternion_codec(
    name: str, columns: tuple[str, ...], wxyz: tuple[int, ...], units: tuple[str, str] = _SI
) -> PoseCodec:
    """Return a codec of x, y, z and a unit quaternion: `wxyz` are indices among its columns."""
    # (w, x, y, z) = row[wxyz], so that row = (w, x, y, z)[argsort(wxyz)], the inverse permutation.
    inverse_permutation = tuple(int(k) for k in np.argsort(wxyz))

    def check(rows: np.ndarray, names: tuple[str, ...]) -> list[str]:
        """Return an error text for each row whose quaternion does not have length 1."""
        lengths = np.linalg.norm(rows[:, 3:], axis=1)
        return [
            f"row {label} has a quaternion of length {length:.6g}, not 1"
            for label, length in zip(names, lengths, strict=True)
            if abs(length - 1.0) > _QUATERNION_NORM_TOLERANCE
        ]

    return _position_rotation_codec(
        name,
        columns,
        angle_columns=(),
        to_numbers=lambda rows: np.hstack([_unit(rows[:, 3:][:, wxyz]), rows[:, :3]]),
        from_rotation=lambda rotation: np.asarray(rotation.wxyz)[..., list(inverse_permutation)],
        check=check,
        units=units,
    )


def _angle_codec(
    name: str,
    columns: tuple[str, str, str],
    to_matrices: Callable[[np.ndarray], np.ndarray],
    from_rotation: Callable[[SO3], np.ndarray | Array],
    units: tuple[str, str] = _SI,
) -> PoseCodec:
    """Return a codec of x, y, z and three numbers in units of angle."""

    def to_numbers(rows: np.ndarray) -> np.ndarray:
        """Return the numbers of `SE3`."""
        poses = host_transforms(host_poses(to_matrices(rows[:, 3:]), rows[:, :3]))
        return np.asarray(poses.wxyz_xyz)

    return _position_rotation_codec(
        name, columns, (3, 4, 5), to_numbers, from_rotation, lambda rows, names: [], units
    )


def _position_rotation_codec(
    name: str,
    columns: tuple[str, ...],
    angle_columns: tuple[int, ...],
    to_numbers: Callable[[np.ndarray], np.ndarray],
    from_rotation: Callable[[SO3], np.ndarray | Array],
    check: Callable[[np.ndarray, tuple[str, ...]], list[str]],
    units: tuple[str, str],
) -> PoseCodec:
    """Return a codec whose rows are x, y, z and then the numbers of the rotation.

    The indices of the columns that are angles are in the whole row.
    """
    return PoseCodec(
        name=name,
        columns=("x", "y", "z", *columns),
        length_columns=(0, 1, 2),
        angle_columns=angle_columns,
        to_numbers=to_numbers,
        from_se3=lambda poses: _position_and_rotation(poses, from_rotation),
        check=check,
        units=units,
    )


def _position_and_rotation(
    poses: SE3, from_rotation: Callable[[SO3], np.ndarray | Array]
) -> Float[np.ndarray, "*batch columns"]:
    """Return rows of x, y, z and the numbers of the rotation."""
    numbers = np.asarray(poses.wxyz_xyz)
    rotations = from_rotation(SO3(to_device(numbers[..., :4])))
    return np.concatenate([numbers[..., 4:], np.asarray(rotations)], axis=-1)


def _euler_codec(
    name: str,
    convention: str,
    columns: tuple[str, str, str] = ("angle1", "angle2", "angle3"),
    units: tuple[str, str] = _SI,
) -> PoseCodec:
    """Return a codec of x, y, z and the angles of one of `EULER_CONVENTIONS`."""
    euler = EULER_CONVENTIONS[convention]

    def angles(rotation: SO3) -> Float[np.ndarray, "*batch 3"]:
        """Return the angles of JAX's rotations on the host."""
        numbers = np.asarray(rotation.wxyz)
        rows = np.pad(numbers.reshape(-1, 4), ((0, 0), (0, 3)))
        # NumPy's numbers in a transform compile no program.
        matrices = host_matrices(SE3(rows))[:, :3, :3]  # pyright: ignore[reportArgumentType]
        return euler.from_matrices(matrices).reshape(*numbers.shape[:-1], 3)

    return _angle_codec(name, columns, euler.to_matrices, angles, units)


def _unit(quaternions: np.ndarray) -> np.ndarray:
    """Return quaternions scaled to length 1."""
    return quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)


def _from_vectors(vectors: np.ndarray) -> np.ndarray:
    """Return the matrices of rotation vectors, rad."""
    return host_exponentials(np.pad(vectors, ((0, 0), (3, 0))))[:, :3, :3]


def _from_oat(oat: np.ndarray) -> np.ndarray:
    """Return the matrices of VAL's angles O, A, T in rad (Eq. 18)."""
    # R = Rz(O) Rx(A) M0 Rz(T)
    O, A, T = (axis_rotations(axis, oat[:, k]) for k, axis in enumerate("ZXZ"))
    return O @ A @ VAL_M0 @ T


_rotation_vector = one_program(SO3.log)

_RXYZ, _OAT, _ABC = ("rx", "ry", "rz"), ("O", "A", "T"), ("A", "B", "C")

POSE_CODECS: dict[str, PoseCodec] = {
    codec.name: codec
    for codec in (
        _matrix_codec(),
        _quaternion_codec("quaternion_xyzw", ("qx", "qy", "qz", "qw"), wxyz=(3, 0, 1, 2)),
        _quaternion_codec("quaternion_wxyz", ("qw", "qx", "qy", "qz"), wxyz=(0, 1, 2, 3)),
        _angle_codec("rotation_vector", _RXYZ, _from_vectors, _rotation_vector),
        _euler_codec("yaw_pitch_roll", "euler_ZYX_moving", ("yaw", "pitch", "roll")),
        _angle_codec("val_oat", _OAT, _from_oat, oat_from_rotation, _MM_DEG),
        _euler_codec("kawasaki_oat", "euler_ZYZ_moving", _OAT, _MM_DEG),
        _euler_codec("kuka_abc", "euler_ZYX_moving", _ABC, _MM_DEG),
        _angle_codec("ur", _RXYZ, _from_vectors, _rotation_vector),
        _euler_codec("fanuc_wpr", "euler_XYZ_fixed", ("W", "P", "R"), _MM_DEG),
        _quaternion_codec("abb", ("q1", "q2", "q3", "q4"), (0, 1, 2, 3), ("mm", "rad")),
        _euler_codec("staubli_val3", "euler_XYZ_moving", _RXYZ, _MM_DEG),
        _euler_codec("doosan", "euler_ZYZ_moving", _ABC, _MM_DEG),
        _euler_codec("comau", "euler_ZYZ_moving", ("A", "E", "R"), _MM_DEG),
        _euler_codec("xarm", "euler_XYZ_fixed", ("roll", "pitch", "yaw"), _MM_DEG),
        _euler_codec("yaskawa", "euler_XYZ_fixed", _RXYZ, _MM_DEG),
        _euler_codec("denso", "euler_XYZ_fixed", _RXYZ, _MM_DEG),
        _euler_codec("techman", "euler_XYZ_fixed", _RXYZ, _MM_DEG),
        _euler_codec("mitsubishi", "euler_XYZ_fixed", _ABC, _MM_DEG),
        _euler_codec("epson", "euler_ZYX_moving", ("U", "V", "W"), _MM_DEG),
    )
}
"""Codec of every pose format, by name, except the conventions of three angles."""

EULER_CODECS = {name: _euler_codec(name, name) for name in EULER_CONVENTIONS}
"""Codec of every convention of three angles, by name, for robots without a format of their own."""


def pose_codec(name: str) -> PoseCodec:
    """Return the codec of a named pose format.

    Raises:
        ValueError: an unknown name; the message lists the known ones.
    """
    if name in EULER_CODECS:
        return EULER_CODECS[name]
    others = ", or one of euler_XYZ_fixed, euler_XYZ_moving, ..., euler_ZYZ_moving"
    require_one_of("pose format", name, POSE_CODECS, others)
    return POSE_CODECS[name]
