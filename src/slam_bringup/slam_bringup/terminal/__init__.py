# SPDX-License-Identifier: Apache-2.0
"""Parts that commands share: output on the terminal, paths that users give, options of a run, and its end."""
