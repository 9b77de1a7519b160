"""Find joints that turn by another angle than reported: a gear ratio, or a coupling with a joint.

A driver with another number of teeth, or of counts of its encoder, reports a share of each turn; a
wrist whose motors drive two joints together reports a joint without the share of the other one.
Robot and camera may then agree to a fraction of a degree, as with joint zeros that are off or links
that bend. So all these errors have numbers, with standard deviations as of a poor arm, and an
explanation is likely only if the views want it in addition.

The poses of the views are linear in small errors. With errors e of the poses, the Jacobian A of the
numbers, their covariance P and variances of the noise W, `e ~ N(0, A P A^T + W)`.

Reference: Mooring, Roth and Driels, Fundamentals of Manipulator Calibration, 1991.
"""

import dataclasses
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxlie import SE3
from jaxtyping import Bool, Float
from scipy.optimize import minimize

from ..calibration import mount_frames
from ..geometry import host_adjoints, host_logarithms, host_matrices
from ..robots import SerialArm, dh_jacobian, gravity_loads
from .closure import MAX_CLOSURE_SCORE, Poses, contradicts_calibration
from .misfit_evidence import VERY_STRONG_EVIDENCE, evidence, in_parts
from .transform_fit import fit_transforms, mean_size, median_distance, misfit_text

SIZE_STEP = 1e-4
"""Relative step by which the target's size is varied."""

MAX_TRIED = 4
"""Number of the likeliest shares for which the poses are linearised again."""

MAX_STEP_OF_STD = 0.1
"""Largest last step of a share, in its standard deviations."""

MAX_STEPS = 6
"""Largest number of times that the poses are linearised again."""

MIN_LOGARITHM, MAX_LOGARITHM = -14.0, 0.0
"""Limits of the logarithms of the noise, m and rad: from a thousandth of a millimetre on."""

Twists = Float[np.ndarray, "views 6"]
Columns = Float[np.ndarray, "views 6 numbers"]


@dataclasses.dataclass(frozen=True)
class JointShareOptions:
    """Say how large the errors of a poor arm are, and which share of a joint is named.

    Attributes:
        zero_std, length_std, twist_std, compliance_std: standard deviations of the errors of a poor
            arm: of joint zeros (rad), of links (m and rad), and of a joint's angle under the weight
            of the arm (rad).
        size_std: standard deviation of the target's size over the stated one.
        share_zero_std, share_std: standard deviations, before any view, of the zero (rad) of a
            joint that is reported wrongly, and of the share by which it turns too far. At which
            reading it is right is not known.
        min_share: smallest share that is named: gears have at most some hundred teeth, and one is
            one too many.
        min_views: fewest views: their poses have 48 numbers, and 18 determine both transforms and
            joint zeros.
        min_odds: smallest odds of a share.
    """

    zero_std: float = 0.03
    length_std: float = 2e-3
    twist_std: float = 3e-3
    compliance_std: float = 3e-3
    size_std: float = 0.05
    share_zero_std: float = 0.5
    share_std: float = 0.1
    min_share: float = 1.0 / 300.0
    min_views: int = 8
    min_odds: float = VERY_STRONG_EVIDENCE

    @property
    def stds_of_share(self) -> tuple[float, float]:
        """The standard deviations of the zero and of the share of a joint."""
        return self.share_zero_std, self.share_std

    def stds_of_arm(self, joint_count: int) -> Float[np.ndarray, "numbers"]:
        """Return the standard deviations of the numbers that all arms have, by kind and joint."""
        of_links = self.length_std, self.length_std, self.twist_std
        return np.repeat([self.zero_std, *of_links, self.compliance_std], joint_count)


class JointShare(NamedTuple):
    """A joint that turns by a share of a reading in addition to what it reports.

    Attributes:
        joint, reading: indices of the joint and of the reading; equal for a gear ratio.
        share: the share.
        std: its standard deviation.
        misfit, given_misfit: mean misfit over the views with this share and without, m and rad.
        score, given_score: rotation plus translation over the distance to the target, in the same
            two cases.
    """

    joint: int
    reading: int
    share: float
    std: float
    misfit: tuple[float, float]
    given_misfit: tuple[float, float]
    score: float
    given_score: float

    @property
    def contradicts(self) -> bool:
        """Whether no calibration can be right with the readings as given."""
        return contradicts_calibration(self.score, self.given_score)

    @property
    def sentence(self) -> str:
        """The fault of the readings in words, and what to do."""
        number, other = self.joint + 1, self.reading + 1
        digits = max(0, -int(np.floor(np.log10(max(self.std, 1e-6)))))
        if self.joint == self.reading:
            what = (
                f"joint {number} seems to turn {1.0 + self.share:.{digits}f} +- "
                f"{self.std:.{digits}f} times as far as reported, as with another gear ratio or "
                "other counts of its encoder"
            )
        else:
            what = (
                f"joint {number} seems to turn by its own reading and {self.share:+.{digits}f} +- "
                f"{self.std:.{digits}f} of the one of joint {other}: they are coupled"
            )
        return (
            f"{what}: with this, other zeros and other links, robot and camera agree to "
            f"{misfit_text(self.misfit)} instead of {misfit_text(self.given_misfit)} (means over "
            "the views). Correct the readings"
        )


def find_joint_share(
    readings: Float[np.ndarray, "views joints"],
    arm: SerialArm,
    camera_from_world: SE3,
    mount: str,
    used: Bool[np.ndarray, "views"],
    options: JointShareOptions | None = None,
) -> JointShare | None:
    """Return the joint that turns by another angle than reported, if that explains the views.

    Args:
        readings: joint readings, rad, or m for a prismatic joint.
        arm: as described.
        camera_from_world: from the pictures alone, `(views)`.
        mount: where the camera is stated to be.
        used: mask of the views to use.
        options: what a poor arm is, and which share is named; by default `JointShareOptions()`.

    Returns:
        None if the errors of a poor arm explain the views as well.
    """
    options = options or JointShareOptions()
    camera = host_matrices(camera_from_world)
    views = np.flatnonzero(used & np.isfinite(camera).all(axis=(1, 2)))
    if len(views) < options.min_views:
        return None
    in_hand = mount_frames(mount)[0] == "tool"
    chain = _Chain(arm, readings[views], camera[views], in_hand, options)
    errors, common, motion = chain.linearised(chain.readings)
    given = _fit(errors, common, chain.stds)
    possible = chain.possible_shares
    shares = np.stack([chain.columns(motion, *pair) for pair in possible])
    gains = given.gains(shares, np.array(options.stds_of_share))
    # Twice the logarithm of the odds, where any joint may be wrong.
    needed = 2.0 * np.log(options.min_odds * len(possible))
    # Most arms are done with here.
    if gains.max() < 0.0:
        return None
    likeliest = [possible[k] for k in np.argsort(-gains)[:MAX_TRIED]]
    tried = [(chain.share_of(joint, reading), (joint, reading)) for joint, reading in likeliest]
    explained, (joint, reading) = min(tried, key=lambda entry: entry[0].deviance)
    share = float(explained.numbers[-1])
    if given.deviance - explained.deviance < needed or abs(share) < options.min_share:
        return None
    # The zero alone may be all that is wrong: the odds of a share are its density at zero without
    # the views over the one with them (Savage and Dickey).
    ratio = options.share_std / explained.std
    if (share / explained.std) ** 2 - 2.0 * np.log(ratio) < needed:
        return None
    odds = evidence(in_parts(given.left_over), in_parts(explained.left_over), 1)
    if odds < needed:
        return None
    distance = median_distance(chain.camera)
    given_misfit, given_score = mean_size(given.left_over, distance)
    misfit, score = mean_size(explained.left_over, distance)
    # What does not make robot and camera agree may be anything else.
    if score > MAX_CLOSURE_SCORE:
        return None
    return JointShare(
        joint, reading, share, explained.std, misfit, given_misfit, score, given_score
    )


class _Chain(NamedTuple):
    """An arm with readings of its joints, and where the camera was in the same views.

    Attributes:
        arm: as described.
        readings: of the joints.
        camera: `camera_from_world` of the views.
        in_hand: whether the camera is on the hand.
        options: standard deviations of the errors of a poor arm.
    """

    arm: SerialArm
    readings: Float[np.ndarray, "views joints"]
    camera: Poses
    in_hand: bool
    options: JointShareOptions

    @property
    def stds(self) -> Float[np.ndarray, "numbers"]:
        """Standard deviations of the numbers that all arms have; infinite for both transforms."""
        of_arm = self.options.stds_of_arm(self.arm.joint_count)
        return np.concatenate([np.full(12, np.inf), [self.options.size_std], of_arm])

    @property
    def possible_shares(self) -> list[tuple[int, int]]:
        """Joints and readings that may drive them; a slide and a turn have no common unit."""
        count, prismatic = self.arm.joint_count, self.arm.prismatic
        return [
            (joint, reading)
            for joint in range(count)
            for reading in range(count)
            if joint == reading or not (prismatic[joint] or prismatic[reading])
        ]

    def columns(
        self, motion: Float[np.ndarray, "views 6 joints"], joint: int, reading: int
    ) -> Columns:
        """Return how the tool moves for a zero of a joint, and for a share of a reading."""
        of_zero = motion[:, :, joint]
        return np.stack([of_zero, of_zero * self._about_mean(reading)[:, None]], axis=2)

    def share_of(self, joint: int, reading: int) -> "_Fit":
        """Return the likeliest share by which a joint turns with a reading, the last number."""
        turned, stds = self.readings.copy(), np.append(self.stds, self.options.stds_of_share)
        numbers = np.zeros(2)
        fit = None
        for _ in range(MAX_STEPS):
            errors, common, motion = self.linearised(turned)
            columns = self.columns(motion, joint, reading)
            # The prior is about no share, wherever the poses are linearised.
            errors = errors + columns @ numbers
            fit = _fit(errors, np.concatenate([common, columns], axis=2), stds)
            step, numbers = fit.numbers[-2:] - numbers, fit.numbers[-2:]
            turned[:, joint] += step[0] + step[1] * self._about_mean(reading)
            if abs(step[1]) < MAX_STEP_OF_STD * fit.std:
                break
        assert fit is not None
        return fit

    def _about_mean(self, reading: int) -> Float[np.ndarray, "views"]:
        """Return a reading minus its mean over the views."""
        return self.readings[:, reading] - self.readings[:, reading].mean()

    def linearised(
        self, readings: Float[np.ndarray, "views joints"]
    ) -> tuple[Twists, Columns, Float[np.ndarray, "views 6 joints"]]:
        """Return the errors of the tool's poses at some readings, and what they are linear in.

        Returns:
            The errors, as twists at the tool; the columns of both transforms, of the target's size
            and of the errors of an arm; and how the tool moves for each joint.
        """
        arm = self.arm
        tool = host_matrices(arm.base_from_tool(readings))
        robot = np.linalg.inv(tool) if self.in_hand else tool
        fit = fit_transforms(robot, self.camera)
        tool_from_base = np.linalg.inv(tool)

        def errors_of_tool(closure: Poses) -> Twists:
            """Return where the tool is, as twists from where the readings put it."""
            actual = tool @ np.linalg.inv(closure) if self.in_hand else closure @ tool
            return host_logarithms(tool_from_base @ actual)

        errors, larger = errors_of_tool(fit.closure), self.camera.copy()
        larger[:, :3, 3] *= 1.0 + SIZE_STEP
        of_size = (errors_of_tool(fit.closure_of(robot, larger)) - errors) / SIZE_STEP
        at_readings = jnp.asarray(readings)
        theta, d, a, alpha = np.moveaxis(np.asarray(dh_jacobian(arm, at_readings)), 2, 0)
        motion = np.where(np.array(arm.prismatic), d, theta)
        bending = motion * np.asarray(gravity_loads(arm, at_readings))[:, None]
        mount = np.broadcast_to(np.eye(6), (len(tool), 6, 6))
        of_base = host_adjoints(tool_from_base)
        columns = (mount, of_base, of_size[..., None], motion, d, a, alpha, bending)
        return errors, np.concatenate(columns, axis=2), motion


class _Fit(NamedTuple):
    """The likeliest numbers for the likeliest noise.

    Attributes:
        deviance: minus twice the logarithm of the likelihood, but for a constant.
        numbers: one for each column.
        std: standard deviation of the last number.
        left_over: errors without what the numbers explain, m and rad.
        scaled, covariance: columns in the units of the numbers' covariance, and the latter.
        weights: of the squares of translations and rotations, 1 / m^2 and 1 / rad^2.
    """

    deviance: float
    numbers: Float[np.ndarray, "numbers"]
    std: float
    left_over: Twists
    scaled: Columns
    covariance: Float[np.ndarray, "numbers numbers"]
    weights: Float[np.ndarray, "2"]

    def gains(
        self, more: Float[np.ndarray, "sets views 6 added"], stds: Float[np.ndarray, "added"]
    ) -> Float[np.ndarray, "sets"]:
        """Return by how much each of several sets of numbers would lower the deviance.

        At this noise, with the errors' covariance S, columns c have the information c^T S^-1 c.

        Args:
            more: columns of each set.
            stds: of its numbers before any view.
        """
        added = more * stds
        weighted = added * np.repeat(self.weights, 3)[:, None]
        shared = np.einsum("svia,vin->san", weighted, self.scaled)
        information = np.einsum("svia,svib->sab", weighted, added) + np.eye(len(stds))
        information -= shared @ self.covariance @ shared.swapaxes(1, 2)
        along = np.einsum("svia,vi->sa", weighted, self.left_over)
        explained = np.einsum(
            "sa,sa->s", along, np.linalg.solve(information, along[..., None])[..., 0]
        )
        return explained - np.linalg.slogdet(information)[1]


def _fit(errors: Twists, columns: Columns, stds: Float[np.ndarray, "numbers"]) -> _Fit:
    """Return the numbers that explain errors best, whose noise is estimated by its likelihood.

    Args:
        errors: of the tool's poses, m and rad.
        columns: how they change with each number.
        stds: of the numbers before any view; infinite where they may have any value.
    """
    is_known = np.isfinite(stds)
    # Scaled by standard deviations, or by the motion that they cause, all numbers are about one.
    sizes = np.linalg.norm(columns.reshape(-1, columns.shape[2]), axis=0)
    units = np.where(is_known, stds, 1.0 / np.maximum(sizes, 1e-12))
    scaled = columns * units
    # By translation and rotation, which have a variance each.
    parts = in_parts(errors), scaled.reshape(len(errors), 2, 3, -1)
    grams = np.einsum("vkim,vkin->kmn", parts[1], parts[1])
    sides = np.einsum("vkim,vki->km", parts[1], parts[0])
    count = 3.0 * len(errors)

    def solved(logarithms: Float[np.ndarray, "2"]) -> tuple[float, np.ndarray, np.ndarray]:
        """Return the deviance for some noise, the numbers and their covariance."""
        weights = np.exp(-2.0 * logarithms)
        normal = np.einsum("k,kmn->mn", weights, grams) + np.diag(is_known.astype(float))
        # The zero of the last joint turns the mount: what nothing determines stays where it is.
        normal += 1e-9 * np.diag(np.diag(normal))
        side = weights @ sides
        covariance = np.linalg.inv(normal)
        numbers = covariance @ side
        # The difference of two large sums of squares would be lost in rounding.
        left_over = parts[0] - parts[1] @ numbers
        squares = weights @ np.sum(left_over**2, axis=(0, 2)) + np.sum(numbers[is_known] ** 2)
        determinant = np.linalg.slogdet(normal)[1] + 2.0 * count * np.sum(logarithms)
        return float(squares + determinant), numbers, covariance

    squares = np.sum(parts[0] ** 2, axis=(0, 2))
    start = 0.5 * np.log(np.maximum(squares / count, np.exp(2.0 * MIN_LOGARITHM)))
    bounds = [(MIN_LOGARITHM, MAX_LOGARITHM)] * 2
    start = np.clip(start - 1.0, MIN_LOGARITHM, MAX_LOGARITHM)
    best = minimize(lambda x: solved(x)[0], start, method="L-BFGS-B", bounds=bounds)
    deviance, numbers, covariance = solved(best.x)
    return _Fit(
        deviance,
        numbers * units,
        float(units[-1] * np.sqrt(covariance[-1, -1])),
        errors - scaled @ numbers,
        scaled,
        covariance,
        np.exp(-2.0 * best.x),
    )
