from .absorption import channel_gains as channel_gains
from .absorption import media_density as media_density
from .straylight import Straylight as Straylight
from .straylight import cie_glare_per_sr as cie_glare_per_sr
