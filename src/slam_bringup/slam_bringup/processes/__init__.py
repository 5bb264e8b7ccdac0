"""The nodes as processes: which ones, with which parameters, started, watched and ended."""
