# SPDX-License-Identifier: Apache-2.0
"""The work of ``slam anchor``: pairs of points become the transform from the map to its building, and its files."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from slam_core.estimation.plane_alignment import PlaneAlignment, PlanePoints, align_plane
from slam_core.geometry import (
    FloatArray,
    compose_jacobians,
    invert_transform,
    make_transform,
    rotation_from_euler,
    transform_points,
)
from slam_core.storage.anchor_file import Anchor, is_anchor, read_anchor
from slam_core.storage.files import atomic_text, digest, naming, read_text, read_yaml
from slam_core.trajectory import Trajectory, write_tum
from slam_viewer.anchor.building_plan import BuildingPlan
from slam_viewer.anchor.click_page import GENERATOR, click_page
from slam_viewer.anchor.map_from_above import MapFromAbove
from slam_viewer.anchor.overlay import Overlay

ANCHOR, PAGE, PICTURE = "anchor.yaml", "anchor.html", "anchored_plan.png"
_TRAJECTORY = "trajectory_building"
_FLOOR_SIGMA, _TILT_SIGMA = 0.05, 0.01
"""Of the floor's height (m) and of its levelling (rad), which points on a plan say nothing of."""
_NO_FLOOR_SIGMA, _NO_TILT_SIGMA = 1.0, 0.05
"""The same for a map without a floor plan: it is taken for level, with the map's origin at height 0."""


@dataclass(frozen=True)
class Pair:
    """x, y (m) of a point in the map, u, v (px) on the plan, with the standard deviation of a pixel coordinate."""

    map: tuple[float, float]
    plan: tuple[float, float]
    sigma_px: float


@dataclass(frozen=True, eq=False)
class Anchored:
    """A map on the plan of its building; ``plan`` has the resolution that was found, where it had none."""

    plan: BuildingPlan
    fit: PlaneAlignment
    T_building_floor: FloatArray
    anchor: Anchor


def parse_pair(text: str, sigma_px: float) -> Pair:
    """The pair of ``X,Y=U,V``; ValueError if it is none."""
    try:
        (x, y), (u, v) = ([float(word) for word in side.split(",")] for side in text.split("="))
    except ValueError:
        raise ValueError(
            f"--at {text}: a pair of points is X,Y=U,V, metres in the map and pixels on the plan"
        ) from None
    return Pair((x, y), (u, v), sigma_px)


def read_pairs(path: Path, sigma_px: float) -> list[Pair]:
    """The pairs of a YAML file, a list ``points`` of ``{map: [x, y], plan: [u, v]}``, each with ``sigma_px`` or not."""
    content = read_yaml(path)
    rows = content.get("points") if isinstance(content, Mapping) else None
    if not isinstance(rows, list):
        raise ValueError(f"{path}: a file of points is a mapping with a list 'points'")
    pairs = []
    for number, row in enumerate(rows, 1):
        try:
            if unknown := set(row) - {"map", "plan", "sigma_px"}:
                raise ValueError(f"unknown {sorted(map(str, unknown))}, known: map, plan, sigma_px")
            (x, y), (u, v) = ([float(value) for value in row[key]] for key in ("map", "plan"))
            pairs.append(Pair((x, y), (u, v), float(row.get("sigma_px", sigma_px))))
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            missing = f"it lacks {error}" if isinstance(error, KeyError) else str(error)
            raise ValueError(f"{path}, point {number}: {missing}; a point is {{map: [x, y], plan: [u, v]}}") from error
    return pairs


def anchor_map(mapped: MapFromAbove, plan: BuildingPlan, pairs: Sequence[Pair], sigma_m: float) -> Anchored:
    """The map's place in the frame of the plan.

    Raises
    ------
    ValueError
        If the pairs do not say it: too few, off the plan, coincident, mirrored, or contradicting each other.
    """
    pixels = np.array([pair.plan for pair in pairs], dtype=np.float64).reshape(-1, 2)
    places = np.array([pair.map for pair in pairs], dtype=np.float64).reshape(-1, 2)
    for number, pixel in enumerate(pixels, 1):
        if not (np.isfinite(pixel).all() and (pixel >= 0.0).all() and (pixel <= plan.size).all()):
            u, v = pixel
            raise ValueError(f"point {number} is not on the plan: ({u:g}, {v:g}) of {plan.size[0]} x {plan.size[1]} px")
    sigma_px = np.array([pair.sigma_px for pair in pairs])
    is_known = plan.resolution is not None
    target = plan.points(pixels) if is_known else plan.from_lower_left(pixels)
    target_sigma = sigma_px * (plan.resolution if plan.resolution is not None else 1.0)
    fit = align_plane(PlanePoints(mapped.on_floor(places), target, np.array(sigma_m), target_sigma, is_known))
    if not is_known:
        plan = plan.with_resolution(fit.scale)
    T = make_transform(rotation_from_euler(fit.yaw), np.array([*fit.translation, 0.0]))
    T_floor_map = invert_transform(mapped.T_map_floor)
    J, _ = compose_jacobians(T, T_floor_map)
    P = J @ _with_height_and_tilt(fit.covariance, has_floor=mapped.plan is not None) @ J.T
    said = {"image": str(plan.path.resolve()), "resolution": plan.resolution, "origin": [float(v) for v in plan.origin]}
    said |= {} if is_known else {"resolution_sigma": fit.scale_sigma * fit.scale}
    points = [
        {"map": list(pair.map), "plan": list(pair.plan), "sigma_px": pair.sigma_px,
         "residual": [float(v) for v in residual], "used": bool(used)}
        for pair, residual, used in zip(pairs, fit.residuals, fit.inliers, strict=True)
    ]  # fmt: skip
    return Anchored(plan, fit, T, Anchor(T @ T_floor_map, 0.5 * (P + P.T), plan=said, points=points))


def _with_height_and_tilt(P: FloatArray, *, has_floor: bool) -> FloatArray:
    """Covariance (6, 6) of T_building_floor with that of x, y, yaw (3, 3) in it."""
    height, tilt = (_FLOOR_SIGMA, _TILT_SIGMA) if has_floor else (_NO_FLOOR_SIGMA, _NO_TILT_SIGMA)
    full = np.diag([0.0, 0.0, height**2, tilt**2, tilt**2, 0.0])
    seen = np.ix_((0, 1, 5), (0, 1, 5))
    full[seen] = P
    return full


def report(anchored: Anchored) -> str:
    """Lines for the user: transform, standard deviations, and how far each pair is off."""
    fit, T, plan = anchored.fit, anchored.anchor.T, anchored.plan
    x, y, z = T[:3, 3]
    yaw = float(np.degrees(np.arctan2(T[1, 0], T[0, 0])))
    sigma = np.sqrt(np.diag(anchored.anchor.covariance))
    assert plan.resolution is not None
    found = f" +- {100.0 * fit.scale_sigma:.2g} %, from the points" if fit.scale_sigma else ""
    lines = [
        f"building <- map: x {x:.3f} +- {sigma[0]:.3f} m, y {y:.3f} +- {sigma[1]:.3f} m, "
        f"z {z:.3f} +- {sigma[2]:.3f} m, yaw {yaw:.2f} +- {np.degrees(sigma[5]):.2f} deg",
        f"plan: {plan.resolution:.5g} m/px{found}",
    ]
    for number, (residual, used) in enumerate(zip(fit.residuals, fit.inliers, strict=True), 1):
        off = float(np.linalg.norm(residual))
        lines.append(
            f"point {number}: off by {off:.3f} m, {off / plan.resolution:.1f} px"
            + ("" if used else "; left out: it contradicts the others")
        )
    if fit.freedom:
        lines.append(f"chi2 {fit.chi2:.2f} with {fit.freedom} degrees of freedom")
    else:
        lines.append("nothing checks two points on a plan of unknown scale: a third one would")
    return "\n".join(lines)


def write_anchored(folder: Path, mapped: MapFromAbove, anchored: Anchored, *, overwrite: bool) -> list[str]:
    """Write ``anchor.yaml``, ``trajectory_building*.tum`` and ``anchored_plan.png``; their names.

    Raises
    ------
    ValueError
        If a file of that name is there that ``slam anchor`` did not write, or that was changed since.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with naming(folder), tempfile.TemporaryDirectory(prefix=".slam.anchor.", dir=folder) as staging:
        for name, trajectory in _in_building(mapped.trajectories, anchored.anchor.T).items():
            write_tum(Path(staging) / name, trajectory)
        if not cv2.imwrite(str(Path(staging) / PICTURE), draw(mapped, anchored)):
            raise ValueError(f"{folder / PICTURE} cannot be written")
        files = {path.name: digest(path) for path in sorted(Path(staging).iterdir())}
        _require_ours(folder, files, overwrite=overwrite)
        replace(anchored.anchor, files=files).write(folder / ANCHOR)
        for name in files:
            os.replace(Path(staging) / name, folder / name)
    return [ANCHOR, *files]


def _in_building(trajectories: Mapping[str, Trajectory], T_building_map: FloatArray) -> dict[str, Trajectory]:
    """By file name; with several agents each has its own, and the first one's is there by the common name too."""
    moved = {a: Trajectory(t.stamps_ns, T_building_map @ t.poses) for a, t in trajectories.items() if len(t)}
    out = {f"{_TRAJECTORY}.tum": next(iter(moved.values()))} if moved else {}
    return out | ({f"{_TRAJECTORY}_{agent}.tum": t for agent, t in moved.items()} if len(moved) > 1 else {})


def draw(mapped: MapFromAbove, anchored: Anchored) -> np.ndarray[tuple[int, ...], np.dtype[np.uint8]]:
    """The plan with walls, paths and pairs of points on it."""

    def in_building(points: FloatArray) -> FloatArray:
        flat = np.column_stack([points, np.zeros(len(points))])
        return transform_points(anchored.T_building_floor, flat)[:, :2]

    walls, paths = in_building(mapped.walls), [in_building(path) for path in mapped.paths().values()]
    overlay = Overlay(anchored.plan, np.concatenate([walls, *paths]) if mapped.plan is not None else np.empty((0, 2)))
    overlay.draw_walls(walls, 0.05 if mapped.plan is None else mapped.plan.resolution)
    overlay.draw_paths(paths)
    points = anchored.anchor.points
    clicked = anchored.plan.points(np.array([p["plan"] for p in points]))
    mapped_points = in_building(mapped.on_floor(np.array([p["map"] for p in points])))
    overlay.draw_pairs(clicked, mapped_points, [p["used"] for p in points])
    overlay.draw_scale_bar()
    return overlay.image


def write_page(folder: Path, mapped: MapFromAbove, plan: BuildingPlan, command: str) -> Path:
    """Write the page on which pairs of points are clicked; ValueError if another file has its name."""
    path = folder / PAGE
    if path.exists() and GENERATOR not in read_text(path, errors="replace")[:1000]:
        raise ValueError(f"{path} was not written by slam anchor and stays: move it, or give -o another folder")
    folder.mkdir(parents=True, exist_ok=True)
    atomic_text(path, click_page(f"{mapped.folder.name} on {plan.path.name}", command, mapped.picture(), plan))
    return path


def _require_ours(folder: Path, names: Mapping[str, Any], *, overwrite: bool) -> None:
    known: dict[str, str] = {}
    if (folder / ANCHOR).exists():
        if not is_anchor(folder / ANCHOR):
            raise ValueError(f"{folder / ANCHOR} was not written by slam anchor and stays: give -o another folder")
        known = read_anchor(folder / ANCHOR).files
    for name in names:
        path = folder / name
        if not path.exists() and not path.is_symlink():
            continue
        if name not in known or path.is_symlink() or not path.is_file():
            raise ValueError(f"{path} was not written by slam anchor and stays: give -o another folder")
        if digest(path) != known[name] and not overwrite:
            raise ValueError(
                f"{path} was changed since slam anchor wrote it: give -o another folder, or say --overwrite"
            )
