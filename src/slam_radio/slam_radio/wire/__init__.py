# SPDX-License-Identifier: Apache-2.0
"""Messages on the air, byte by byte."""
