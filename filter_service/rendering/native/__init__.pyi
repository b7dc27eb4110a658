from .renderer import FrameOperator as FrameOperator
from .renderer import NativeRenderer as NativeRenderer
