# SPDX-License-Identifier: Apache-2.0
"""The viewer: a web page, served by viser, that shows a finished run or the nodes at work."""
