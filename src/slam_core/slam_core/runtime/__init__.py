# SPDX-License-Identifier: Apache-2.0
"""Memory, threads and compiled kernels of a process."""
