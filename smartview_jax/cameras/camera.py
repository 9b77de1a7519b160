"""Project points to pixels with four pinhole parameters and a lens (Eqs. 2 to 4 of the paper)."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from ..runtime.array_namespace import AnyArray, as_float_array
from ..runtime.compilation import is_traced, one_program
from .lens import AbstractLens


class Camera(eqx.Module):
    """A camera that maps points of its own frame to pixels.

    The pixel is `u = alpha_u x + u0`, `v = alpha_v y + v0`, with `(x, y)` from the lens. Pixels
    follow OpenCV: the centre of the top-left pixel is (0, 0), u to the right, v down; the camera
    frame has x to the right, y down, z forward.

    Attributes:
        alpha_u, alpha_v: focal length over pixel pitch (px).
        u0, v0: principal point (px).
        lens: any `AbstractLens`.
        image_size: width and height (px).

    For example:

        >>> camera = sv.Camera(800.0, 800.0, 320.0, 240.0, sv.cameras.Pinhole(), (640, 480))
        >>> pixels, valid = camera.project(np.array([[0.1, 0.0, 1.0], [0.0, 0.0, -1.0]]))
        >>> print(np.round(pixels).tolist(), valid)
        [[400.0, 240.0], [nan, nan]] [ True False]
    """

    alpha_u: Float[Array, ""] = eqx.field(converter=as_float_array)
    alpha_v: Float[Array, ""] = eqx.field(converter=as_float_array)
    u0: Float[Array, ""] = eqx.field(converter=as_float_array)
    v0: Float[Array, ""] = eqx.field(converter=as_float_array)
    lens: AbstractLens
    image_size: tuple[int, int] = eqx.field(static=True)

    def __repr__(self) -> str:
        # A traced camera, inside `jit`, has no figures to show.
        if is_traced(self):
            return super().__repr__()
        lens = ", ".join(
            f"{name}={float(value):.6g}"
            for name, value in vars(self.lens).items()
            if np.ndim(value) == 0
        )
        return (
            f"Camera(alpha_u={float(self.alpha_u):.6g}, alpha_v={float(self.alpha_v):.6g}, "
            f"u0={float(self.u0):.6g}, v0={float(self.v0):.6g}, "
            f"lens={type(self.lens).__name__}({lens}), image_size={self.image_size})"
        )

    @property
    def K(self) -> Float[AnyArray, "3 3"]:  # noqa: N802 - as everybody calls it
        """The camera matrix `[[alpha_u, 0, u0], [0, alpha_v, v0], [0, 0, 1]]`, px."""
        if is_traced(self):
            zero, one = jnp.zeros(()), jnp.ones(())
            rows = [[self.alpha_u, zero, self.u0], [zero, self.alpha_v, self.v0], [zero, zero, one]]
            return jnp.stack([jnp.stack(row) for row in rows])
        return np.array([[self.alpha_u, 0.0, self.u0], [0.0, self.alpha_v, self.v0], [0, 0, 1]])

    @one_program
    def project(
        self, points: Float[Array, "*batch 3"]
    ) -> tuple[Float[Array, "*batch 2"], Bool[Array, "*batch"]]:
        """Return the pixels of points in the camera frame.

        A point is valid if it is in front of the camera and inside the lens's domain; a valid
        pixel may still lie outside the picture.

        Args:
            points: in the camera frame, m.

        Returns:
            The pixels, NaN where not valid; and whether each is valid.
        """
        # u = alpha_u x + u0,   v = alpha_v y + v0
        plane_points, valid = self.lens.distort(points)
        # NaN is inserted last: as a factor it would make the derivatives of masked points NaN too.
        x = jnp.where(valid, plane_points[..., 0], 0.0)
        y = jnp.where(valid, plane_points[..., 1], 0.0)
        pixels = jnp.stack([self.alpha_u * x + self.u0, self.alpha_v * y + self.v0], axis=-1)
        return jnp.where(valid[..., None], pixels, jnp.nan), valid

    @one_program
    def unproject(
        self, pixels: Float[Array, "*batch 2"]
    ) -> tuple[Float[Array, "*batch 3"], Bool[Array, "*batch"]]:
        """Return the unit rays in the camera frame that are seen at the given pixels.

        Returns:
            The rays, NaN where not valid; and whether each is valid.
        """
        # x = (u - u0) / alpha_u,   y = (v - v0) / alpha_v, then the inverse of the lens.
        return self.lens.undistort(
            (pixels - self._principal_point(pixels.ndim)) / self._focal_lengths(pixels.ndim)
        )

    def resized(self, image_size: tuple[int, int]) -> "Camera":
        """Return the camera of this camera's pictures brought to another size.

        Args:
            image_size: width and height, px.
        """
        by_u, by_v = (new / old for new, old in zip(image_size, self.image_size, strict=True))
        # The border of a picture is half a pixel outside the centre of its first pixel.
        return Camera(
            by_u * np.asarray(self.alpha_u),
            by_v * np.asarray(self.alpha_v),
            by_u * (np.asarray(self.u0) + 0.5) - 0.5,
            by_v * (np.asarray(self.v0) + 0.5) - 0.5,
            self.lens,
            image_size,
        )

    def _focal_lengths(self, rank: int) -> Float[Array, "*ones 2"]:
        """Return alpha_u and alpha_v, px, with as many leading axes of size one as a rank needs."""
        return jnp.stack([self.alpha_u, self.alpha_v]).reshape((1,) * (rank - 1) + (2,))

    def _principal_point(self, rank: int) -> Float[Array, "*ones 2"]:
        """Return u0 and v0, px, with as many leading axes of size one as a rank needs."""
        return jnp.stack([self.u0, self.v0]).reshape((1,) * (rank - 1) + (2,))


def in_picture(
    pixels: Float[np.ndarray, "*pixels 2"], image_size: tuple[int, int] | np.ndarray
) -> Bool[np.ndarray, "*pixels"]:
    """Return which pixels are within a picture of some width and height; False for NaN.

    Args:
        pixels: px.
        image_size: width and height, px; or an array of them that broadcasts with the pixels.
    """
    # The centre of the first pixel is (0, 0), so that the picture's border is half a pixel out.
    with np.errstate(invalid="ignore"):
        inside = (pixels >= -0.5) & (pixels <= np.array(image_size) - 0.5)
    return np.asarray(inside.all(axis=-1))
