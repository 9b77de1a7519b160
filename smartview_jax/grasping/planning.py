"""Plan grasps of a found object: motions, checks, probabilities, and their order."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from ..geometry import host_transformed, host_transforms
from ..robots import Command, Gripper
from ..runtime.array_namespace import to_device
from .candidates import Candidate, candidate_grasps
from .collisions import (
    CollisionChecker,
    Contact,
    closing_fingers,
    swept_gripper,
    swept_object,
)
from .localized import LocalizedObject, checked_object
from .motions import Motions, plan_motions
from .planned import PHASES, GraspPlan, NoSafeGraspError, PlannedGrasp
from .scene import GraspScene, Obstacle
from .success import grasp_conditions, success_probability
from .uncertainty import GripperErrors, error_covariance, gripper_errors

GRASPS_AT_ONCE = 12
"""Number of grasps whose motions are computed at once, the most promising first."""


@dataclasses.dataclass(frozen=True)
class Motion:
    """The motions before and after the fingers close, and the required probability of success.

    Attributes:
        approach: length of the straight approach to the grasp, m.
        lift: height of the first, vertical lift of the object, m.
        retreat: height above the grasp at which the motion ends, m.
        min_probability: smallest probability of success of a safe grasp.
    """

    approach: float = 0.06
    lift: float = 0.03
    retreat: float = 0.15
    min_probability: float = 0.5

    def __post_init__(self) -> None:
        """Raise a ValueError for a distance that is not positive, or a retreat below the lift."""
        if not (0.0 < self.approach < 2.0 and 0.0 < self.lift <= self.retreat < 2.0):
            raise ValueError(f"expected approach > 0 and 0 < lift <= retreat in m; found {self}")
        if not 0.0 <= self.min_probability <= 1.0:
            raise ValueError(f"min_probability: expected 0 to 1, found {self.min_probability}")


def grasps_for(
    localization: LocalizedObject,
    gripper: Gripper,
    scene: GraspScene,
    motion: Motion | None = None,
) -> GraspPlan:
    """Return the grasps of a found object, ranked by their probability of success.

    Every grasp of the model (`suggested_grasps` if it has none) is repeated by the model's symmetry
    and by half a turn of the gripper, moved to the object's pose by Eq. 20, and checked: reach,
    joint limits, singularity; collisions with the scene's obstacles; and the probability of success
    by `success_probability`. A grasp that fails a check is in `GraspPlan.refused` with its reasons.

    Collisions are checked on the straight lines from the pre-grasp to the retreat: for the gripper,
    for the held object's convex hull while it is lifted and, with `GraspScene.link_radius`, for the
    arm's links. Not checked are the motion from the last view to the pre-grasp, the links without
    that radius, the camera and anything else on the hand, and a held object that slips or turns
    between the fingers.

    Args:
        localization: the object, with its pose and covariance.
        scene: the robot and the obstacles, without the object itself.
        motion: lengths of approach, lift and retreat.

    Raises:
        ImportError: trimesh or python-fcl is not installed (smartview-jax[cell]).
        ValueError: an invalid pose or covariance, or a model without grasps and faces.
        NoSafeGraspError: the verdict of the localisation is not "accepted".

    For example:

        >>> box = sv.simulation.box(0.06, 0.04, 0.02).exact_model("box")
        >>> placed = sv.grasping.PlacedObject(box, np.eye(4))  # at the world's origin
        >>> plan = sv.grasps_for(placed, sv.Gripper(), sv.GraspScene(truth))
        >>> print(len(plan), "grasps,", f"{plan.best.success_probability:.0%}")
        12 grasps, 100%
    """
    motion = motion or Motion()
    # A pose that is only the best guess is never acted upon.
    if not getattr(localization, "accepted", True):
        raise NoSafeGraspError(f"no safe grasp: {getattr(localization, 'message', 'not accepted')}")
    pose, _ = checked_object(localization)
    middle = localization.model.vertices.mean(axis=0)
    candidates = candidate_grasps(localization.model, gripper)
    # A grasp near the object's middle keeps it from turning; wide openings tolerate larger errors.
    candidates.sort(key=lambda c: (_offset(c, middle), -c.opening))
    drafts = _without_collisions(candidates, localization, pose, gripper, scene, motion)
    promising = [pair for pair in zip(drafts, candidates, strict=True) if pair[0].is_safe]
    refused = [draft for draft in drafts if not draft.is_safe]
    safe: list[PlannedGrasp] = []
    # The motions are computed in lots, up to the first lot with a safe grasp.
    for start in range(0, len(promising), GRASPS_AT_ONCE):
        if safe:
            break
        lot = promising[start : start + GRASPS_AT_ONCE]
        for grasp in _with_motions(lot, localization, gripper, scene, motion):
            (safe if grasp.is_safe else refused).append(grasp)
    # In whole per cent: equally likely grasps are ordered by clearance.
    safe.sort(key=lambda grasp: (-round(grasp.success_probability, 2), -grasp.clearance))
    return GraspPlan(tuple(safe), tuple(refused), localization.model.name)


def _offset(candidate: Candidate, middle: Float[np.ndarray, "3"]) -> float:
    """Return the distance of the fingertips from the object's middle, m, rounded to 1 mm."""
    return round(float(np.linalg.norm(candidate.object_from_gripper[:3, 3] - middle)), 3)


def _without_collisions(
    candidates: Sequence[Candidate],
    localization: LocalizedObject,
    world_from_object: Float[np.ndarray, "4 4"],
    gripper: Gripper,
    scene: GraspScene,
    motion: Motion,
) -> list[PlannedGrasp]:
    """Return the candidates as grasps without commands, refused where the gripper would collide."""
    around = CollisionChecker(scene.obstacles)
    # The object itself may be hit by the open fingers.
    faces = [Obstacle.of_object(localization)] if localization.model.faces else []
    itself = CollisionChecker([obstacle._replace(name="the object itself") for obstacle in faces])
    # However it is held, it is lifted straight up.
    held = _contact_of_held(localization, world_from_object, around, scene, motion)
    drafts = []
    for candidate in candidates:
        # Eq. 20 in the world: world_from_object @ object_from_gripper.
        grasp_pose = world_from_object @ candidate.object_from_gripper
        back, up = -motion.approach * grasp_pose[:3, 2], scene.up_direction
        poses = np.tile(grasp_pose, (len(PHASES), 1, 1))
        poses[0, :3, 3] += back
        poses[2, :3, 3] += motion.lift * up
        poses[3, :3, 3] += motion.retreat * up
        reasons, clearance = [], np.inf
        # Each finger needs the gripper's tolerance as clearance from the object.
        if candidate.opening - candidate.width <= 2.0 * gripper.tolerance:
            reasons.append(
                f"it is {1e3 * candidate.width:.3g} mm wide there, too wide for the gripper"
            )
        else:
            approach = swept_gripper(gripper, candidate.opening, grasp_pose, back)
            # During the lift the fingers are closed on the object.
            leaving = swept_gripper(gripper, candidate.width, grasp_pose, motion.retreat * up)
            closing = closing_fingers(gripper, candidate.opening, candidate.width, grasp_pose)
            # The first reason against the grasp is enough.
            ways = (around.nearest(parts) for parts in (approach, closing, leaving))
            for contact in filter(None, ways):
                clearance = min(clearance, contact.clearance)
                if contact.clearance < scene.margin:
                    reasons.append(str(contact))
                    break
            touched = itself.nearest(approach)
            if touched is not None and touched.clearance <= 0.0:
                reasons.append(str(touched))
            if held is not None:
                reasons.append(str(held))
        drafts.append(
            PlannedGrasp(
                candidate.grasp,
                poses,
                np.full((len(PHASES), 4, 4), np.nan),
                None,
                candidate.opening,
                candidate.width,
                float("nan"),
                {},
                clearance,
                tuple(reasons),
            )
        )
    return drafts


def _contact_of_held(
    localization: LocalizedObject,
    world_from_object: Float[np.ndarray, "4 4"],
    around: CollisionChecker,
    scene: GraspScene,
    motion: Motion,
) -> Contact | None:
    """Return what an object touches while it is lifted; None for nothing."""
    vertices = host_transformed(world_from_object, localization.model.vertices)
    swept = swept_object(vertices, motion.retreat * scene.up_direction)
    contact = around.nearest(swept)
    return contact if contact is not None and contact.clearance <= 0.0 else None


def _with_motions(
    lot: Sequence[tuple[PlannedGrasp, Candidate]],
    localization: LocalizedObject,
    gripper: Gripper,
    scene: GraspScene,
    motion: Motion,
) -> list[PlannedGrasp]:
    """Return grasps with their commands and probabilities, refused where the arm cannot move."""
    # All grasps of the lot at once: programs are compiled for a fixed size.
    motions = plan_motions(scene, gripper, np.stack([draft.world_from_gripper for draft, _ in lot]))
    errors = _errors_of_reached(motions, gripper, scene)
    finished = []
    for k, (draft, candidate) in enumerate(lot):
        reasons, probability, risks = motions.reasons[k], float("nan"), {}
        if not reasons:
            covariance = error_covariance(
                localization, np.linalg.inv(candidate.object_from_gripper), errors[k]
            )
            conditions = grasp_conditions(candidate, gripper, draft.clearance)
            probability, risks = success_probability(conditions, covariance)
            if probability < motion.min_probability:
                # The condition that fails most often tells what to improve.
                worst = max(risks, key=lambda name: risks[name])
                reasons = (
                    f"less than {motion.min_probability:.0%} chance of success; the greatest risk: "
                    f"{worst}",
                )
        finished.append(
            dataclasses.replace(
                draft,
                base_from_tool=motions.base_from_tool[k],
                joints=None if motions.joints is None else motions.joints[k],
                success_probability=probability,
                risks=risks,
                reasons=reasons,
            )
        )
    return finished


def _errors_of_reached(
    motions: Motions, gripper: Gripper, scene: GraspScene
) -> dict[int, GripperErrors]:
    """Return the uncertainty of the gripper's pose for each grasp that the arm can execute."""
    reached = [k for k, texts in enumerate(motions.reasons) if not texts]
    if not reached:
        return {}
    # Padded with the last one, so that one program serves any number.
    padded = [*reached, *[reached[-1]] * (GRASPS_AT_ONCE - len(reached))]
    at = PHASES.index("grasp")
    command = Command(
        host_transforms(motions.base_from_tool[padded, at]),
        None if motions.joints is None else to_device(motions.joints[padded, at]),
    )
    return dict(zip(reached, gripper_errors(scene, gripper, command), strict=False))
