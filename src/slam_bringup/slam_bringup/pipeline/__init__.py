"""The offline chain: the same classes as the nodes, called frame by frame."""
