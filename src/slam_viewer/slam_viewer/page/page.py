# SPDX-License-Identifier: Apache-2.0
"""The page: named layers of one 3D scene, a panel with what is shown, and an overview of the agents.

Whoever has news calls ``show_...``; a layer that comes again is replaced. Nodes of the scene have numbers for names,
and what a message or a file says is shown as plain text. The page is viser's: it is served from this machine, asks no
other one, and works without a network.
"""

from __future__ import annotations

import contextlib
import io
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import trimesh
import viser

from dense_mapping.plans.floor_plan import FloorPlan
from dense_mapping.reconstruction.decimation import at_most
from dense_mapping.reconstruction.surface import Surface
from slam_core.estimation.chi_square import ELLIPSE_PROBABILITY, chi_square_bound
from slam_core.geometry import OPTICAL_FROM_RIG, FloatArray, quaternion_from_rotation
from slam_core.types import ByteArray, Float32Array
from slam_viewer.page.access import Access
from slam_viewer.page.panel import AgentRow, agent_table, headline, legend, ways_text
from slam_viewer.page.picture_of_plan import plan_picture

COLOURS = ((214, 39, 40), (31, 119, 180), (44, 160, 44), (148, 103, 189), (255, 127, 14), (23, 190, 207))
"""One for each agent, in their order."""

_BACKGROUND = (158, 167, 178)
"""Darker than what a lit mesh of white walls is."""
_LARGEST_ELLIPSOID_M = 1.5
"""An ellipsoid as large as a room says only that the landmark is far away, and hides the room."""
_MOST_ELLIPSOIDS = 4000
_MOST_FACES = 600_000
_CORNERS = 64
"""Of a disc."""
_LAYERS = (
    "mesh", "dense points", "floor plan", "trajectories", "ground truth", "landmarks", "ellipsoids", "submaps",
    "closures", "agents", "where agents may be", "frontiers", "ways out", "marks", "camera image",
)  # fmt: skip
_SUBMAPS, _CLOSURES, _UNSEEN, _MARKS, _LANDMARKS = (
    (25, 100, 255), (255, 190, 0), (255, 80, 200), (20, 190, 60), (230, 140, 0)
)  # fmt: skip
_LEGEND = (
    (_UNSEEN, "ball: a place where nobody has looked yet, the larger the wider"),
    (_CLOSURES, "line: a loop closure between two submaps"),
    (_MARKS, "ball: a marked place"),
    ((130, 130, 130), "thin line: the way walked; thick line on the floor: the way back out"),
    ((60, 60, 60), "dark line: ground truth, where there is some"),
    ((130, 130, 130), "disc: where an agent may be (99.5 %); in silence it grows as one walks"),
    (_SUBMAPS, "submaps (off at first, see Layers)"),
    (_LANDMARKS, "landmarks, green where many submaps have them (off at first)"),
)
_HIDDEN_AT_FIRST = ("dense points", "landmarks", "ellipsoids", "submaps")


class ViewerPage:
    """A running page.

    Parameters
    ----------
    port
        Where it is served; 0: any free port.
    host
        Address it listens on; the default is this machine alone, any other gives the page's address a token.
    title
        Above the panel, and of the page in the browser.

    Raises
    ------
    ValueError
        If the port is taken.
    """

    def __init__(self, port: int = 8080, host: str = "127.0.0.1", title: str = "Indoor SLAM") -> None:
        self.access = Access(host, title)
        with contextlib.redirect_stdout(io.StringIO()), self.access.guarding():
            self.server = viser.ViserServer(host=host, port=port, label=title, verbose=False)
        if port not in (0, self.server.get_port()):
            self.server.stop()
            raise ValueError(f"port {port} is taken: give another one with --port")
        self.port = self.server.get_port()
        self.server.gui.configure_theme(control_layout="fixed", show_logo=False, show_share_button=False)
        self.server.scene.set_up_direction("+z")
        self.server.scene.set_background_image(np.full((2, 2, 3), _BACKGROUND, dtype=np.uint8), format="png")
        self.server.gui.set_panel_label(title)
        self._plans: dict[int, viser.ImageHandle] = {}
        tabs = self.server.gui.add_tab_group()
        self.overview, self.layers, self.camera = (tabs.add_tab(name) for name in ("Overview", "Layers", "Image"))
        with self.overview:
            self._headline = self.server.gui.add_html("")
            self._agents = self.server.gui.add_html("")
            self._ways = self.server.gui.add_html("")
            self.server.gui.add_html(legend(_LEGEND))
        self._ticked: set[str] = set()
        self._roots: dict[str, viser.FrameHandle] = {}
        self._boxes: dict[str, viser.GuiCheckboxHandle] = {name: self._checkbox(name) for name in _LAYERS}
        self._picture: viser.GuiImageHandle | None = None

    @property
    def url(self) -> str:
        """Address of the page for a browser, with its token where it has one."""
        return self.access.url(self.port)

    def stop(self) -> None:
        """Close the page."""
        self.server.stop()

    def look_at(self, points: FloatArray) -> None:
        """Turn every view, those to come too, so that it shows most of the points (n, 3) from above and aside."""
        if not len(points):
            return
        low, high = np.percentile(points, [2, 98], axis=0)
        middle, size = (low + high) / 2, float(np.linalg.norm((high - low)[:2])) + 1.0
        cameras: list[Any] = [self.server.initial_camera, *(c.camera for c in self.server.get_clients().values())]
        for camera in cameras:
            camera.up = (0.0, 0.0, 1.0)
            camera.position = tuple(middle + size * np.array([-0.18, -0.45, 0.62]))
            camera.look_at = tuple(middle)

    # -- words ---------------------------------------------------------------------------------------------------------

    def show_headline(self, title: str, lines: Sequence[str] = ()) -> None:
        """A title and lines above the agents, as plain text."""
        self._headline.content = headline(title, lines)

    def show_agent_table(self, rows: Sequence[AgentRow]) -> None:
        """One line for each agent, with its colour and state."""
        self._agents.content = agent_table(rows, COLOURS)

    def show_ways_text(self, ways: Sequence[tuple[str, str]], note: str = "") -> None:
        """Name and way out of each agent, and a note below, as plain text."""
        self._ways.content = ways_text(ways, note)

    def show_picture(self, picture: ByteArray, caption: str = "") -> None:
        """A picture (h, w, 3) uint8, RGB, in the panel."""
        if self._picture is None:
            with self.camera:
                self._picture = self.server.gui.add_image(picture, label=caption, format="jpeg")
            return
        self._picture.image = picture
        self._picture.label = caption

    # -- layers --------------------------------------------------------------------------------------------------------

    def show_mesh(self, surface: Surface) -> None:
        """The dense model as a mesh, without faces seen from behind, so that one looks into rooms from outside."""
        if not len(surface.faces):
            return
        shown = at_most(surface, _MOST_FACES)
        mesh = trimesh.Trimesh(shown.points, shown.faces, vertex_colors=_brightened(shown.colours), process=False)
        self.server.scene.add_mesh_trimesh("/mesh/model", mesh, cast_shadow=False, receive_shadow=False)

    def show_points(self, points: Float32Array, colours: ByteArray | None = None) -> None:
        """The dense model as points (n, 3) m."""
        tint = (120, 130, 140) if colours is None else _brightened(colours)
        self.server.scene.add_point_cloud("/dense points/model", points, tint, point_size=0.02, precision="float32")

    def show_plan(self, plan: FloorPlan, number: int = 0) -> None:
        """A storey, laid a hand's breadth below its floor so that the floor's own noise does not flicker through."""
        rows, columns = plan.cells.shape
        width, height = columns * plan.resolution, rows * plan.resolution
        T = plan.T_map_plan
        centre = T[:3, :3] @ [width / 2, height / 2, -0.08] + T[:3, 3]
        turned = T[:3, :3] @ np.diag([1.0, -1.0, -1.0])  # viser's image lies with its rows downwards
        self._plans[number] = self.server.scene.add_image(
            f"/floor plan/{number}",
            plan_picture(plan),
            width,
            height,
            format="png",
            cast_shadow=False,
            receive_shadow=False,
            wxyz=_wxyz(turned),
            position=centre,
        )

    def show_storeys_up_to(self, highest: int) -> None:
        """Hide the floor plans of storeys above one, from 0: they would cover what goes on there."""
        for number, plan in self._plans.items():
            plan.visible = number <= highest

    def show_trajectory(self, index: int, poses: FloatArray, layer: str = "trajectories") -> None:
        """The way of an agent, poses (n, 4, 4)."""
        colour = (60, 60, 60) if layer == "ground truth" else COLOURS[index % len(COLOURS)]
        self._lines(f"/{layer}/{index}", _chain(poses[:, :3, 3]), colour, 0.03)

    def show_agent(self, agent: str, index: int, T_map_base: FloatArray) -> None:
        """Show an agent with its axes and name."""
        name, colour = f"/agents/{index}", COLOURS[index % len(COLOURS)]
        wxyz, position = _wxyz(T_map_base[:3, :3]), T_map_base[:3, 3]
        self.server.scene.add_frame(name, axes_length=0.35, axes_radius=0.018, wxyz=wxyz, position=position)
        self.server.scene.add_icosphere(f"{name}/body", radius=0.09, color=colour)
        self.server.scene.add_label(f"{name}/name", agent or "rig", position=(0, 0, 0.12), anchor="bottom-center")

    def show_reach(self, index: int, centre: FloatArray, radius: float) -> None:
        """The disc that an agent is in, about a point (3,) m of the map; a radius that is not finite: none."""
        name, colour = f"/where agents may be/{index}", COLOURS[index % len(COLOURS)]
        if not np.isfinite(radius):
            self.server.scene.remove_by_name(name)
            return
        angles = np.linspace(0.0, 2.0 * np.pi, _CORNERS, endpoint=False)
        rim = radius * np.stack([np.cos(angles), np.sin(angles), np.zeros(_CORNERS)], axis=1)
        k = np.arange(_CORNERS)
        faces = np.stack([np.full(_CORNERS, _CORNERS), k, (k + 1) % _CORNERS], axis=1)
        vertices = np.concatenate([rim, np.zeros((1, 3))]).astype(np.float32)
        self.server.scene.add_mesh_simple(
            name, vertices, faces.astype(np.uint32), color=colour, opacity=0.3, side="double", cast_shadow=False,
            receive_shadow=False, position=centre,
        )  # fmt: skip

    def show_landmarks(
        self, positions: FloatArray, covariances: FloatArray, sightings: npt.NDArray[np.int64] | None = None
    ) -> None:
        """Landmarks (n, 3) m and their 99.5 % ellipsoids; orange are new, green those seen in many submaps."""
        # viser takes no empty list of colours.
        tint = _LANDMARKS if sightings is None or not len(sightings) else _age_colours(sightings)
        self.server.scene.add_point_cloud(
            "/landmarks/points",
            positions.astype(np.float32),
            tint,
            point_size=0.018,
            point_shape="circle",
            precision="float32",
        )
        if len(positions):
            self._ellipsoids("/ellipsoids/landmarks", positions, covariances, (230, 159, 0))

    def show_submaps(self, starts: FloatArray, ends: FloatArray) -> None:
        """Submaps as lines from where they start to where they end, (n, 3) m each, with a ball at each start."""
        self._lines("/submaps/lines", np.stack([starts, ends], axis=1), _SUBMAPS, 0.02)
        self.server.scene.add_point_cloud(
            "/submaps/starts",
            starts.astype(np.float32),
            _SUBMAPS,
            point_size=0.12,
            point_shape="circle",
            precision="float32",
        )

    def show_closures(self, lines: FloatArray) -> None:
        """Closures as lines (n, 2, 3) m between the submaps that they tie together."""
        self._lines("/closures/lines", lines, _CLOSURES, 0.02)

    def show_frontiers(self, points: FloatArray, lengths: Sequence[float]) -> None:
        """Show the borders of what nobody has seen yet, (n, 3) m."""
        self._remove("/frontiers")
        for k, (point, length) in enumerate(zip(points, lengths, strict=True)):
            above = point + np.array([0, 0, 0.15])
            self.server.scene.add_icosphere(
                f"/frontiers/{k}", radius=0.08 + 0.02 * min(length, 5.0), color=_UNSEEN, position=above
            )

    def show_way(self, index: int, points: FloatArray, note: str) -> None:
        """The way back out of an agent, (n, 3) m on the floor."""
        name = f"/ways out/{index}"
        raised = points + np.array([0, 0, 0.06])
        self._lines(name, np.stack([raised[:-1], raised[1:]], axis=1), COLOURS[index % len(COLOURS)], 0.08)
        if len(points):
            middle = raised[len(points) // 2] + np.array([0, 0, 0.2])
            self.server.scene.add_label(f"{name}/note", note, position=middle, anchor="bottom-center")

    def show_marks(self, names: Sequence[str], positions: FloatArray) -> None:
        """Marked finds, (n, 3) m."""
        self._remove("/marks")
        for k, (name, position) in enumerate(zip(names, positions, strict=True)):
            self.server.scene.add_icosphere(f"/marks/{k}", radius=0.12, color=_MARKS, position=position)
            self.server.scene.add_label(f"/marks/{k}/name", name, position=(0, 0, 0.15), anchor="bottom-center")

    def show_camera(self, T_map_base: FloatArray, picture: ByteArray, fov: float = 1.2, number: int = 0) -> None:
        """A picture (h, w, 3) uint8 where the camera is that took it, looking along the rig's X axis.

        One with the same ``number`` is replaced; 0 is the live picture.
        """
        small = np.ascontiguousarray(picture[:: max(1, picture.shape[1] // 320), :: max(1, picture.shape[1] // 320)])
        R = T_map_base[:3, :3] @ OPTICAL_FROM_RIG.T
        self.server.scene.add_camera_frustum(
            f"/camera image/{number}", fov, picture.shape[1] / picture.shape[0], scale=0.35, color=(20, 20, 20),
            image=small, format="jpeg", wxyz=_wxyz(R), position=T_map_base[:3, 3], cast_shadow=False,
            receive_shadow=False,
        )  # fmt: skip

    def show_layer(self, name: str) -> None:
        """Tick the box of a layer that is hidden at first; who then unticks it is not overruled."""
        if name not in self._ticked:
            self._ticked.add(name)
            self._boxes[name].value = True  # type: ignore[misc]  # viser's stubs call it read-only

    def on_click(self, callback: Callable[[FloatArray, FloatArray], None]) -> None:
        """Call ``callback(origin, direction)`` with the ray, map frame, of the next click into the scene."""

        def clicked(event: viser.ScenePointerEvent) -> None:
            self.server.scene.remove_pointer_callback()
            callback(np.array(event.ray_origin), np.array(event.ray_direction))

        self.server.scene.on_pointer_event(event_type="click")(clicked)

    # -- helpers -------------------------------------------------------------------------------------------------------

    def _checkbox(self, name: str) -> viser.GuiCheckboxHandle:
        """A box that shows and hides a layer."""
        shown = name not in _HIDDEN_AT_FIRST
        self._add_root(name, shown)
        with self.layers:
            box = self.server.gui.add_checkbox(name, shown)

        @box.on_update
        def _(_: object) -> None:
            self._roots[name].visible = box.value

        return box

    def _add_root(self, name: str, shown: bool) -> None:
        """The invisible frame that a layer hangs on."""
        self._roots[name] = self.server.scene.add_frame(f"/{name}", show_axes=False, visible=shown)

    def _remove(self, layer: str) -> None:
        """Empty a layer; its box stays."""
        self.server.scene.remove_by_name(layer)
        self._add_root(layer[1:], self._boxes[layer[1:]].value)

    def _lines(self, name: str, lines: FloatArray, colour: tuple[int, int, int], thickness: float) -> None:
        if len(lines):
            self.server.scene.add_line_segments(name, lines.astype(np.float32), colour, thickness=thickness)
        else:
            self.server.scene.remove_by_name(name)

    def _ellipsoids(
        self, name: str, positions: FloatArray, covariances: FloatArray, colour: tuple[int, int, int]
    ) -> None:
        values, vectors = np.linalg.eigh(covariances)
        radii = np.sqrt(np.maximum(values, 0.0) * chi_square_bound(ELLIPSE_PROBABILITY, 3))
        shown = np.flatnonzero(radii[:, 2] < _LARGEST_ELLIPSOID_M)[:_MOST_ELLIPSOIDS]
        vectors = vectors * np.where(np.linalg.det(vectors) < 0, -1.0, 1.0)[:, None, None]
        ball = trimesh.creation.icosphere(subdivisions=1)
        self.server.scene.add_batched_meshes_simple(
            name,
            np.asarray(ball.vertices, dtype=np.float32),
            np.asarray(ball.faces),
            _wxyz(vectors[shown]),
            positions[shown],
            batched_scales=np.maximum(radii[shown], 1e-4),
            batched_colors=colour,
            opacity=0.35,
            cast_shadow=False,
            receive_shadow=False,
        )


def _wxyz(rotation: FloatArray) -> FloatArray:
    """Quaternions (..., 4) in viser's order, w first."""
    return np.asarray(quaternion_from_rotation(rotation)[..., [3, 0, 1, 2]])


def _age_colours(sightings: npt.NDArray[np.int64]) -> ByteArray:
    """Colours (n, 3) from orange, seen in one submap, to green, seen in eight or more."""
    share = np.clip(np.log2(np.maximum(sightings, 1)) / 3.0, 0.0, 1.0)[:, None]
    return np.asarray(np.rint((1.0 - share) * [230, 140, 0] + share * [20, 160, 60]), dtype=np.uint8)


def _chain(points: FloatArray) -> FloatArray:
    """Line segments (n - 1, 2, 3) through points (n, 3)."""
    return np.stack([points[:-1], points[1:]], axis=1)


def _brightened(colours: ByteArray) -> ByteArray:
    """Colours for a lit scene: grey pictures are darker than what lamps make of white."""
    return np.asarray(np.clip(60.0 + 0.95 * colours.astype(np.float32), 0, 255), dtype=np.uint8)
