# SPDX-License-Identifier: Apache-2.0
"""What is simulated: buildings, furniture, materials, light."""
