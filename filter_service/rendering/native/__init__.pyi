from .renderer import NativeRenderer as NativeRenderer
