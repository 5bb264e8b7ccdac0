# SPDX-License-Identifier: Apache-2.0
"""One thread that maps, extends or localises, what it saves meanwhile, and the order of submaps."""
