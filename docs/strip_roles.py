# SPDX-License-Identifier: Apache-2.0
"""MkDocs hook: docstrings name code by Sphinx roles (``:class:`Name```), which Markdown shows as they are."""

import re
from typing import Any

_ROLE = re.compile(r":(mod|class|meth|func|data|attr):(?=<code>)")


def on_page_content(html: str, **_: Any) -> str:
    """The page without the words of roles before code."""
    return _ROLE.sub("", html)
