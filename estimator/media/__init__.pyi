from .straylight import Straylight as Straylight
from .straylight import channel_gains as channel_gains
from .straylight import cie_glare_per_sr as cie_glare_per_sr
from .straylight import media_density as media_density
