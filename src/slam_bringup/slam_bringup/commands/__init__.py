"""One module per ``slam`` command; each holds a ``command`` (click). Loaded only when called, see ``cli``."""
