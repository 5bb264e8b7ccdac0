# SPDX-License-Identifier: Apache-2.0
"""What a run leaves behind: files, figures, page, table and result bag."""
