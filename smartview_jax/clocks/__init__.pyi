from .time_offset import TimeOffset as TimeOffset
from .time_offset import at_time_offset as at_time_offset
from .time_offset import estimate_time_offset as estimate_time_offset
