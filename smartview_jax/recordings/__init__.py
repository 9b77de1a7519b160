"""Turn a recording (a bag of ROS, a data set of LeRobot) into a data-set folder."""

from .bag import Bag as Bag
from .bag import open_bag as open_bag
from .bag_content import BagSources as BagSources
from .import_bag import import_bag as import_bag
from .import_lerobot import LeRobotSources as LeRobotSources
from .import_lerobot import import_lerobot as import_lerobot
from .imported_folder import ImportedFolder as ImportedFolder
from .lerobot_dataset import INFO_FILE as INFO_FILE
from .moments import MomentChoice as MomentChoice
from .picture_messages import PictureFile as PictureFile
from .picture_messages import picture_file as picture_file
from .transform_tree import TransformTree as TransformTree
