# SPDX-License-Identifier: Apache-2.0
"""A finished run on the page, with a time line to scrub."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from slam_core.geometry import FloatArray
from slam_core.plural import plural
from slam_core.trajectory import Trajectory
from slam_core.types import PoseEstimate
from slam_viewer.page.command_post import position_radius, radius_text, unseen, ways_out
from slam_viewer.page.page import ViewerPage
from slam_viewer.page.panel import AgentRow
from slam_viewer.page.pictures import CaptionedImage
from slam_viewer.page.run_folder import RunFolder

_COUNTS = {"landmarks": "landmark", "submaps": "submap", "loop_closures": "loop closure"}
_STEP_S = 0.05
"""Step of the time line."""


class FinishedView:
    """Shows a run; :meth:`show_until` shows it as it was known at a stamp, on its final map.

    Parameters
    ----------
    picture_at
        The camera's picture of an agent at a stamp with its caption, or None, where there are pictures.
    """

    def __init__(
        self, page: ViewerPage, run: RunFolder, picture_at: Callable[[str, int], CaptionedImage | None] | None = None
    ) -> None:
        self.page, self.run, self._picture_at = page, run, picture_at
        self._show_map()
        first, last = run.span_ns
        with page.overview:
            # Rounded: the box has as many digits as the number, and room for few.
            duration = round(float(np.ceil(max((last - first) / 1e9, 0.1) / _STEP_S)) * _STEP_S, 2)
            self.slider = page.server.gui.add_slider("time [s]", 0.0, duration, _STEP_S, duration)
        self.slider.on_update(lambda _: self.show_until(first + round(self.slider.value * 1e9)))
        self.show_until(last)

    def _show_map(self) -> None:
        page, run = self.page, self.run
        landmarks = run.map.landmarks()
        page.show_headline(str(run.summary.get("bag", run.path.name)), _headline(run))
        page.show_mesh(run.surface)
        page.show_points(run.surface.points, run.surface.colours)
        for number, plan in enumerate(run.plans):
            page.show_plan(plan, number)
        known = landmarks.linked
        page.show_landmarks(landmarks.positions[known], landmarks.covariances[known], landmarks.sightings[known])
        marks = run.map.marks
        page.show_marks([m.name for m in marks.marks], run.map.mark_positions())
        borders = unseen(run.plans)
        page.show_frontiers(np.array([f.point for f in borders]).reshape(-1, 3), [f.length for f in borders])
        ways = [t.poses[:, :3, 3] for t in run.trajectories.values() if len(t)]
        page.look_at(np.concatenate([*ways, run.surface.points[::50].astype(np.float64)]) if ways else np.empty((0, 3)))

    def show_until(self, stamp_ns: int) -> None:
        """Show everybody's place at a stamp, the way there, and the way out."""
        with self.page.server.atomic():
            lines = self.run.submap_lines(stamp_ns)
            self.page.show_submaps(lines[:, 0], lines[:, 1])
            self.page.show_closures(self.run.closure_lines(stamp_ns))
            poses = self._show_agents(stamp_ns)
            self._show_ways_out(poses, stamp_ns)

    def _show_agents(self, stamp_ns: int) -> dict[str, PoseEstimate]:
        rows, poses = [], {}
        for index, (agent, trajectory) in enumerate(self.run.trajectories.items()):
            so_far = trajectory.select(trajectory.stamps_ns <= stamp_ns)
            if not len(so_far):
                rows.append(AgentRow(agent, "not yet there"))
                continue
            self.page.show_trajectory(index, so_far.poses)
            poses[agent] = _last(so_far)
            self.page.show_agent(agent, index, so_far.poses[-1])
            rows.append(AgentRow(agent, _state(so_far, stamp_ns), _way_text(so_far, poses[agent])))
            self._show_picture(agent, stamp_ns, so_far.poses[-1])
        self.page.show_agent_table(rows)
        return poses

    def _show_picture(self, agent: str, stamp_ns: int, T_map_base: FloatArray) -> None:
        picture = self._picture_at(agent, stamp_ns) if self._picture_at is not None else None
        if picture is not None:
            self.page.show_picture(picture.image, picture.caption)
            self.page.show_camera(T_map_base, picture.image)

    def _show_ways_out(self, poses: dict[str, PoseEstimate], stamp_ns: int) -> None:
        paths = {
            agent: t.poses[t.stamps_ns <= stamp_ns, :3, 3]
            for agent, t in self.run.trajectories.items()
            if agent in poses
        }
        texts = []
        for out in ways_out(self.run.plans, poses, paths):
            index = list(self.run.trajectories).index(out.agent)
            points = np.empty((0, 3)) if out.route is None else out.route.points
            self.page.show_way(index, points, out.label)
            texts.append((out.agent, out.text))
        unseen_count = len(unseen(self.run.plans))
        note = f"{plural(unseen_count, 'place')} where nobody has looked yet."
        self.page.show_ways_text(texts, note if self.run.plans else "No floor plan in this run.")


def _headline(run: RunFolder) -> list[str]:
    """Lines below the run's name. A summary comes from a folder that anybody may have written."""
    s = run.summary
    counts = [plural(int(s.get(key, 0)), word) for key, word in _COUNTS.items()]
    figures = ", ".join([f"{float(s.get('path_length_m', 0.0)):.1f} m", *counts])
    accuracy = f", ATE {1000 * float(s['ate_rmse_m']):.1f} mm" if s.get("ate_rmse_m") is not None else ""
    return [figures + accuracy, *filter(None, [run.note])]


def _last(trajectory: Trajectory) -> PoseEstimate:
    covariance = np.zeros((6, 6)) if trajectory.covariances is None else trajectory.covariances[-1]
    return PoseEstimate(int(trajectory.stamps_ns[-1]), trajectory.poses[-1], covariance)


def _state(so_far: Trajectory, stamp_ns: int) -> str:
    silent_s = (stamp_ns - int(so_far.stamps_ns[-1])) / 1e9
    return f"silent for {silent_s:.0f} s" if silent_s > 2.0 else "OK"


def _way_text(so_far: Trajectory, pose: PoseEstimate) -> str:
    x, y, z = pose.T[:3, 3]
    return f"{so_far.length_m:.1f} m walked, at ({x:.1f}, {y:.1f}, {z:.1f}) m, {radius_text(position_radius(pose))}"
