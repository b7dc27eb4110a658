from .change import PeripheralChange as PeripheralChange
from .change import peripheral_change as peripheral_change
from .population import Population as Population
