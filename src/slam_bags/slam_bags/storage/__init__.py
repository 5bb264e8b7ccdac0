# SPDX-License-Identifier: Apache-2.0
"""Bag files: messages in and out, their types, their owner, and what lies beside them."""
