from .grid import GridSpec as GridSpec
from .nodes import CachePlan as CachePlan
from .plan import PlanTooLarge as PlanTooLarge
from .plan import plan_cache as plan_cache
