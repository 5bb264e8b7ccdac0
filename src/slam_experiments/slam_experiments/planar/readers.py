# SPDX-License-Identifier: Apache-2.0
"""Reads range-bearing logs: UTIAS MRCLAM (a folder), Lost in the Woods (.mat) and Victoria Park in GTSAM's text."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import scipy.io
from scipy.io.matlab import MatReadError

from slam_core.geometry import FloatArray
from slam_core.storage.files import read_text
from slam_experiments.planar.ekf import move, turn, wrap
from slam_experiments.planar.log import PlanarLog, RobotLog

_MRCLAM_SIGMA = (0.17, 0.015)
"""Range m and bearing rad; spread of the residuals of data set 6 against Vicon."""
_MRCLAM_WHEELS = (0.01, 0.03, 0.05, 0.05)
"""Sigma of the speed: constant m/s and share; of the turn rate: constant rad/s and share; over a step."""
_GTSAM_BEARING_VARIANCE = 0.1
"""Variance of a bearing over the published one of a position, as GTSAM's reader takes it, rad2 / m2."""


def read_log(path: Path) -> PlanarLog:
    """The log at a path, by what it looks like.

    Raises
    ------
    ValueError
        If it is none of the known layouts, or broken.
    """
    if path.is_dir() and (path / "Barcodes.dat").exists():
        return read_mrclam(path)
    if path.is_file() and path.suffix == ".mat":
        return read_lost_in_the_woods(path)
    if path.is_file() and path.suffix == ".txt":
        return read_gtsam(path)
    raise ValueError(
        f"{path} is no known range-bearing log: give an MRCLAM folder (with Barcodes.dat), Lost in the Woods"
        " (dataset2.mat) or a GTSAM text file with ODOMETRY and LANDMARK lines"
    )


def read_mrclam(folder: Path) -> PlanarLog:
    """UTIAS Multi-Robot Cooperative Localization and Mapping (Leung et al., IJRR 2011).

    A step is a time at which a robot saw something; its motion is the odometry since the step before. Sightings of
    other robots are left out.
    """
    subject_of = {int(barcode): int(subject) for subject, barcode in _table(folder / "Barcodes.dat", 2)}
    landmarks = {int(row[0]): row[1:3] for row in _table(folder / "Landmark_Groundtruth.dat", 5)}
    names = sorted(path.name.split("_")[0] for path in folder.glob("Robot*_Odometry.dat"))
    if not names:
        raise ValueError(f"{folder}: no Robot*_Odometry.dat")
    robots = tuple(_mrclam_robot(folder, name, subject_of, landmarks) for name in names)
    return PlanarLog(folder.name, robots, *_MRCLAM_SIGMA, landmarks)


def _mrclam_robot(folder: Path, name: str, subject_of: dict[int, int], landmarks: dict[int, FloatArray]) -> RobotLog:
    odometry = _table(folder / f"{name}_Odometry.dat", 3)
    truth = _table(folder / f"{name}_Groundtruth.dat", 4)
    measured = _table(folder / f"{name}_Measurement.dat", 4)
    subject = np.array([subject_of.get(int(code), -1) for code in measured[:, 1]])
    inside = (measured[:, 0] >= max(odometry[0, 0], truth[0, 0])) & (measured[:, 0] <= truth[-1, 0])
    kept = np.isin(subject, list(landmarks)) & inside
    stamps, step = np.unique(measured[kept, 0].astype(np.float64), return_inverse=True)
    motions, covariances = _integrated(odometry, stamps)
    z, ids = measured[kept, 2:4], subject[kept]
    of_step = [np.flatnonzero(step == k) for k in range(len(stamps))]
    return RobotLog(
        name,
        stamps,
        motions,
        covariances,
        tuple(z[rows] for rows in of_step),
        tuple(ids[rows].astype(np.int64) for rows in of_step),
        _interpolated(truth, stamps),
    )


def _integrated(odometry: FloatArray, stamps: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Motions (n - 1, 3) between stamps from speeds (time, m/s, rad/s) that hold until the next line."""
    edges = np.union1d(odometry[:, 0], stamps)
    edges = edges[(edges >= stamps[0]) & (edges <= stamps[-1])]
    row = np.clip(np.searchsorted(odometry[:, 0], edges[:-1], side="right") - 1, 0, None)
    dt, speed = np.diff(edges), odometry[row, 1:3]
    step = np.searchsorted(stamps, edges[:-1], side="right") - 1
    motions = np.zeros((len(stamps) - 1, 3))
    for k, (v, omega) in zip(step, speed * dt[:, None], strict=True):
        motions[k] = move(motions[k], np.array([*(turn(0.5 * omega) @ [v, 0.0]), omega]))[0]
    duration = np.diff(stamps)
    way, turned = np.abs(motions[:, :2]).max(axis=1), np.abs(motions[:, 2])
    forward = _MRCLAM_WHEELS[0] * np.sqrt(duration) + _MRCLAM_WHEELS[1] * way
    angle = _MRCLAM_WHEELS[2] * np.sqrt(duration) + _MRCLAM_WHEELS[3] * turned
    sigma = np.column_stack([forward, 0.5 * forward, angle]) + 1e-4
    return motions, sigma[:, :, None] ** 2 * np.eye(3)


def _interpolated(truth: FloatArray, stamps: FloatArray) -> FloatArray:
    angle = np.unwrap(truth[:, 3])
    columns = [np.interp(stamps, truth[:, 0], column) for column in (truth[:, 1], truth[:, 2], angle)]
    columns[2] = wrap(columns[2])
    return np.column_stack(columns)


def read_lost_in_the_woods(path: Path) -> PlanarLog:
    """Lost in the Woods (Barfoot, UTIAS): a robot among 17 tubes; poses are those of its laser.

    The rate published with a step is the one measured before it. Noise is twice the published one: the wheels' motion
    is 4.5 degrees off the laser's axis.
    """
    try:
        data = scipy.io.loadmat(path)
        dt, d = 0.1, float(data["d"][0, 0])
        wheels = np.column_stack([data["x_true"], data["y_true"], data["th_true"]])
        v, omega = data["v"].ravel() * dt, data["om"].ravel() * dt
        variances = [float(data[name][0, 0]) for name in ("v_var", "om_var", "r_var", "b_var")]
    except (KeyError, IndexError, ValueError, TypeError, MatReadError) as error:
        raise ValueError(f"{path} is not Lost in the Woods: {error}") from error
    truth = wheels.copy()
    truth[:, :2] += d * np.column_stack([np.cos(wheels[:, 2]), np.sin(wheels[:, 2])])
    motions = np.array(
        [
            [*(turn(0.5 * angle) @ [forward, 0.0] + turn(angle) @ [d, 0.0] - [d, 0.0]), angle]
            for forward, angle in zip(v[:-1], omega[:-1], strict=True)
        ]
    )
    G = np.array([[dt, 0.0], [0.0, d * dt], [0.0, dt]])
    Q = G @ np.diag(variances[:2]) @ G.T + 1e-12 * np.eye(3)
    seen = [np.flatnonzero(row > 0.0).astype(np.int64) for row in data["r"]]
    observations = tuple(np.column_stack([data["r"][k, ids], data["b"][k, ids]]) for k, ids in enumerate(seen))
    robot = RobotLog(
        "robot",
        dt * np.arange(float(len(truth))),
        motions,
        np.broadcast_to(Q, (len(motions), 3, 3)),
        observations,
        tuple(seen),
        truth,
    )
    sigma_range, sigma_bearing = 2.0 * np.sqrt(variances[2:])
    landmarks = {k: np.asarray(point) for k, point in enumerate(data["l"])}
    return PlanarLog(path.stem, (robot,), float(sigma_range), float(sigma_bearing), landmarks)


def read_gtsam(path: Path) -> PlanarLog:
    """GTSAM's text form (Victoria Park): lines ODOMETRY and LANDMARK with the variances of their noise."""
    odometry: dict[int, tuple[int, FloatArray, FloatArray]] = {}
    seen: dict[int, list[tuple[int, FloatArray]]] = {}
    spread = []
    for number, line in enumerate(read_text(path).splitlines(), 1):
        words = line.split()
        try:
            if words and words[0] == "ODOMETRY":
                a, b, *values = (int(words[1]), int(words[2]), *map(float, words[3:12]))
                covariance = _symmetric(np.array(values[3:]))
                odometry[int(a)] = (int(b), np.array(values[:3]), covariance)
            elif words and words[0] == "LANDMARK":
                pose, landmark = int(words[1]), int(words[2])
                point = np.array([float(w) for w in words[3:5]])
                seen.setdefault(pose, []).append((landmark, point))
                spread.append(float(words[5]))
        except (ValueError, IndexError) as error:
            raise ValueError(f"{path}, line {number}: {error}") from error
    if not odometry or not seen:
        raise ValueError(f"{path} holds no ODOMETRY or no LANDMARK lines")
    return _from_lines(path, odometry, seen, float(np.sqrt(np.median(spread))))


def _symmetric(upper: FloatArray) -> FloatArray:
    P = np.zeros((3, 3))
    P[np.triu_indices(3)] = upper
    return np.asarray(P + P.T - np.diag(np.diag(P)))


def _from_lines(
    path: Path,
    odometry: dict[int, tuple[int, FloatArray, FloatArray]],
    seen: dict[int, list[tuple[int, FloatArray]]],
    sigma: float,
) -> PlanarLog:
    poses = [min(odometry)]
    while poses[-1] in odometry:
        poses.append(odometry[poses[-1]][0])
    observations, ids = [], []
    for pose in poses:
        points = np.array([point for _, point in seen.get(pose, [])]).reshape(-1, 2)
        observations.append(np.column_stack([np.hypot(*points.T), np.arctan2(points[:, 1], points[:, 0])]))
        ids.append(np.array([landmark for landmark, _ in seen.get(pose, [])], dtype=np.int64))
    motions, covariances = (np.array([odometry[pose][k] for pose in poses[:-1]]) for k in (1, 2))
    robot = RobotLog("robot", np.arange(float(len(poses))), motions, covariances, tuple(observations), tuple(ids))
    return PlanarLog(path.stem, (robot,), sigma, sigma * float(np.sqrt(_GTSAM_BEARING_VARIANCE)))


def _table(path: Path, columns: int) -> npt.NDArray[np.float64]:
    """Numbers of a text table with ``columns`` columns or more; lines with # are comments."""
    try:
        table = np.loadtxt(read_text(path).splitlines(), comments="#", ndmin=2)
    except (OSError, ValueError) as error:
        raise ValueError(f"{path} cannot be read: {error}") from error
    if table.shape[1] < columns or not np.isfinite(table).all():
        raise ValueError(f"{path}: expected {columns} columns of finite numbers, found {table.shape}")
    return np.asarray(table, dtype=np.float64)
