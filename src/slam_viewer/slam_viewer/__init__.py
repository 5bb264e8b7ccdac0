# SPDX-License-Identifier: Apache-2.0
"""Results of a run: their files and figures, and the page that shows them in the browser."""
