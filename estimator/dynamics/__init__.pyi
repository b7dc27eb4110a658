from .gaze import Gaze as Gaze
from .gaze import GazeFollower as GazeFollower
from .responses import AccommodationResponse as AccommodationResponse
from .responses import DelayedApproach as DelayedApproach
from .responses import PupilReflex as PupilReflex
from .responses import steady_pupil_mm as steady_pupil_mm
