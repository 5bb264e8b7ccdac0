# SPDX-License-Identifier: Apache-2.0
"""Boards for trying a calibration where the truth is known: their pictures, and corners that cameras see."""
