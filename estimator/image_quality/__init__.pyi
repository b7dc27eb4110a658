from .eye import Eye as Eye
from .labeled_array import LabeledArray as LabeledArray
