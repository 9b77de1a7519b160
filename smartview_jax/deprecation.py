"""Old names that keep working, with a warning, for one more release.

Each old name is stored with the path of what replaces it, as text. The new place is imported only
when somebody asks for the old name, so that a package can refer to one above it without a circular
import; nothing in the library itself uses an old name (`tests/test_deprecation.py`).
"""

import importlib
import warnings
from collections.abc import Callable
from typing import Any

_ROOT = __name__.rpartition(".")[0]

NEW_PATHS: dict[str, dict[str, str]] = {
    "cameras": {
        "start_lens": "cameras.initial_lens",
    },
    "evaluation": {
        "Bound": "evaluation.CramerRaoBound",
        "Deviations": "evaluation.ReprojectionErrors",
        "Explanation": "evaluation.ScaleHypothesis",
        "Foretold": "evaluation.PredictedError",
        "HeldOut": "evaluation.HeldOutErrors",
        "Refit": "evaluation.FoldFit",
        "Repeatability": "evaluation.SplitHalfDifference",
        "Unseen": "evaluation.HeldOutReport",
        "covered": "evaluation.within_interval",
        "deviations": "evaluation.reprojection_errors",
        "explanations": "evaluation.scale_hypotheses",
        "foretold": "evaluation.predicted_error",
        "free_pose_deviations": "evaluation.free_pose_errors",
        "predicted_deviations": "evaluation.expected_reprojection_errors",
        "refit": "evaluation.fit_folds",
        "region_error": "evaluation.region_held_out_rms",
        "repeatability": "evaluation.split_half_difference",
        "stylus_miss": "evaluation.stylus_error",
        "touching": "evaluation.touching_pose",
        "unseen_errors": "evaluation.held_out_reports",
        "without_correction": "evaluation.choose_uncorrected",
    },
    "geometry": {
        "direction_of": "geometry.viewing_direction",
        "exp_jacobian": "geometry.se3_left_jacobian",
    },
    "io": {
        "from_pictures": "io.dataset_from_pictures",
        "import_pairs": "io.import_correspondences",
        "write_folder": "io.write_dataset_folder",
    },
    "joint": {
        "AbstractLoss": "engine.AbstractLoss",
        "Alternative": "variance.CandidateResult",
        "CalibrationFit": "calibration_pipeline.CalibrationFit",
        "Cauchy": "engine.Cauchy",
        "GemanMcClure": "engine.GemanMcClure",
        "Huber": "engine.Huber",
        "JointProblem": "engine.JointProblem",
        "KinematicFit": "arm_identification.KinematicFit",
        "Noise": "engine.Noise",
        "NoiseEstimate": "variance.NoiseEstimate",
        "Observability": "engine.Observability",
        "Prior": "engine.Prior",
        "StructuredLM": "engine.StructuredLM",
        "StudentT": "engine.StudentT",
        "batch_filter": "joint.batch_least_squares",
        "best_uncorrected": "calibration_pipeline.refit_uncorrected",
        "build_problem": "engine.build_problem",
        "calibrate": "calibration_pipeline.calibrate",
        "estimate_noise": "variance.estimate_noise",
        "fit_kinematics": "arm_identification.fit_kinematics",
        "optimum": "engine.optimum",
        "parameter_names": "engine.parameter_names",
    },
    "report": {
        "Summary": "report.ErrorSummary",
        "compared": "report.comparison_row",
        "explanation_rows": "report.scale_hypothesis_rows",
        "halves_agree": "report.repeatability_rows",
        "plots": "plots",
        "summaries": "report.error_summaries",
        "verdict": "report.result_summary",
    },
    "robot_errors": {
        "ImpliedArm": "robot_errors.GenericSixAxisArm",
        "PoseOrStretch": "robot_errors.LinearInPoseWithScales",
        "Stretched": "robot_errors.ScaleError",
        "arm_of": "robot_errors.nominal_arm",
    },
    "robots": {
        "AbstractField": "robot_errors.AbstractField",
        "AbstractLinearField": "robot_errors.AbstractLinearField",
        "CombinedField": "robot_errors.CombinedField",
        "DHErrors": "robot_errors.DHErrors",
        "ImpliedArm": "robot_errors.GenericSixAxisArm",
        "JointOffsets": "robot_errors.JointOffsets",
        "JointRatios": "robot_errors.JointRatios",
        "LinearInPose": "robot_errors.LinearInPose",
        "LinearInPosition": "robot_errors.LinearInPosition",
        "PoseOrStretch": "robot_errors.LinearInPoseWithScales",
        "RobotError": "robot_errors.RobotError",
        "RobotPrior": "robot_errors.RobotPrior",
        "Status": "robots.SolutionStatus",
        "Stretched": "robot_errors.ScaleError",
        "arm_of": "robot_errors.nominal_arm",
        "by_numbers": "robots.dh_jacobian",
        "field_by_name": "robot_errors.field_by_name",
        "field_name": "robot_errors.field_name",
        "joints_near": "robots.solve_joints_iteratively",
        "robot_error_from_dict": "robot_errors.robot_error_from_dict",
        "robot_error_to_dict": "robot_errors.robot_error_to_dict",
    },
    "simulation": {
        "look_at": "simulation.look_at_from_above",
        "paper_photographs": "simulation.paper_rendered_scene",
        "paper_unseen": "simulation.paper_held_out",
        "photograph": "simulation.rendered_scene",
        "views_around": "simulation.random_viewpoints",
    },
    "staged": {
        "Agreement": "staged.ViewConsistency",
        "Explanation": "staged.ConventionHypothesis",
        "FitCode": "fit_result.FitCode",
        "FitResult": "fit_result.FitResult",
        "agreeing_views": "staged.find_consistent_views",
        "locate_views": "staged.estimate_view_poses",
        "median_deviation": "staged.median_reprojection_errors",
    },
    "targets": {
        "grid_rotations": "targets.grid_symmetries",
    },
    "variance": {
        "Alternative": "variance.CandidateResult",
    },
    "viewpoints": {
        "Goal": "viewpoints.OptimalityCriterion",
        "Survey": "viewpoints.InformationModel",
        "Table": "viewpoints.ClearancePlane",
        "curve": "viewpoints.cumulative_criterion",
        "direction_of": "viewpoints.viewing_direction",
        "everything": "viewpoints.d_optimal",
        "hand_eye": "viewpoints.a_optimal",
        "held_out": "viewpoints.i_optimal",
    },
}
"""Path below this package of what replaces an old name, by package and old name."""


def deprecated_names(package: str) -> Callable[[str], Any]:
    """Return the module-level `__getattr__` of a package with old names.

    Args:
        package: full name of the package, as in `__name__`.
    """
    new_paths = NEW_PATHS[package.removeprefix(f"{_ROOT}.")]

    def resolve(name: str) -> Any:
        """Import what replaces an old name, with a deprecation warning."""
        if name not in new_paths:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        module, _, new_name = f"{_ROOT}.{new_paths[name]}".rpartition(".")
        warn_deprecated(f"{package}.{name}", f"{module}.{new_name}")
        return getattr(importlib.import_module(module), new_name)

    return resolve


class DeprecatedAttribute:
    """The old name of an attribute or method of a class, for reading only.

    Both names are given, because a `NamedTuple` does not tell a descriptor its own.

    Attributes:
        old_name: name under which this stands in the class.
        new_name: name of the attribute that replaces it.
    """

    def __init__(self, old_name: str, new_name: str) -> None:
        self.old_name: str = old_name
        self.new_name: str = new_name

    def __get__(self, instance: Any, owner: type) -> Any:
        """Return the attribute that replaces this one, with a deprecation warning."""
        if instance is None:
            return self
        warn_deprecated(f"{owner.__name__}.{self.old_name}", f"{owner.__name__}.{self.new_name}")
        return getattr(instance, self.new_name)


def warn_deprecated(old: str, new: str, stacklevel: int = 3) -> None:
    """Warn that an old name or value will go.

    Args:
        old: the old name.
        new: what replaces it.
        stacklevel: number of calls up to the user's; 3 is the caller of this function's caller.
    """
    warnings.warn(
        f"{old} is now {new}; the next release drops the old one",
        DeprecationWarning,
        stacklevel=stacklevel,
    )
