# SPDX-License-Identifier: Apache-2.0
"""What a run shows: its results, their files and figures, and the page in the browser."""
