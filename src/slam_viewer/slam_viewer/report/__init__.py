# SPDX-License-Identifier: Apache-2.0
"""Output of a run: files, figures, page, table and result bag."""
