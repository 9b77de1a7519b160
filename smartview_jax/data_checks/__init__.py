"""Check data before and between the steps of a calibration, and name what is wrong with them.

`questions.py` says in which order: the poses (`usable_views.py`), the detections
(`target_checks.py`), the camera by itself (`camera_checks.py`), then whether robot and camera move
alike (`conventions.py`, with the usual mistakes in `mistakes.py`, `misread_angles.py`,
`length_units.py` and `joint_mistakes.py`, judged by `rotation_angles.py` and by the closure of
motions, `closure.py`; `pairing.py` tells inaccurate poses from wrong ones) and tell a wrong mount
at all (`inverted_poses.py`), whether the arm is another (`other_arm.py`) or a joint turns by
another angle than reported (`joint_ratios.py`), whether the set-up changed between two views
(`changes.py`) or drifts (`set_up_drift.py`, beyond the errors of `smooth_errors.py`), the poses lag
(`pose_lag.py`, by the fit in `lag_fit.py`), the views agree in groups (`view_groups.py`) or the
focus changes (`focus_changes.py`; `faults_of_many_views.py` asks all five; positions alone are
linear, `position_equations.py`), whether pictures of some views were resized
(`resized_pictures.py`), turned or mirrored (`picture_turns.py`), whether the target bends
(`flexible_target.py`), and which single views are numbered wrongly (`shifted_numbering.py`) or
contradict the others (`view_consistency.py`). All judge by transforms of their own
(`transform_fit.py`), some by transforms of the views that agree (`largest_group.py`) or by the odds
of an explanation (`misfit_evidence.py`). `rig_checks.py` compares the cameras of a rig by what
`rig_states.py` holds, and asks whether pictures were exchanged (`exchanged_cameras.py`).
"""

import lazy_loader as _lazy_loader

# `__init__.pyi` lists the names and their modules.
__getattr__, __dir__, __all__ = _lazy_loader.attach_stub(__name__, __file__)
