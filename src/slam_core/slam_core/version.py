# SPDX-License-Identifier: Apache-2.0
"""The version of the packages, see their package.xml."""

VERSION = "0.2.0"
