# SPDX-License-Identifier: Apache-2.0
"""A web page, served by viser, that shows a finished run or the nodes at work."""
