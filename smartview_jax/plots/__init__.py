"""Draw what notebooks and reports show: errors, cameras, uncertainty, objects, the method."""

from .camera_scene import CameraScene as CameraScene
from .camera_scene import camera_scene as camera_scene
from .diagrams import frames_diagram as frames_diagram
from .diagrams import steps_diagram as steps_diagram
from .errors import error_by_views as error_by_views
from .errors import error_histogram as error_histogram
from .errors import pose_errors as pose_errors
from .errors import residual_vectors as residual_vectors
from .errors import view_errors as view_errors
from .errors import view_influence as view_influence
from .figures import PlotFigure as PlotFigure
from .interactive import InteractiveScene as InteractiveScene
from .interactive import interactive_cameras as interactive_cameras
from .object_pictures import cropped as cropped
from .object_pictures import edge_map as edge_map
from .object_pictures import object_model_3d as object_model_3d
from .object_pictures import with_wireframes as with_wireframes
from .rigs import camera_mounts as camera_mounts
from .rigs import pose_uncertainties as pose_uncertainties
from .uncertainty import parameter_intervals as parameter_intervals
from .uncertainty import picture_uncertainty as picture_uncertainty
from .uncertainty import workspace_uncertainty as workspace_uncertainty
from .views import camera_poses_3d as camera_poses_3d
from .views import prediction_overlay as prediction_overlay
