# SPDX-License-Identifier: Apache-2.0
"""The commands that this package registers at ``slam``; each module holds a ``command`` (click)."""
