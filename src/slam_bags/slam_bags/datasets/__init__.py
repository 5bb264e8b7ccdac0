# SPDX-License-Identifier: Apache-2.0
"""Public data sets as streams of readings, one module per layout; ``slam convert`` writes them to bags."""
