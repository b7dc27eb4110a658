from .progressive import ProgressiveLens as ProgressiveLens
from .rings import DiffractiveRings as DiffractiveRings
from .rings import Lenslets as Lenslets
from .rings import RefractiveZones as RefractiveZones
from .worn_lens import WornLens as WornLens
