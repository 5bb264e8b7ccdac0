# SPDX-License-Identifier: Apache-2.0
"""Submaps for thin radio links: a few kilobytes each, with a covariance that is never too small."""
