# SPDX-License-Identifier: Apache-2.0
"""The thesis's experiments, each run by ``slam experiment NAME`` and shown beside the thesis's own figures."""
