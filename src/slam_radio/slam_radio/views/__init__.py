# SPDX-License-Identifier: Apache-2.0
"""Pictures and dense key frames that an agent keeps, and sends when a post asks for them."""
