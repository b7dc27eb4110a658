"""Which PSFs an eye needs: the nodes for a stated error, what they cost in all."""
