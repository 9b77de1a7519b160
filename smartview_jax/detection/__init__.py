"""Detect calibration targets in pictures with OpenCV, and order and correct the detected points."""

from .circle_centres import circle_radii as circle_radii
from .circle_centres import correct_circle_centres as correct_circle_centres
from .circle_centres import predicted_bias as predicted_bias
from .detect import detect as detect
from .detect import detection_identity as detection_identity
from .detection import Detection as Detection
from .detection import empty_detection as empty_detection
from .markers import charuco_board as charuco_board
from .markers import dictionary_by_name as dictionary_by_name
from .ordering import PointOrdering as PointOrdering
from .ordering import consistent_ordering as consistent_ordering
from .picture_files import Picture as Picture
from .picture_files import content_hash as content_hash
from .picture_files import decode_picture as decode_picture
from .picture_files import picture_bytes as picture_bytes
from .picture_files import read_picture as read_picture
from .plausibility import DetectionLimits as DetectionLimits
from .plausibility import PointTest as PointTest
from .plausibility import check_points as check_points
from .plausibility import checked_pixels as checked_pixels
from .plausibility import left_out_note as left_out_note
from .shown_instead import shown_instead as shown_instead
