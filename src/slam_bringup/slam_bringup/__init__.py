# SPDX-License-Identifier: Apache-2.0
"""Launch files, configuration, the offline pipeline, bag tools and the slam command line."""
