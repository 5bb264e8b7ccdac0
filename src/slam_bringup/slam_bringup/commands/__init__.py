# SPDX-License-Identifier: Apache-2.0
"""One module per ``slam`` command; each holds a ``command`` (click). Loaded only when called, see ``cli``."""
