from .accommodation_response import AccommodationResponse as AccommodationResponse
from .delayed_approach import DelayedApproach as DelayedApproach
from .gaze import Gaze as Gaze
from .gaze import GazeFollower as GazeFollower
from .pupil_reflex import PupilReflex as PupilReflex
from .pupil_size import steady_pupil_mm as steady_pupil_mm
