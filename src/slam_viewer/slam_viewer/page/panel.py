# SPDX-License-Identifier: Apache-2.0
"""Texts of the page's panel as HTML.

Names, states and reasons come from messages and files: all of them are escaped.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import jinja2

Colour = tuple[int, int, int]

_ENVIRONMENT = jinja2.Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
_STATE_COLOURS = {"OK": "#2a9d3a", "DEGRADED": "#d98e04", "LOST": "#d62728"}

_HEADLINE = _ENVIRONMENT.from_string(
    "<div style='margin:.6em 1em;overflow-wrap:anywhere'><b style='font-size:1.1em'>{{ title }}</b>"
    "{% for line in lines %}<br><span style='font-size:.9em'>{{ line }}</span>{% endfor %}</div>"
)
_AGENTS = _ENVIRONMENT.from_string(
    "{% for row, colour, state_colour in rows %}<div style='margin:.35em 1em;overflow-wrap:anywhere'>"
    "<span style='color:rgb{{ colour }};font-size:1.4em'>&#9679;</span> {{ row.name or 'rig' }}: "
    "<b style='color:{{ state_colour }}'>{{ row.state }}</b>"
    "{% for line in (row.note, row.link) if line %}<br><span style='opacity:.75;font-size:.85em'>{{ line }}</span>"
    "{% endfor %}{% if row.warning %}<br><b style='color:#d98e04;font-size:.85em'>{{ row.warning }}</b>{% endif %}"
    "</div>{% endfor %}"
)
_WAYS = _ENVIRONMENT.from_string(
    "<div style='margin:.6em 1em;font-size:.9em;overflow-wrap:anywhere'>{% if ways %}<b>Way back out</b>"
    "{% for name, text in ways %}<br>{{ name or 'rig' }}: {{ text }}{% endfor %}{% endif %}"
    "{% if note %}<div style='margin-top:.4em'>{{ note }}</div>{% endif %}</div>"
)
_LEGEND = _ENVIRONMENT.from_string(
    "<div style='margin:.6em 1em;font-size:.85em'>{% for colour, text in entries %}"
    "<div><span style='color:rgb{{ colour }}'>&#9679;</span> {{ text }}</div>{% endfor %}</div>"
)


@dataclass(frozen=True)
class AgentRow:
    """Row of an agent in the overview: ``state`` OK, DEGRADED or LOST, or since when it is silent.

    ``link``: the radio link to it; ``warning``: what the leader must not miss. Both may be empty.
    """

    name: str
    state: str
    note: str = ""
    link: str = ""
    warning: str = ""


def headline(title: str, lines: Sequence[str]) -> str:
    """A title and lines below it."""
    return _HEADLINE.render(title=title, lines=lines)


def agent_table(rows: Sequence[AgentRow], colours: Sequence[Colour]) -> str:
    """One line for each agent, with its colour and state."""
    return _AGENTS.render(
        rows=[
            (row, colours[k % len(colours)], _STATE_COLOURS.get(row.state.split(" ")[0], "#777"))
            for k, row in enumerate(rows)
        ]
    )


def ways_text(ways: Sequence[tuple[str, str]], note: str = "") -> str:
    """Name and way out of each agent, and a note below."""
    return _WAYS.render(ways=ways, note=note)


def legend(entries: Sequence[tuple[Colour, str]]) -> str:
    """Colours and what is drawn in them."""
    return _LEGEND.render(entries=entries)
