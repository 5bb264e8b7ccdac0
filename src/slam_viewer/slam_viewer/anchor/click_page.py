# SPDX-License-Identifier: Apache-2.0
"""The page on which a user clicks the same points in the map and on the plan: one file, without a server."""

from __future__ import annotations

import base64
from importlib import resources

import cv2
import jinja2

from slam_core.types import ByteArray
from slam_viewer.anchor.building_plan import BuildingPlan
from slam_viewer.anchor.map_from_above import MapPicture

GENERATOR = '<meta name="generator" content="slam anchor">'
"""Mark of a page of ours, in its head."""


def click_page(title: str, command: str, picture: MapPicture, plan: BuildingPlan) -> str:
    """The page; ``command`` is what the pairs are put behind."""
    template = jinja2.Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True).from_string(
        resources.files("slam_viewer").joinpath("anchor/click_page.html.j2").read_text(encoding="utf-8")
    )
    return template.render(
        title=title, command=command, map_image=_embedded(picture.image), plan_image=_embedded(plan.image),
        map_of_pixel=picture.map_of_pixel().tolist(), is_resolution_known=plan.resolution is not None,
    )  # fmt: skip


def _embedded(image: ByteArray) -> str:
    done, png = cv2.imencode(".png", image)
    if not done:
        raise ValueError("an image could not be packed as PNG")
    return "data:image/png;base64," + base64.b64encode(png.tobytes()).decode("ascii")
