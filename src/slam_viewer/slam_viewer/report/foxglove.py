# SPDX-License-Identifier: Apache-2.0
"""A Foxglove layout that shows ``result.mcap`` at once: import it by "Layouts > Import from file".

Only topics that the bag has are named. The settings are those that Foxglove documents for its panels 3D, Image and
Plot (docs.foxglove.dev/docs/visualization/panels), under the names that its own SDK gives them (foxglove.layouts of
foxglove-sdk 0.30); a panel's title is ``foxglovePanelTitle`` in a layout that the app exports and imports.
"""

from __future__ import annotations

import json
from collections.abc import Collection
from pathlib import Path
from typing import Any

from slam_bags.storage.bag import BagReader
from slam_core.storage.files import atomic_text

COLOURS = ("#d62728ff", "#1f77b4ff", "#2ca02cff", "#9467bdff", "#ff7f0eff", "#17becfff")
_TRUTH = "#888888ff"
_LANDMARKS = "#e69f00ff"
_HIDDEN = ("map/ellipsoids", "map/landmarks", "map/cloud", "features")
"""Topics of the 3D panel that are offered, and switched on by whoever wants them."""


def write_layout(path: Path, bag: Path) -> None:
    """Write the layout for a result bag."""
    with BagReader(bag) as reader:
        topics = list(reader.topics)
    atomic_text(path, json.dumps(layout(topics), indent=1) + "\n")


def layout(topics: Collection[str]) -> dict[str, Any]:
    """The layout for a bag with these topics: the map, pictures of up to three agents, and standard deviations."""
    agents = sorted(t.removesuffix("/map/path") for t in topics if t.endswith("/map/path"))
    pictures = [t for a in agents if (t := f"{a}/features/image/compressed") in topics][:3]
    panels: dict[str, Any] = {"3D!map": _scene(topics, agents)}
    panels |= {f"Image!{i}": _image(topic, topics) for i, topic in enumerate(pictures)}
    panels["Plot!sigma"] = _plot("position: standard deviation [m]", agents, topics)
    beside = [*(f"Image!{i}" for i in range(len(pictures))), "Plot!sigma"]
    return {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": {"direction": "row", "first": "3D!map", "second": _column(beside), "splitPercentage": 66},
    }


def _scene(topics: Collection[str], agents: list[str]) -> dict[str, Any]:
    shown = {
        "map/dense_cloud": {"colorMode": "rgb", "colorField": "rgb", "pointSize": 2},
        "map/occupancy": {"colorMode": "map", "alpha": 0.6},
        "map/landmarks": {"colorMode": "flat", "flatColor": _LANDMARKS, "pointSize": 4},
        "map/cloud": {"colorMode": "flat", "flatColor": _LANDMARKS, "pointSize": 4},
        "map/graph": {},
        "map/marks": {},
        "map/ellipsoids": {},
    }
    settings = {f"/{name}": {"visible": name not in _HIDDEN, **how} for name, how in shown.items()}
    for agent, colour in zip(agents, COLOURS * len(agents), strict=False):
        line = {"visible": True, "type": "line", "lineWidth": 0.04}
        settings[f"{agent}/map/path"] = {**line, "gradient": [colour, colour]}
        settings[f"{agent}/ground_truth/path"] = {**line, "lineWidth": 0.02, "gradient": [_TRUTH, _TRUTH]}
        settings[f"{agent}/pose"] = {"visible": True, "type": "arrow", "showCovariance": True, "color": colour}
        depth = {"colorMode": "colormap", "colorMap": "turbo", "colorField": "depth"}
        settings[f"{agent}/features"] = {"visible": False, **depth}
    return {
        "foxglovePanelTitle": "map", "followMode": "follow-none", "followTf": "map",
        "cameraState": {"perspective": True, "distance": 18, "phi": 45, "thetaOffset": 30, "targetOffset": [0, 0, 0],
                        "target": [0, 0, 0], "targetOrientation": [0, 0, 0, 1], "fovy": 45, "near": 0.1, "far": 5000},
        "scene": {"transforms": {"axisScale": 0.5}}, "transforms": {},
        "topics": {topic: how for topic, how in settings.items() if topic in topics},
    }  # fmt: skip


def _image(topic: str, topics: Collection[str]) -> dict[str, Any]:
    calibration = topic.removesuffix("image/compressed") + "camera_info"
    title = topic.removesuffix("/features/image/compressed").strip("/") or "left camera"
    return {
        "foxglovePanelTitle": title,
        "imageMode": {"imageTopic": topic, **({"calibrationTopic": calibration} if calibration in topics else {})},
    }


def _plot(title: str, agents: list[str], topics: Collection[str]) -> dict[str, Any]:
    """Standard deviations of x and y, from the diagonal of the covariance of ``pose``."""
    paths = [
        {
            "value": f"{agent}/pose.pose.covariance[{index}].@sqrt",
            "label": f"{agent.strip('/')} {axis}".strip(),
            "enabled": True,
            "timestampMethod": "receiveTime",
        }
        for agent in agents
        if f"{agent}/pose" in topics
        for axis, index in (("x", 0), ("y", 7))
    ]
    return {"foxglovePanelTitle": title, "paths": paths, "showLegend": True, "isSynced": True, "xAxisVal": "timestamp"}


def _column(panels: list[str]) -> Any:
    """Panels one above the other, all of one height."""
    first, *rest = panels
    if not rest:
        return first
    return {
        "direction": "column",
        "first": first,
        "second": _column(rest),
        "splitPercentage": round(100 / len(panels), 1),
    }
