# SPDX-License-Identifier: Apache-2.0
"""The surface from depth images: a truncated signed distance field, its mesh, and the files of both."""
